"""Independent jobs on the processes of this machine or on a Ray cluster; results as they come."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from multiprocessing import get_context, parent_process
from typing import Any

IN_FLIGHT_PER_PROCESS = 4  # handed out ahead: few, so that an interrupt is quick
POLLED_EVERY_S = 0.5


def run_jobs(
    call: Callable[..., Any],
    jobs: Iterable[tuple[Any, ...]],
    *,
    processes: int = 1,
    ray_address: str | None = None,
    ahead: int = IN_FLIGHT_PER_PROCESS,
    meanwhile: Callable[[], None] = lambda: None,
) -> Iterator[Any]:
    """Results of ``call(*job)``, in the order in which they come.

    Parameters
    ----------
    call
        A function of a module; its arguments and results are pickled if there are processes.
    processes
        1 runs the jobs here, in their order.
    ray_address
        Of an existing Ray cluster to run on instead.
    ahead
        Jobs handed out per process, the running ones included.
    meanwhile
        Called now and then while jobs run elsewhere.

    Raises
    ------
    ValueError
        for less than one process, without ray, or without a cluster at the address.
    """
    if processes < 1:
        raise ValueError(f"processes {processes} must be at least 1")
    if ray_address is not None:
        return _on_ray(call, iter(jobs), ray_address, ahead, meanwhile)
    if processes == 1:
        return (call(*job) for job in jobs)
    return _in_processes(call, iter(jobs), processes, ahead, meanwhile)


def _in_processes(
    call: Callable[..., Any],
    waiting: Iterator[tuple[Any, ...]],
    processes: int,
    ahead: int,
    meanwhile: Callable[[], None],
) -> Iterator[Any]:
    pool = ProcessPoolExecutor(
        processes, mp_context=get_context("spawn"), initializer=_end_with_parent
    )
    running: set[Future[Any]] = set()
    try:
        while True:
            while len(running) < processes * ahead and (job := next(waiting, None)) is not None:
                running.add(pool.submit(call, *job))
            if not running:
                return
            done, running = wait(running, POLLED_EVERY_S, return_when=FIRST_COMPLETED)
            meanwhile()
            for future in done:
                yield future.result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _end_with_parent() -> None:
    """Let this worker end when its parent is killed, which a pool by itself does not."""
    parent = parent_process()

    def wait_and_leave() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait_and_leave, daemon=True).start()


def _on_ray(
    call: Callable[..., Any],
    waiting: Iterator[tuple[Any, ...]],
    address: str,
    ahead: int,
    meanwhile: Callable[[], None],
) -> Iterator[Any]:
    try:
        import ray
    except ModuleNotFoundError as error:
        raise ValueError("--ray needs ray (pip install 'tlf-env[ray]')") from error
    try:
        ray.init(address=address, log_to_driver=False)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise ValueError(f"no Ray cluster at {address!r}: {error}") from error
    try:
        remote = ray.remote(num_cpus=1)(call)
        limit = ahead * max(1, int(ray.cluster_resources().get("CPU", 1)))
        running: list[Any] = []
        while True:
            while len(running) < limit and (job := next(waiting, None)) is not None:
                running.append(remote.remote(*job))
            if not running:
                return
            done, running = ray.wait(running, timeout=POLLED_EVERY_S)
            meanwhile()
            yield from ray.get(done)
    finally:
        ray.shutdown()
