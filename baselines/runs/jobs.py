"""What long commands share: a folder reserved for one plan, and jobs spread over processes or machines."""

from __future__ import annotations

import fcntl
import json
import os
import socket
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from functools import partial
from itertools import islice
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

from baselines.runs.stopping import starting_workers, stop_with_parent
from tlf_env.common.errors import install_command, shown
from tlf_env.common.files import atomic, read_json

POLLED_EVERY_S = 0.5
CONNECT_WITHIN_S = 10.0  # to a Ray cluster

SharedT = TypeVar("SharedT")
JobT = TypeVar("JobT")
AnswerT = TypeVar("AnswerT")


def claim(path: Path, record: dict[str, Any], keys: Sequence[str], what: str) -> None:
    """Reserve a folder for a plan, or check that it is reserved for the same plan.

    Parameters
    ----------
    path
        JSON file that holds the record.
    keys
        Entries of the record that must not change.
    what
        What the folder holds, for the error.

    Raises
    ------
    ValueError
        naming what differs first, with both values, or if the file is damaged.
    """
    if not path.exists():
        try:
            with atomic(path, encoding="utf-8", exclusive=True) as file:
                json.dump(record, file, indent=2)
                file.write("\n")
            return
        except FileExistsError:  # another process has just claimed it
            pass
    try:
        before = dict(read_json(path))
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path} is damaged; choose another --out, or remove it") from error
    for key in keys:
        if before.get(key) != record[key]:
            place, there, now = first_difference(before.get(key), record[key], key)
            raise ValueError(
                f"{path.parent} holds {what} with a different {key!r} in {path.name}: {place} is "
                f"{shown(there)} there and {shown(now)} now; choose another --out, or remove it"
            )


def first_difference(there: Any, now: Any, path: str) -> tuple[str, Any, Any]:
    """The path of the first difference of two values of JSON, and what each has there; None: nothing."""
    if isinstance(there, dict) and isinstance(now, dict):
        for key in dict.fromkeys((*there, *now)):
            if there.get(key) != now.get(key) or (key in there) != (key in now):
                return first_difference(there.get(key), now.get(key), f"{path}.{key}")
    if isinstance(there, list) and isinstance(now, list) and len(there) == len(now):
        for number, (one, other) in enumerate(zip(there, now, strict=True)):
            if one != other:
                return first_difference(one, other, f"{path}.{number}")
    return path, there, now


@contextmanager
def alone_in(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Lock a folder against other processes that lock it; a killed process leaves no lock behind.

    Parameters
    ----------
    wait
        Wait until the lock is free.

    Raises
    ------
    ValueError
        if another process holds the lock.
    """
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError as error:
            raise ValueError(
                f"another process works in {folder}; wait for it, or choose another --out"
            ) from error
        yield
    finally:
        os.close(handle)


def spread(
    function: Callable[[SharedT, JobT], AnswerT],
    shared: SharedT,
    jobs: Iterable[JobT],
    *,
    processes: int = 1,
    ray_address: str | None = None,
    ahead: int = 1,
    meanwhile: Callable[[], None] = lambda: None,
) -> Iterator[AnswerT]:
    """Answers ``function(shared, job)`` as they arrive: from here, from processes, or from a Ray cluster.

    A job is drawn only when a process is free for it. So a generator of jobs may use the answers so
    far. After an interrupt, or an error, the processes stop at once; trainings write their checkpoints before.

    Parameters
    ----------
    ahead
        Jobs in flight per process.
    meanwhile
        Called at short intervals while jobs run elsewhere.

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
    function: Callable[[SharedT, JobT], AnswerT],
    shared: SharedT,
    jobs: Iterable[JobT],
    processes: int,
    ahead: int,
    meanwhile: Callable[[], None],
) -> Iterator[AnswerT]:
    context = get_context("spawn")
    watched, ends = zip(context.Pipe(duplex=False), context.Pipe(duplex=False), strict=True)
    pool = ProcessPoolExecutor(
        processes, mp_context=context, initializer=stop_with_parent, initargs=watched
    )
    stop, leave = ends
    waiting = iter(jobs)
    running: set[Future[AnswerT]] = set()
    try:
        while True:
            for job in islice(waiting, processes * ahead - len(running)):
                with starting_workers():
                    running.add(pool.submit(function, shared, job))
            if not running:
                return
            done, running = wait(running, POLLED_EVERY_S, return_when=FIRST_COMPLETED)
            meanwhile()
            for future in done:
                yield future.result()
    except BaseException:
        stop.close()
        raise
    finally:
        try:
            pool.shutdown(wait=True, cancel_futures=True)
        except KeyboardInterrupt:  # a second one
            leave.close()
            raise
        finally:
            for one in (*watched, *ends):
                one.close()


def _on_ray(
    function: Callable[[SharedT, JobT], AnswerT],
    shared: SharedT,
    jobs: Iterable[JobT],
    address: str,
    ahead: int,
    meanwhile: Callable[[], None],
) -> Iterator[AnswerT]:
    ray = connected_ray(address)
    try:
        submit = partial(ray.remote(num_cpus=1)(function).remote, ray.put(shared))
        limit = ahead * max(1, int(ray.cluster_resources().get("CPU", 1)))
        waiting = iter(jobs)
        running: list[Any] = []
        while True:
            running += [submit(job) for job in islice(waiting, limit - len(running))]
            if not running:
                return
            done, running = ray.wait(running, timeout=POLLED_EVERY_S)
            meanwhile()
            yield from ray.get(done)
    finally:
        ray.shutdown()


def connected_ray(address: str | None) -> Any:
    """The module ``ray``, connected to the cluster at an address; None starts Ray on this machine.

    Raises
    ------
    ValueError
        if ray is not installed, or no cluster is at the address.
    """
    try:
        import ray
    except ModuleNotFoundError as error:
        raise ValueError(f"a Ray cluster needs ray ({install_command('ray')})") from error
    host, _, port = (address or "").rpartition(":")
    try:
        if host and "//" not in host and port.isdecimal():
            socket.create_connection(
                (host, int(port)), CONNECT_WITHIN_S
            ).close()  # Ray waits minutes
        ray.init(address=address, log_to_driver=False)
    except (OSError, OverflowError, ValueError, RuntimeError) as error:
        raise ValueError(f"no Ray cluster at {address!r}: {error}") from error
    return ray
