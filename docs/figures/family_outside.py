"""Pictures of what acts on the robots from outside: slip, grip, floor. Laws are dashed, the rest simulated."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from family_runs import (
    FREE,
    GRAVITY,
    LAW,
    MASS_KG,
    RADIUS_MM,
    ROBOT,
    STYLES,
    course,
    followed,
    legend,
    open_loop,
    panels,
    speed,
    times,
)
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from baselines.runs.run import Record
from baselines.runs.style import GREY, MARKERS
from tlf_env.physics.friction import coefficient

TYRE = ROBOT.tyre
# Mass that a robot on a straight line moves, with the spins of its three wheels.
ROLLING_KG = (
    MASS_KG
    + 2 * ROBOT.wheel_inertia_kg_mm2 / RADIUS_MM**2
    + ROBOT.castor_inertia_kg_mm2 / ROBOT.castor_radius_mm**2
)

# --- slip ----------------------------------------------------------------------------------------

SLIP = "slip.delta_1_mm_s"


def slip_shapes() -> dict[str, dict[str, Any]]:
    """Panels of the slip's picture: the signals of δ₁ by their labels."""
    draws = {"type": "uniform", "low": -60, "high": 60, "every_s": 3}
    return {
        "Ramps (`ramp_s`), the draws of `slip`": {
            "0.2 s (slip-ramps)": draws | {"ramp_s": 0.2},
            "3 s": draws | {"ramp_s": 3},
        },
        "Band-limited noise (`correlation_s`)": {
            "0.5 s (slip-noise)": {"type": "band_limited", "std": 30, "correlation_s": 0.5},
            "5 s": {"type": "band_limited", "std": 30, "correlation_s": 5},
        },
        "Sines (`frequency_hz`)": {
            "0.3 Hz (slip-sines)": {"type": "sine", "amplitude": 40, "frequency_hz": 0.3},
            "0.05 Hz": {"type": "sine", "amplitude": 40, "frequency_hz": 0.05},
        },
        "Ornstein–Uhlenbeck noise (`time_constant_s`)": {
            "0.5 s": {"type": "ornstein_uhlenbeck", "std": 30, "time_constant_s": 0.5},
            "5 s": {"type": "ornstein_uhlenbeck", "std": 30, "time_constant_s": 5},
        },
    }


def draw_slip(figure: Figure) -> None:
    """Slip of every shape over time."""
    shapes = slip_shapes()
    names = [name.replace("`", "") for name in shapes] + [
        "Steps every 3 s (slip)",
        "Each wheel by itself, band-limited noise of 0.5 s",
    ]
    found = panels(figure, names, sharex=True, sharey=True)
    for axes, signals in zip(found, shapes.values(), strict=False):
        for style, (label, signal) in zip(STYLES, signals.items(), strict=False):
            values = course({"slip": {"delta_1_mm_s": signal}}, SLIP, 20.0)[:, 0]
            axes.plot(times(values), values, lw=1.0, label=label, **style)
    steps = course("slip", SLIP, 20.0)
    for i, style in enumerate(STYLES[: steps.shape[1]]):
        found[4].plot(times(steps), steps[:, i], lw=1.0, label=f"robot {i}", **style)
    noise = {"type": "band_limited", "std": 30, "correlation_s": 0.5}
    for style, side in zip(STYLES, ("left", "right"), strict=False):
        both = {"slip": {"left_mm_s": noise, "right_mm_s": noise}}
        values = course(both, f"slip.{side}_mm_s", 20.0)[:, 0]
        found[5].plot(times(values), values, lw=1.0, label=side, **style)
    for axes in found:
        legend(axes, loc="lower left", ncols=3)
        axes.set_ylim(-135, 110)
    for axes in found[::2]:
        axes.set_ylabel("slip $\\delta_1$ (mm/s)")
    found[5].set_ylabel("slip of a wheel (mm/s)")
    for axes in found[-2:]:
        axes.set_xlabel("time (s)")


