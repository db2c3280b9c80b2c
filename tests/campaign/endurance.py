"""Environments for a long time: ten million steps, a thousand of them, in other processes, with a wrong clock.

    python tests/campaign/endurance.py steps
    python tests/campaign/endurance.py many
    python tests/campaign/endurance.py starts
    python tests/campaign/endurance.py clock

``steps`` and ``many`` look for growth: of the memory that the system counts (RSS), of the memory that Python
counts (tracemalloc), of open files and of threads. ``starts`` compares what environments return in processes
started by fork, spawn and forkserver and in threads with what they return here, bit for bit. ``clock`` runs
commands under a clock that jumps (libfaketime), and compares every byte of their results.
"""

from __future__ import annotations

import argparse
import gc
import hashlib
import multiprocessing
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
import tracemalloc
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from campaign import jobs, record

import tlf_env

MIB = 2**20
RSS_GROWTH_MIB = 4.0  # of a phase, after its first fifth: the allocator's own unevenness
TRACED_GROWTH_KIB = (
    200.0  # of caches that are still being filled; of 1000 environments 0.2 KiB each
)
WARM = 0.2
SAMPLES = 20
FAKETIME = Path("/usr/lib/x86_64-linux-gnu/faketime/libfaketime.so.1")


class Sample(NamedTuple):
    """What a process holds."""

    rss_mib: float
    traced_kib: float  # 0 without tracemalloc
    files: int
    threads: int


def sample() -> Sample:
    """What this process holds now, garbage not counted."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return Sample(
        pages * os.sysconf("SC_PAGE_SIZE") / MIB,
        tracemalloc.get_traced_memory()[0] / 1024 if tracemalloc.is_tracing() else 0.0,
        len(list(Path("/proc/self/fd").iterdir())),
        len(list(Path("/proc/self/task").iterdir())),
    )


def grown(samples: list[Sample], rss_mib: float = RSS_GROWTH_MIB) -> list[str]:
    """What has grown from the first fifth of the samples to the last ones."""
    first = samples[max(1, int(WARM * len(samples))) :][0]
    last = samples[-1]
    limits = Sample(rss_mib, TRACED_GROWTH_KIB, 0, 0)
    return [
        f"{name} has grown from {before:.1f} to {after:.1f}"
        for name, before, after, limit in zip(Sample._fields, first, last, limits, strict=True)
        if after - before > limit
    ]


# --- steps

PARALLEL = (
    ("infinity", {"disturbance": "slip-noise"}),
    ("infinity", {"disturbance": "combined-hard"}),
    ("flower", {"disturbance": "slip", "horizon_s": 20.0}),
    ("warehouse", {"disturbance": "noise", "horizon_s": 10.0}),
    ("infinity", {"action": "torque", "observation": "sensor"}),
)


def parallel_steps() -> Iterator[int]:
    """Steps of PettingZoo's environment, with random actions; each scenario for some episodes in turn."""
    drawn = np.random.default_rng(0).uniform(-1, 1, (4096, 2)).astype(np.float32)
    envs = [tlf_env.parallel_env(name, **fields) for name, fields in PARALLEL]
    shares = (20, 8, 5, 1, 4)  # episodes of each
    episode, number = 0, 0
    while True:
        for env, share in zip(envs, shares, strict=True):
            for _ in range(share):
                env.reset(seed=episode)
                episode += 1
                while env.agents:
                    env.step(
                        {agent: drawn[(number + i) % 4096] for i, agent in enumerate(env.agents)}
                    )
                    number += 1
                    yield 1


def single_steps() -> Iterator[int]:
    """Steps of Gymnasium's environment."""
    rng = np.random.default_rng(1)
    env = gymnasium.make("tlf_env/Infinity-v0", learner="robot_1", disturbance="slip")
    episode = 0
    while True:
        env.reset(seed=episode)
        episode, ended = episode + 1, False
        while not ended:
            _, _, terminated, truncated, _ = env.step(rng.uniform(-1, 1, 2))
            ended = terminated or truncated
            yield 1


def vector_steps() -> Iterator[int]:
    """Steps of Gymnasium's vector environment of 64 formations, which reset themselves."""
    rng = np.random.default_rng(2)
    envs = gymnasium.make_vec(
        "tlf_env/Infinity-v0", num_envs=64, vectorization_mode="vector_entry_point"
    )
    envs.reset(seed=0)
    while True:
        envs.step(rng.uniform(-1, 1, (64, 2)))
        yield 64


