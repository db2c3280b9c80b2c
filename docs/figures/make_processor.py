"""What limits a step on this processor: a table of ``docs/performance.md``.

``python docs/figures/make_processor.py`` samples where a batch of 1024 formations spends its time, takes the
long pieces of straight vector code from the compiled driver, and asks LLVM how many cycles each needs at
least. It runs for about a minute on Linux and needs ``perf``, ``objdump`` and ``llvm-mca`` (Debian's packages
``linux-perf``, ``binutils`` and ``llvm-16``); the processor should be one that ``llvm-mca`` knows.
"""

from __future__ import annotations

import bisect
import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
from numba.core.codegen import JITCodeLibrary

from baselines.speed.moments import DRIVEN
from tlf_env.engine import drivers
from tlf_env.engine.batch import BatchPlant
from tlf_env.engine.tiles import WIDTH
from tlf_env.numerics.compiled import driver
from tlf_env.task.actions import REFERENCE

PAGE = Path(__file__).resolve().parents[1] / "performance.md"
FORMATIONS, ROBOTS = 1024, 3
BEGUN_STEPS = 600  # all robots move by then
SAMPLED_S = 15.0
HERTZ = 4000
LONG = 100  # vector instructions of a piece that gets a row
REPEATS = 50  # of a piece, for its cycles where it follows itself
CHAIN = 200_000_000
CYCLES_OF_A_LINK = (
    6  # three shifts and three exclusive ors, one cycle each on AMD's and Intel's processors
)

objects: dict[str, bytes] = {}  # machine code by the name of what Numba compiled


class Block(NamedTuple):
    """A piece of straight code: instructions that are run one after the other."""

    instructions: list[str]
    samples: int

    def count(self, pattern: str) -> int:
        """How many instructions match."""
        return sum(bool(re.match(pattern, one)) for one in self.instructions)

    @property
    def vectors(self) -> int:
        """Instructions on whole vectors."""
        return sum("%zmm" in one or "%ymm" in one for one in self.instructions)


class Bounds(NamedTuple):
    """Cycles of a block by LLVM's model of the processor."""

    full: float  # as if no instruction waited for another
    repeated: float  # where it follows itself


@driver
def chain(links: int) -> int:
    """So many links of three shifts and three exclusive ors, each of which needs the one before."""
    x = np.uint64(1)
    for _ in range(links):
        x ^= x << np.uint64(13)
        x ^= x >> np.uint64(7)
        x ^= x << np.uint64(17)
    return int(x >> np.uint64(33))


def measured_clock() -> float:
    """The clock in GHz while it works, by a chain of instructions whose latency is known."""
    chain(1)
    best = min(_seconds(chain, CHAIN) for _ in range(5))
    return CHAIN * CYCLES_OF_A_LINK / best / 1e9


def _seconds(function: Any, *arguments: Any) -> float:
    begun = time.process_time()
    function(*arguments)
    return time.process_time() - begun


def keep_objects() -> None:
    """Keep the machine code of what is compiled, or loaded from the cache, from now on."""
    before = JITCodeLibrary._set_compiled_object

    def keep(self: Any, code: bytes) -> None:
        objects[self.name] = bytes(code)
        before(self, code)

    JITCodeLibrary._set_compiled_object = keep


def plant_in_motion() -> BatchPlant:
    """All robots driven by the reference, after the start."""
    plant = BatchPlant("infinity", FORMATIONS, robots=ROBOTS, end_on=(), **DRIVEN)
    plant.reset(seed=0)
    plant.arrays.kinds[:] = REFERENCE
    return plant