# --- grip ----------------------------------------------------------------------------------------


def creep_points(creep: float) -> tuple[np.ndarray, np.ndarray]:
    """Slip over rolling speed and force over load of the drive wheels, at constant torques."""
    twice = {"torque_gain_l": 2.0, "torque_gain_r": 2.0}
    slips, forces = [], []
    for share in np.linspace(0.05, 0.8, 16):
        record = open_loop(
            lambda t_s, share=share: (share, share),
            2.0,
            robot=FREE,
            disturbance={"tyre": {"creep": creep}, "actuator": twice},
        )
        rolling = RADIUS_MM * record["omega_l_rad_s"][:, 0]
        late = record.t_s > 1.0
        moved = np.polyfit(record.t_s[late], record["y_mm"][late, 0], 2)
        castor_kg = ROBOT.castor_inertia_kg_mm2 / ROBOT.castor_radius_mm**2
        force = (MASS_KG + castor_kg) * 2 * moved[0] / 2
        slips.append(1 - np.polyval(np.polyder(moved), record.t_s[-1]) / rolling[-1])
        forces.append(force / (ROBOT.drive_load_share * MASS_KG * GRAVITY))
    return np.array(slips), np.array(forces)


def draw_grip(figure: Figure) -> None:
    """Friction, creep, split friction and patches."""
    names = (
        "Friction of a tyre (friction_scale)",
        "Creep: force of a tyre against its slip",
        "Slip of the faster slipping drive wheel, robot 1 under tuned",
        "Patches (patches), robot 1 under tuned",
    )
    curve, creep, skids, floor = panels(figure, names)
    slips = np.linspace(0.0, 6.0, 301)
    mu = np.array(
        [
            coefficient(
                v,
                TYRE.mu_static,
                TYRE.mu_dynamic,
                TYRE.stiction_speed_mm_s,
                TYRE.dynamic_speed_mm_s,
            )
            for v in slips
        ]
    )
    for style, scale in zip(STYLES, (1.0, 0.5, 0.3), strict=False):
        curve.plot(slips, scale * mu, label=f"× {scale:g}", **style)
    curve.set(xlabel="slip speed (mm/s)", ylabel="largest force / load", ylim=(0, 0.09))
    legend(curve, ncols=3, loc="upper right")

    for style, marker, value in zip(STYLES, MARKERS, (0.0, 0.1, 0.5), strict=False):
        ratio, force = creep_points(value)
        creep.plot(
            100 * ratio,
            force,
            marker=marker,
            ms=4,
            ls="",
            mfc="none",
            color=style["color"],
            label=f"creep {value:g}",
        )
        if value:
            creep.plot(100 * value * np.array([0, TYRE.mu_static]), [0, TYRE.mu_static], **LAW)
    creep.axhline(TYRE.mu_static, **(LAW | {"ls": ":"}))
    creep.axhline(TYRE.mu_dynamic, **(LAW | {"ls": ":"}))
    creep.text(4.9, TYRE.mu_static + 0.001, "$\\mu_s$", color=GREY, ha="right")
    creep.text(4.9, TYRE.mu_dynamic + 0.001, "$\\mu_d$", color=GREY, ha="right")
    creep.set(xlabel="slip / rolling speed (%)", ylabel="force / load", xlim=(-0.2, 5))
    creep.set_ylim(0, 0.09)
    legend(creep, loc="lower right")

    for style, name in zip(STYLES, ("ice", "split-ice", "nominal"), strict=False):
        record = followed(30.0, disturbance=name)
        skids.plot(record.t_s, record["slip_mm_s"][:, 1], lw=0.9, label=name, **style)
    skids.set(xlabel="time (s)", ylabel="slip speed (mm/s)", yscale="symlog")
    skids.set_ylim(0, 1500)
    legend(skids, loc="upper right", ncols=3)

    record = followed(60.0, disturbance="patches")
    for patch in record.scenario.disturbance.tyre.patches:
        place = (patch.x_mm, patch.y_mm)
        floor.add_patch(Circle(place, patch.radius_mm, fc="0.85", ec=GREY, hatch="////", lw=0.6))
    late = record.t_s > 10.0
    x, y = record["x_mm"][late, 1], record["y_mm"][late, 1]
    slid = record["slip_mm_s"][late, 1] > 1.0
    floor.plot(x, y, lw=1.0, color="black", label="path")
    floor.plot(x[slid], y[slid], "o", ms=3, color="#D55E00", label="slips by 1 mm/s or more")
    floor.set(xlabel="x (mm)", ylabel="y (mm)", aspect="equal", xlim=(0, 10000))
    legend(floor, loc="center right")