def batch_steps() -> Iterator[int]:
    """Steps of the batch plant of 1024 formations of two scenarios, finished ones reset."""
    rng = np.random.default_rng(3)
    some = [
        tlf_env.load_scenario("infinity", disturbance=one, horizon_s=10.0)
        for one in ("slip-noise", "combined-hard")
    ]
    plant = tlf_env.BatchPlant(some, 1024, mixture=True)
    plant.reset(0)
    actions = rng.uniform(-1, 1, (64, *plant.arrays.actions.shape))
    number = 0
    while True:
        plant.step(actions[number % 64])
        plant.reset_finished()
        number += 1
        yield 1024


STEPS: dict[str, tuple[Callable[[], Iterator[int]], int]] = {
    "parallel_env": (parallel_steps, 1_000_000),
    "gymnasium env": (single_steps, 300_000),
    "vector env": (vector_steps, 1_000_000),
    "batch plant": (batch_steps, 7_700_000),
}


def watched(
    steps: Iterator[int], count: int, bar: Callable[[int], None] = lambda done: None
) -> tuple[int, list[Sample]]:
    """Take at least so many steps; how many they were, and samples at even intervals."""
    done, samples = 0, [sample()]
    while done < count:
        some = next(steps)
        done += some
        bar(some)
        if done >= len(samples) * count / SAMPLES:
            samples.append(sample())
    return done, samples


def campaign_steps(outcome: record.Outcome, share: float) -> None:
    """Ten million steps; then a hundredth of them with tracemalloc."""
    warnings.simplefilter("ignore")
    for name, (make, count) in STEPS.items():
        with tqdm(total=int(count * share), desc=name, unit="step", mininterval=5) as bar:
            done, samples = watched(make(), int(count * share), bar.update)
        outcome.figures[name] = {
            "steps": done,
            "first": samples[min(4, len(samples) - 1)]._asdict(),
            "last": samples[-1]._asdict(),
        }
        outcome.case(f"{name}, steps", grown(samples), done)
        tracemalloc.start()
        done, samples = watched(make(), max(2000, int(count * share / 100)))
        tracemalloc.stop()
        outcome.figures[f"{name}, tracemalloc"] = {
            "steps": done,
            "first_kib": round(samples[min(4, len(samples) - 1)].traced_kib, 1),
            "last_kib": round(samples[-1].traced_kib, 1),
        }
        # Memory as the system counts it has room for what tracemalloc keeps, and for pages touched at last.
        found = grown(samples, rss_mib=np.inf)
        outcome.case(f"{name}, steps with tracemalloc", found, done)


# --- many


def _parallel(seed: int, **options: Any) -> None:
    env = tlf_env.parallel_env("infinity", disturbance="slip", **options)
    env.reset(seed=seed)
    for _ in range(3):
        env.step({agent: np.zeros(2) for agent in env.agents})
        if options:
            env.render()
    env.close()


def _aec(seed: int) -> None:
    env = tlf_env.aec_env("infinity")
    env.reset(seed=seed)
    for _ in range(6):
        env.step(np.zeros(2))
    env.close()


def _single(seed: int, **options: Any) -> None:
    env = gymnasium.make("tlf_env/Flower-v0", learner="robot_1", **options)
    env.reset(seed=seed)
    for _ in range(3):
        env.step(np.zeros(2))
        if options:
            env.render()
    env.close()


def _vector(seed: int) -> None:
    envs = gymnasium.make_vec(
        "tlf_env/Infinity-v0", num_envs=24, vectorization_mode="vector_entry_point", threads=2
    )
    envs.reset(seed=seed)
    envs.step(np.zeros((24, 2)))
    envs.close()


def _batch(seed: int) -> None:
    plant = tlf_env.BatchPlant("infinity", 24, threads=2)
    plant.reset(seed)
    plant.step(np.zeros(plant.arrays.actions.shape))


def _world(seed: int) -> None:
    env = tlf_env.parallel_env("warehouse", rays={"count": 16})
    env.reset(seed=seed)
    env.step({agent: np.zeros(2) for agent in env.agents})
    env.close()


MANY: dict[str, Callable[[int], None]] = {
    "parallel_env": _parallel,
    "parallel_env, images": lambda seed: _parallel(seed, render_mode="rgb_array"),
    "parallel_env, window": lambda seed: _parallel(seed, render_mode="human"),
    "aec_env": _aec,
    "gymnasium env": _single,
    "gymnasium env, images": lambda seed: _single(seed, render_mode="rgb_array"),
    "vector env": _vector,
    "batch plant": _batch,
    "world with rays": _world,
}