def sampled(plant: BatchPlant, folder: Path) -> tuple[list[int], float]:
    """Addresses at which samples were taken while the plant runs, and µs of a formation step."""
    idle = np.zeros(plant.arrays.actions.shape)
    for _ in range(BEGUN_STEPS):
        plant.step(idle)
    data = folder / "perf.data"
    call = ["perf", "record", "-q", "-e", "cpu-clock", "-F", str(HERTZ), "-o", str(data)]
    perf = subprocess.Popen([*call, "-p", str(os.getpid())], stderr=subprocess.DEVNULL)
    time.sleep(1.0)
    end, steps, used = time.monotonic() + SAMPLED_S, 0, time.process_time()
    while time.monotonic() < end:
        plant.step(idle)
        steps += 1
    used = time.process_time() - used
    perf.send_signal(signal.SIGINT)
    perf.wait()
    found = subprocess.run(
        ["perf", "script", "-i", str(data), "-F", "ip"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    return [int(one, 16) for one in found.split()], used / steps / FORMATIONS * 1e6


def code_of(folder: Path) -> tuple[list[int], list[str], list[str], int]:
    """Addresses, instructions and functions of the driver's machine code, and where it lies in memory."""
    result = next(iter(drivers.control_step.overloads.values()))
    name = result.fndesc.llvm_func_name
    place = result.library.get_pointer_to_function(name)
    file = folder / "driver.o"
    file.write_bytes(objects["control_step"])
    text = subprocess.run(
        ["objdump", "-d", "--no-show-raw-insn", str(file)],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    addresses, instructions, functions, function = [], [], [], ""
    first = 0
    for line in text.splitlines():
        if head := re.match(r"^([0-9a-f]+) <(.*)>:$", line):
            function = head[2]
            first = int(head[1], 16) if function == name else first
        elif body := re.match(r"^\s+([0-9a-f]+):\t(.*)$", line):
            addresses.append(int(body[1], 16))
            instructions.append(re.sub(r"\s*(#.*|<.*>)", "", body[2]))
            functions.append(function)
    return addresses, instructions, functions, place - first


def blocks_of(samples: list[int], folder: Path) -> tuple[list[Block], int]:
    """All blocks that run the substeps, and how many samples there are in all."""
    addresses, instructions, functions, base = code_of(folder)
    hits = Counter(
        bisect.bisect_right(addresses, one - base) - 1
        for one in samples
        if 0 <= one - base <= addresses[-1]
    )
    jumps = (re.match(r"j\w+\s+([0-9a-f]+)", one) for one in instructions)
    targets = {int(jump[1], 16) for jump in jumps if jump}
    starts = [
        i
        for i in range(len(instructions))
        if i == 0 or addresses[i] in targets or instructions[i - 1].startswith(("j", "ret"))
    ]
    found = []
    for start, stop in zip(starts, [*starts[1:], len(instructions)], strict=True):
        if "tiles" in functions[start]:
            count = sum(hits[i] for i in range(start, stop))
            found.append(Block(instructions[start:stop], count))
    return found, len(samples)


def bounds_of(block: Block) -> Bounds:
    """Cycles of a block by ``llvm-mca``."""
    text = "\n".join(one for one in block.instructions if not one.startswith(("j", "call", "ret")))
    found = subprocess.run(
        [mca(), f"-mcpu={cpu()}", f"-iterations={REPEATS}"],
        input=text,
        capture_output=True,
        text=True,
    )
    if found.returncode:
        raise SystemExit(f"{mca()} cannot read a block:\n{found.stderr}")
    full = re.search(r"Block RThroughput:\s+([\d.]+)", found.stdout)
    total = re.search(r"Total Cycles:\s+(\d+)", found.stdout)
    if full is None or total is None:
        raise SystemExit(f"llvm-mca printed no cycles for {cpu()}")
    return Bounds(float(full[1]), float(total[1]) / REPEATS)


def mca() -> str:
    """The program, whose name may end in a version; the newest one."""
    for name in (*(f"llvm-mca-{version}" for version in range(30, 15, -1)), "llvm-mca"):
        if shutil.which(name):
            return name
    raise SystemExit("llvm-mca is not installed (Debian: llvm-16)")


def cpu() -> str:
    """LLVM's name of this processor."""
    import llvmlite.binding as llvm

    return str(llvm.get_host_cpu_name())


def law_of(block: Block, most_divisions: int) -> str:
    """What a block computes, by what is particular to it."""
    if block.count("vpmuludq") > LONG // 5:
        return "noise of the position fixes"
    if block.count("v(div|sqrt)") == most_divisions:
        return "plant, while all wheels roll"
    return "filter, odometry and sums"


def table(blocks: list[Block], samples: int, step_us: float, GHz: float) -> str:
    """The table and what follows from it."""
    long = sorted((one for one in blocks if one.vectors >= LONG), key=lambda one: -one.samples)
    long = [one for one in long if one.samples > samples / 100]
    most = max(one.count("v(div|sqrt)") for one in long)
    tiles = ROBOTS * drivers_substeps() / WIDTH  # tile substeps of a formation step
    rows, full_us, spent_us = [], 0.0, 0.0
    for one in long:
        bounds = bounds_of(one)
        spent = one.samples / samples * step_us
        cycles = spent / tiles * GHz * 1e3
        full_us += bounds.full * tiles / GHz / 1e3
        spent_us += spent
        rows.append(
            f"| {law_of(one, most)} | {len(one.instructions)} | {one.count('v(div|sqrt)')} | "
            f"{bounds.full:.0f} | {bounds.repeated:.0f} | {cycles:.0f} | {spent:.2f} |"
        )
    return "\n".join(
        [
            f"{FORMATIONS} formations of {ROBOTS} robots, {step_us:.1f} µs of processor time for a "
            f"formation step while sampled, {tiles:g} tile substeps each, {GHz:.1f} GHz, `{cpu()}`:",
            "",
            "| piece of vector code | instructions | divisions and roots | cycles, nothing waits | "
            "cycles, following itself | cycles, measured | µs of a formation step |",
            "|---|---:|---:|---:|---:|---:|---:|",
            *rows,
            "",
            f"Together {spent_us:.1f} of {step_us:.1f} µs. If nothing in them waited, they would take "
            f"{full_us:.1f} µs, and the step {step_us - spent_us + full_us:.1f} µs.",
        ]
    )


def drivers_substeps() -> int:
    """Substeps of a control step."""
    from tlf_env.task.scenario import load_scenario

    return load_scenario("infinity").substeps


def main() -> None:
    """Measure, and write the table into the page."""
    mca()
    keep_objects()
    plant = plant_in_motion()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        samples, step_us = sampled(plant, folder)
        blocks, count = blocks_of(samples, folder)
        found = table(blocks, count, step_us, measured_clock())
    print(found)
    page = PAGE.read_text()
    marked = re.sub(
        r"(<!-- processor -->\n).*?(<!-- end -->)",
        lambda match: f"{match[1]}{found}\n{match[2]}",
        page,
        flags=re.DOTALL,
    )
    PAGE.write_text(marked)


if __name__ == "__main__":
    if numba.config.DISABLE_JIT:
        raise SystemExit("Numba is switched off (NUMBA_DISABLE_JIT)")
    main()
