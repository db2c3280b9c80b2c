"""What long commands share: a folder that holds one plan, and jobs spread over processes or machines."""

from __future__ import annotations

import fcntl
import json
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import Any, TypeVar

from tlf_env.common.files import atomic

POLLED_EVERY_S = 0.5

Shared = TypeVar("Shared")
Job = TypeVar("Job")
Answer = TypeVar("Answer")


def claim(path: Path, record: dict[str, Any], keys: Sequence[str], what: str) -> None:
    """Write what a folder is for, or check that it is for that already.

    Parameters
    ----------
    path
        The JSON file that says so.
    keys
        Entries of the record that must not change.
    what
        What the folder holds, for the error.

    Raises
    ------
    ValueError
        naming the first entry that differs, or if the file is damaged.
    """
    if not path.exists():
        with atomic(path, encoding="utf-8") as file:
            json.dump(record, file, indent=2)
            file.write("\n")
        return
    try:
        before = dict(json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path} is damaged; take another --out, or remove it") from error
    for key in keys:
        if before.get(key) != record[key]:
            raise ValueError(
                f"{path.parent} holds {what} of another {key}; take another --out, or remove it"
            )


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Keep other processes that ask for it out of a folder; a process that is killed keeps nobody out.

    Raises
    ------
    ValueError
        if one is there.
    """
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ValueError(f"another process is at work in {folder}") from error
        yield
    finally:
        os.close(handle)


def spread(
    function: Callable[[Shared, Job], Answer],
    shared: Shared,
    jobs: Iterable[Job],
    *,
    processes: int = 1,
    ray_address: str | None = None,
    ahead: int = 1,
    meanwhile: Callable[[], None] = lambda: None,
) -> Iterator[Answer]:
    """Answers ``function(shared, job)`` as they come: here, in processes, or on a Ray cluster.

    Jobs are drawn only when there is room for them, so that a generator may make the next one from
    the answers so far, and an interrupt is quick.

    Parameters
    ----------
    ahead
        Jobs in flight per process.
    meanwhile
        Called now and then while jobs run elsewhere.

    Raises
    ------
    ValueError
        if ray is not installed or the cluster cannot be reached.
    """
    if ray_address is not None:
        yield from _on_ray(function, shared, jobs, ray_address, ahead, meanwhile)
    elif processes == 1:
        for job in jobs:
            yield function(shared, job)
    else:
        yield from _in_processes(function, shared, jobs, processes, ahead, meanwhile)


def _in_processes(
    function: Callable[[Shared, Job], Answer],
    shared: Shared,
    jobs: Iterable[Job],
    processes: int,
    ahead: int,
    meanwhile: Callable[[], None],
) -> Iterator[Answer]:
    waiting = iter(jobs)
    pool = ProcessPoolExecutor(
        processes, mp_context=get_context("spawn"), initializer=_end_with_parent
    )
    running: set[Future[Answer]] = set()
    try:
        while True:
            while len(running) < processes * ahead:
                try:
                    job = next(waiting)
                except StopIteration:
                    break
                running.add(pool.submit(function, shared, job))
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
    function: Callable[[Shared, Job], Answer],
    shared: Shared,
    jobs: Iterable[Job],
    address: str,
    ahead: int,
    meanwhile: Callable[[], None],
) -> Iterator[Answer]:
    try:
        import ray
    except ModuleNotFoundError as error:
        raise ValueError("--ray needs ray (pip install 'tlf-env[ray]')") from error
    try:
        ray.init(address=address, log_to_driver=False)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise ValueError(f"no Ray cluster at {address!r}: {error}") from error
    try:
        remote = ray.remote(num_cpus=1)(function)
        held = ray.put(shared)
        limit = ahead * max(1, int(ray.cluster_resources().get("CPU", 1)))
        waiting = iter(jobs)
        running: list[Any] = []
        while True:
            while len(running) < limit:
                try:
                    job = next(waiting)
                except StopIteration:
                    break
                running.append(remote.remote(held, job))
            if not running:
                return
            done, running = ray.wait(running, timeout=POLLED_EVERY_S)
            meanwhile()
            yield from ray.get(done)
    finally:
        ray.shutdown()