def made_and_closed(
    make: Callable[[int], None], count: int, bar: Callable[[], Any] = lambda: None
) -> list[Sample]:
    """Make and close an environment so many times; samples at even intervals."""
    samples = [sample()]
    for seed in range(count):
        make(seed)
        bar()
        if (seed + 1) * SAMPLES >= len(samples) * count:
            samples.append(sample())
    return samples


def campaign_many(outcome: record.Outcome, share: float) -> None:
    """A thousand environments of each kind."""
    warnings.simplefilter("ignore")
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    count = max(20, int(1000 * share))
    for name, make in MANY.items():
        with tqdm(total=count, desc=name, unit="env", mininterval=5) as bar:
            samples = made_and_closed(make, count, bar.update)
        outcome.figures[name] = {
            "first": samples[min(4, len(samples) - 1)]._asdict(),
            "last": samples[-1]._asdict(),
        }
        outcome.case(f"{name}, made and closed", grown(samples), count)
        tracemalloc.start()
        samples = made_and_closed(make, max(40, count // 10))
        tracemalloc.stop()
        outcome.figures[f"{name}, tracemalloc"] = {
            "first_kib": round(samples[min(4, len(samples) - 1)].traced_kib, 1),
            "last_kib": round(samples[-1].traced_kib, 1),
        }
        outcome.case(
            f"{name}, made and closed with tracemalloc", grown(samples), max(40, count // 10)
        )


# --- other processes


def digest_of(kind: str) -> str:
    """A digest of all that some steps of an environment return."""
    warnings.simplefilter("ignore")
    digest, rng = hashlib.sha256(), np.random.default_rng(0)
    if kind == "parallel_env":
        env = tlf_env.parallel_env("infinity", disturbance="combined-hard")
        observations, _ = env.reset(seed=5)
        for _ in range(60):
            actions = {agent: rng.uniform(-1, 1, 2) for agent in env.agents}
            observations, rewards, *_ = env.step(actions)
            for agent in env.agents:
                digest.update(observations[agent].tobytes() + np.float64(rewards[agent]).tobytes())
    elif kind == "gymnasium env":
        single = gymnasium.make("tlf_env/Infinity-v0", learner="robot_1", disturbance="slip")
        single.reset(seed=5)
        for _ in range(60):
            seen, reward, *_ = single.step(rng.uniform(-1, 1, 2))
            digest.update(seen.tobytes() + np.float64(reward).tobytes())
    elif kind == "vector env":
        envs = gymnasium.make_vec(
            "tlf_env/Infinity-v0", num_envs=17, vectorization_mode="vector_entry_point", threads=2
        )
        envs.reset(seed=5)
        for _ in range(60):
            rows, rewards, *_ = envs.step(rng.uniform(-1, 1, (17, 2)))
            digest.update(rows.tobytes() + rewards.tobytes())
    else:
        plant = tlf_env.BatchPlant("flower", 17, disturbance="slip-noise", threads=2)
        plant.reset(5)
        for _ in range(60):
            plant.step(rng.uniform(-1, 1, plant.arrays.actions.shape))
            digest.update(plant.observations.tobytes() + plant.rewards.tobytes())
    return digest.hexdigest()


KINDS = ("parallel_env", "gymnasium env", "vector env", "batch plant")
METHODS = ("fork", "spawn", "forkserver", "threads")


def digests_in(method: str, kinds: tuple[str, ...], workers: int) -> list[list[str]]:
    """Digests of each kind from several workers at once."""
    jobs_ = [kind for kind in kinds for _ in range(workers)]
    if method == "threads":
        with ThreadPoolExecutor(workers) as threads:
            found = list(threads.map(digest_of, jobs_))
    else:
        with multiprocessing.get_context(method).Pool(workers) as pool:
            found = pool.map(digest_of, jobs_, chunksize=1)
    return [found[i * workers : (i + 1) * workers] for i in range(len(kinds))]


def campaign_starts(outcome: record.Outcome, share: float) -> None:
    """Every kind of environment, by every way to start it, three at once."""
    here = {kind: digest_of(kind) for kind in KINDS}
    for method in tqdm(METHODS, unit="method"):
        for _ in range(max(1, int(3 * share))):
            for kind, found in zip(KINDS, digests_in(method, KINDS, 3), strict=True):
                wrong = [f"{kind} differs" for one in found if one != here[kind]]
                outcome.case(f"{method}, {kind}", wrong, len(found))


# --- clocks

CLOCKS = {
    "a day ahead": "+1d",
    "ten years back": "-10y",
    "ten times as fast": "+0 x10",
    "a tenth as fast": "+0 x0.1",
    "jumps ahead by an hour at each look": "+0 i3600",
}


def campaign_clock(outcome: record.Outcome, share: float, only: tuple[str, ...] = ()) -> None:
    """Small jobs under a clock that is wrong, or jumps back and forth while they run; ``only`` some of them.

    Raises
    ------
    FileNotFoundError
        without libfaketime (Debian's package faketime).
    """
    if not FAKETIME.exists():
        raise FileNotFoundError(f"{FAKETIME}: install the package faketime")
    base = Path(tempfile.mkdtemp(prefix="clock-"))
    learning = ("train",) if find_spec("stable_baselines3") else ()  # of the extra train
    for name in ("run", "bench", "tune", *learning):
        if only and name not in only:
            continue
        job = jobs.JOBS[name]
        jobs.prepare(base / name / "usual", job)
        jobs.run_whole(base / name / "usual", job, jobs.Started)
        wanted = job.result(base / name / "usual" / jobs.OUT)
        for clock in (*CLOCKS, "jumps back and forth"):
            place = base / name / clock
            jobs.prepare(place, job)
            wrong = _under_clock(place, job, clock, wanted)
            outcome.case(f"{name}, clock: {clock}", wrong)
    shutil.rmtree(base)


def _under_clock(place: Path, job: jobs.Job, clock: str, wanted: dict[str, Any]) -> list[str]:
    settings = {"LD_PRELOAD": str(FAKETIME), "FAKETIME_DONT_RESET": "1"}
    jumps, done = place / "faketime", threading.Event()
    if clock in CLOCKS:
        settings["FAKETIME"] = CLOCKS[clock]
    else:  # read at every look at the clock; monotonic clocks of the system never jump, so these do not
        jumps.write_text("+0\n")
        settings |= {
            "FAKETIME_TIMESTAMP_FILE": str(jumps),
            "FAKETIME_NO_CACHE": "1",
            "FAKETIME_DONT_FAKE_MONOTONIC": "1",
        }

    def jump() -> None:
        rng = np.random.default_rng(0)
        while not done.wait(0.05):
            new = jumps.with_suffix(".new")
            new.write_text(f"{rng.integers(-10_000_000, 10_000_000):+d}\n")
            new.replace(jumps)

    thread = threading.Thread(target=jump)
    if clock not in CLOCKS:
        thread.start()
    started = jobs.Started(place, job.words, **settings)
    try:
        status = started.wait(600)
        if status:
            return [f"status {status}: {started.said()[-400:]}"]
    except TimeoutError as error:
        return [f"it hangs: {error}"]
    finally:
        started.end()
        done.set()
        if thread.is_alive():
            thread.join()
    found = job.result(place / jobs.OUT)
    return [
        f"{key} differs" for key in sorted({*found, *wanted}) if found.get(key) != wanted.get(key)
    ]


CAMPAIGNS = {
    "steps": campaign_steps,
    "many": campaign_many,
    "starts": campaign_starts,
    "clock": campaign_clock,
}


def main() -> int:
    """Run a campaign; 1 if anything went wrong."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("what", choices=CAMPAIGNS)
    parser.add_argument("--only", help="of steps and many kinds, of clock commands; with ; between")
    parser.add_argument("--share", type=float, default=1.0, help="of the full number of cases")
    parser.add_argument("--out", type=Path, help="default: results/campaign/endurance_WHAT.json")
    asked = parser.parse_args()
    path = asked.out or record.RESULTS / f"endurance_{asked.what}.json"
    outcome = record.Outcome(path, {k: str(v) for k, v in vars(asked).items()})
    signal.signal(signal.SIGINT, signal.default_int_handler)
    began = time.process_time()
    if asked.only:
        for kinds in (STEPS, MANY):
            for name in set(kinds) - set(asked.only.split(";")):
                del kinds[name]
    try:
        if asked.what == "clock" and asked.only:
            campaign_clock(outcome, asked.share, tuple(asked.only.split(";")))
        else:
            CAMPAIGNS[asked.what](outcome, asked.share)
    except KeyboardInterrupt:
        print("interrupted")
    outcome.figures["processor time, s"] = round(time.process_time() - began, 1)
    return outcome.report()


if __name__ == "__main__":
    sys.exit(main())
