"""What the laws of a substep need on a GPU: the table of ``docs/accelerator.md``, from NVIDIA's assembler.

``python docs/figures/make_accelerator.py`` compiles the laws, as they are, with numba-cuda for one robot in
each thread, and counts registers and instructions. No GPU is needed, and nothing is run. It needs the extras
``bench`` and ``figures``, and ``pip install numba-cuda nvidia-cuda-nvcc nvidia-nvvm nvidia-cuda-nvrtc``.
"""

from __future__ import annotations

import re
import subprocess
import tempfile
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numba.extending
from numba import cuda
from numba.cuda import dispatcher, extending, libdevice

PAGE = Path(__file__).resolve().parents[1] / "accelerator.md"
CAPABILITY = (9, 0)  # of an H100 or H200


class Device:
    """What numba-cuda asks of a device when a function calls another one."""

    compute_capability = CAPABILITY


def on_device(function: Callable[..., Any]) -> Any:
    """A law or block as a function of the device."""
    return cuda.jit(device=True)(function)


def use_device() -> None:
    """Compile the laws that are imported from now on for the device."""
    from tlf_env.numerics import compiled

    dispatcher.get_current_device = Device
    compiled.law = compiled.block = compiled.allocating = compiled.view = on_device
    compiled.law_in_double = compiled.by_number = on_device
    compiled.driver = lambda function: function
    of_processor = numba.extending.intrinsic

    def intrinsic(*function: Any, **options: Any) -> Any:
        """Of the device, but tables, which want literals: no kernel has them."""
        return of_processor(**options) if options else extending.intrinsic(*function)

    numba.extending.intrinsic = intrinsic
    from tlf_env.numerics import angles, memory, trig  # noqa: F401 - while `intrinsic` is that of the device

    numba.extending.intrinsic = of_processor  # no kernel uses those of the other modules
    from tlf_env.engine import sensors

    rounding = types.ModuleType("rounding")  # NumPy's functions of these names are not there
    rounding.rint, rounding.floor, rounding.sqrt = libdevice.rint, libdevice.floor, libdevice.sqrt
    for module in (sensors, angles, trig):
        module.np = rounding


def kernels() -> dict[str, tuple[Callable[..., None], Any]]:
    """The kernels by name, with their types; row r of robot i is ``robots[r, i]``, as in a tile."""
    from tlf_env.engine import tile_rows as rows
    from tlf_env.engine.layout import Draw, Reading, WheelPair, YawRate
    from tlf_env.engine.sensors import (
        account_robot,
        correct_robot,
        measured_fix,
        odometry_of,
        predict_robot,
    )
    from tlf_env.engine.substeps import commanded_torques, floor_under, trace_drive, undisturbed
    from tlf_env.onboard.kinds import EKF_SLIP
    from tlf_env.physics.vehicle import Push, advance_pose, roll, slide

    body_of, order_of, effects_of = rows.body_of, rows.order_of, rows.effects_of
    loop_of, belief_of, ekf_of = rows.loop_of, rows.belief_of, rows.ekf_of
    slip_ekf_of, traction_of, push_of = rows.slip_ekf_of, rows.traction_of, rows.push_of
    motion_of, set_motion = rows.motion_of, rows.set_motion
    contact_of, set_contact = rows.contact_of, rows.set_contact
    held_of, set_held = rows.held_of, rows.set_held
    sensors_of, set_sensors = rows.sensors_of, rows.set_sensors
    estimate_of, set_estimate = rows.estimate_of, rows.set_estimate
    slip_of, set_slip = rows.slip_of, rows.set_slip
    trace_of, set_trace = rows.trace_of, rows.set_trace

    def plant(law: Any) -> Callable[[Any, float], None]:
        """A substep of the plant by one of its two laws."""

        def kernel(robots: Any, dt: float) -> None:
            i = cuda.grid(1)
            if i < robots.shape[1]:
                body, traction = body_of(robots, i), traction_of(robots, i)
                found = law(
                    body,
                    motion_of(robots, i),
                    contact_of(robots, i),
                    floor_under(body, effects_of(robots, i), traction),
                    push_of(robots, i),
                    traction.delivered_l,
                    traction.delivered_r,
                    dt,
                )
                set_motion(robots, i, advance_pose(found[-2], dt))
                set_contact(robots, i, found[-1])

        return kernel

    def step(robots: Any, draws: Any, substeps: int, dt: float) -> None:
        i = cuda.grid(1)
        if i >= robots.shape[1]:
            return
        body, order, effects = body_of(robots, i), order_of(robots, i), effects_of(robots, i)
        loop, belief = loop_of(robots, i), belief_of(robots, i)
        ekf, slip_ekf = ekf_of(robots, i), slip_ekf_of(robots, i)
        motion, contact, held = motion_of(robots, i), contact_of(robots, i), held_of(robots, i)
        sensors, estimate = sensors_of(robots, i), estimate_of(robots, i)
        slip, trace = slip_of(robots, i), trace_of(robots, i)
        for substep in range(substeps):
            left, right, held = commanded_torques(body, loop, order, held, sensors, substep)
            traction = undisturbed(left, right, effects)
            _, moved, contact = roll(
                body,
                motion,
                contact,
                floor_under(body, effects, traction),
                Push(0.0, 0.0, 0.0),
                traction.delivered_l,
                traction.delivered_r,
                dt,
            )
            trace = trace_drive(trace, body.torque_limit, traction, moved, contact, dt)
            motion = advance_pose(moved, dt)
            draw = Draw(draws[0, i], i, draws[1, i], draws[2, i] + substep + 1)
            reading = Reading(motion.angle_l, motion.angle_r)
            fix = measured_fix(body, motion, effects, draw)
            increments = odometry_of(body, belief, reading, sensors)
            sensors, estimate, slip = predict_robot(
                body,
                belief,
                ekf,
                slip_ekf,
                motion,
                increments,
                sensors,
                estimate,
                slip,
                order,
                substep,
                EKF_SLIP,
                dt,
            )
            estimate, slip, innovation = correct_robot(
                ekf, slip_ekf, fix, sensors, estimate, slip, EKF_SLIP
            )
            sensors, trace, _ = account_robot(
                reading,
                fix,
                YawRate(motion.w),
                WheelPair(left, right),
                increments,
                sensors,
                estimate,
                slip,
                trace,
                innovation,
                dt,
            )
        set_motion(robots, i, motion)
        set_contact(robots, i, contact)
        set_held(robots, i, held)
        set_sensors(robots, i, sensors)
        set_estimate(robots, i, estimate)
        set_slip(robots, i, slip)
        set_trace(robots, i, trace)

    of_plant = (numba.float64[:, ::1], numba.float64)
    of_step = (numba.float64[:, ::1], numba.int64[:, ::1], numba.int64, numba.float64)
    return {
        "plant, all wheels roll": (plant(roll), of_plant),
        "plant, sweeps": (plant(slide), of_plant),
        "control step: wheel loops, plant, noise, `ekf-slip`": (step, of_step),
    }