# --- floor, pushes, contact ----------------------------------------------------------------------


def bounce(restitution: float) -> Record:
    """A robot that rolls against a wall, with and without restitution."""
    wall = {"points_mm": [[-500.0, 300.0], [500.0, 300.0]], "thickness_mm": 0.0}
    return open_loop(
        lambda t_s: (1.0, 1.0) if t_s < 1.0 else (0.0, 0.0),
        3.0,
        plant="pymunk",
        robot={"outline_restitution": restitution},
        world={"walls": [wall]},
    )


def draw_floor(figure: Figure) -> None:
    """Slope, rolling resistance, pushes and contact."""
    names = (
        "Slope: a robot let go, heading downhill",
        "Rolling resistance: coasting after 1 s of full torque",
        "Pushes (pushes), robot 0",
        "Contact: rolling against a wall, by restitution",
    )
    slope, rolling, push, contact = panels(figure, names)
    for style, alpha in zip(STYLES, (0.06, 0.04, 0.02), strict=False):
        floor = {"slope_rad": alpha, "uphill_rad": math.pi}
        record = open_loop(lambda t_s: (0.0, 0.0), 2.0, disturbance={"floor": floor})
        slope.plot(record.t_s, speed(record), label=f"{alpha:g} rad", **style)
        pull = GRAVITY * math.sin(alpha) * MASS_KG / ROLLING_KG
        slope.plot(record.t_s, pull * record.t_s, **LAW)
    slope.plot([], [], label="without joint friction", **LAW)
    slope.set(xlabel="time (s)", ylabel="speed (mm/s)", ylim=(-20, 1000))
    legend(slope, loc="upper left")

    for style, c in zip(STYLES, (0.0, 0.004, 0.02), strict=False):
        record = open_loop(
            lambda t_s: (1.0, 1.0) if t_s < 1.0 else (0.0, 0.0),
            5.0,
            disturbance={"floor": {"rolling_resistance": c}},
        )
        rolling.plot(record.t_s, speed(record), label=f"c = {c:g}", **style)
    rolling.set(xlabel="time (s)", ylabel="speed (mm/s)")
    legend(rolling, loc="upper right")

    for style, axis in zip(STYLES, "xy", strict=False):
        values = course("pushes", f"push.{axis}_N", 20.0)[:, 0]
        push.plot(times(values), values, lw=1.0, label=f"{axis} (N)", **style)
    values = course("pushes", "push.torque_Nmm", 20.0)[:, 0] / 100
    push.plot(times(values), values, lw=1.0, label="torque (100 N·mm)", **STYLES[2])
    push.set(xlabel="time (s)", ylabel="force, torque")
    push.set_ylim(-0.16, 0.12)
    legend(push, loc="lower left", ncols=3)

    for style, restitution in zip(STYLES, (0.0, 0.5, 1.0), strict=False):
        record = bounce(restitution)
        contact.plot(record.t_s, speed(record), label=f"{restitution:g}", **style)
    contact.set(xlabel="time (s)", ylabel="speed (mm/s)")
    legend(contact, loc="lower left", title="outline_restitution")