class Need(NamedTuple):
    """What a kernel needs."""

    registers: int
    spilled_bytes: int
    floats: int  # instructions on doubles
    fused: int  # of these multiplications and additions with one rounding
    divisions: int  # of ``floats`` divisions and square roots, which are programs of their own
    products: int  # products of whole numbers: random numbers


def need_of(kernel: Callable[..., None], signature: Any, registers: int) -> Need:
    """Compile a kernel, with at most so many registers for a thread."""
    code, _ = cuda.compile_ptx(kernel, signature, cc=CAPABILITY)
    architecture = f"sm_{CAPABILITY[0]}{CAPABILITY[1]}"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "kernel.ptx"
        path.write_text(code, encoding="utf-8")
        command = [assembler(), "-v", f"-arch={architecture}", f"-maxrregcount={registers}"]
        done = subprocess.run(
            [*command, str(path), "-o", str(path.with_suffix(".bin"))],
            check=True,
            capture_output=True,
            text=True,
        )
    used, spilled = (
        re.findall(pattern, done.stderr)[-1]
        for pattern in (r"Used (\d+) registers", r"(\d+) bytes spill stores")
    )
    lines = code.splitlines()
    return Need(
        registers=int(used),
        spilled_bytes=int(spilled),
        floats=sum(".f64" in line and "mov" not in line and "ld." not in line for line in lines),
        fused=sum("fma.rn.f64" in line for line in lines),
        divisions=sum(bool(re.search(r"(div|sqrt|rcp)\.rn\.f64", line)) for line in lines),
        products=sum(bool(re.search(r"mul\.(lo|hi|wide)\.", line)) for line in lines),
    )


def assembler() -> str:
    """The assembler that belongs to the compiler."""
    import nvidia

    for place in nvidia.__path__:
        for path in Path(place).glob("*/bin/ptxas"):
            return str(path)
    raise FileNotFoundError("ptxas of the package nvidia-cuda-nvcc")


def main() -> None:
    """Compile the kernels with as many registers as they like and with 128, and write the table."""
    use_device()
    from make_parts import put  # imports laws, which are compiled for the device from here on
    from make_speed import table

    rows = []
    for name, (kernel, signature) in kernels().items():
        free, few = (need_of(kernel, signature, most) for most in (255, 128))
        rows.append([name, *map(str, free), str(few.spilled_bytes)])
    head = ["", "registers", "spilled, bytes", "on doubles", "of these fused"]
    head += ["divisions and roots", "integer products", "spilled with 128 registers, bytes"]
    put(PAGE, table(head, rows), "accelerator")


if __name__ == "__main__":
    main()
