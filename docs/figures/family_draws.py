"""Pictures of one draw of each knob of a family of disturbances, for the pages in ``docs/disturbances``.

Everything that is shown was simulated, with the seed 20000; laws that it should follow are dashed. Called by
``make_families.py``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

from baselines.policies.registry import fit_policy
from baselines.runs.plane import body_polygons
from baselines.runs.run import Record, run_policy
from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from baselines.runs.style import GREY, MARKERS, tidy
from tlf_env import BatchPlant
from tlf_env.disturbances.channels import number
from tlf_env.engine.layout import Sample
from tlf_env.engine.radio import lateness
from tlf_env.engine.settings import make_settings
from tlf_env.physics.friction import coefficient
from tlf_env.physics.vehicle import RobotParameters
from tlf_env.task.info import Info
from tlf_env.task.scenario import load_scenario
from tlf_env.task.warn import without_warnings

SEED = FIRST_TABLE_SEED
ROBOT = RobotParameters()
RADIUS_MM, MASS_KG, GRAVITY = ROBOT.wheel_radius_mm, ROBOT.mass_kg, ROBOT.gravity_mm_s2
TYRE = ROBOT.tyre
# Mass that a robot on a straight line moves, with the spins of its three wheels.
ROLLING_KG = (
    MASS_KG
    + 2 * ROBOT.wheel_inertia_kg_mm2 / RADIUS_MM**2
    + ROBOT.castor_inertia_kg_mm2 / ROBOT.castor_radius_mm**2
)
FREE = {"joint_friction": False}
# Okabe and Ito's colours, which differ in lightness; each line has its own dashes too.
STYLES: tuple[dict[str, Any], ...] = (
    {"color": "#0072B2", "ls": "-"},
    {"color": "#D55E00", "ls": "--"},
    {"color": "#009E73", "ls": "-."},
    {"color": "black", "ls": ":"},
)
LAW = {"color": GREY, "ls": (0, (4, 2)), "lw": 0.9, "zorder": 1.5}
WIDTH_IN, ROW_IN = 9.6, 2.9


def panels(figure: Figure, names: Sequence[str], **sharing: Any) -> list[Axes]:
    """Panels in two columns, each with a title."""
    rows = -(-len(names) // 2)
    figure.set_size_inches(WIDTH_IN, ROW_IN * rows)
    found = list(figure.subplots(rows, 2, **sharing).flat)[: len(names)]
    for axes, name in zip(found, names, strict=True):
        axes.set_title(name, fontsize="medium")
    tidy(*found)
    return found


def legend(axes: Axes, **where: Any) -> None:
    """A small legend."""
    axes.legend(fontsize=8, framealpha=0.9, edgecolor="none", **where)


# --- what is simulated ---------------------------------------------------------------------------


def course(disturbance: Any, path: str, seconds: float, **fields: Any) -> np.ndarray:
    """Values of a channel for robots at rest, (control step, robot)."""
    with without_warnings():
        plant = BatchPlant("infinity", 1, disturbance=disturbance, end_on=(), **fields)
    plant.reset(seed=SEED)
    rest, place = np.zeros((1, plant.scenario.robot_count, 2)), number(path)
    rows = [plant.applied[0, :, place].copy()]
    for _ in range(round(seconds / plant.scenario.control_period_s)):
        plant.step(rest)
        rows.append(plant.applied[0, :, place].copy())
    return np.array(rows)


def times(values: np.ndarray, period_s: float = 0.02) -> np.ndarray:
    """Times of the rows of a course, s."""
    return np.arange(len(values)) * period_s


class Torques:
    """A policy that commands shares of the torque limit, by the time in s."""

    def __init__(self, shares: Callable[[float], tuple[float, float]], period_s: float) -> None:
        self._shares, self._period_s = shares, period_s

    def predict(
        self, observation: np.ndarray, state: Any = None, *_: Any
    ) -> tuple[np.ndarray, int]:
        """The next actions, the same for every row; the state counts the steps."""
        step = state or 0
        return np.tile(self._shares(step * self._period_s), (len(observation), 1)), step + 1


def open_loop(
    shares: Callable[[float], tuple[float, float]], seconds: float, **fields: Any
) -> Record:
    """One robot from rest at the origin, heading +y, with given shares of its torque limit."""
    fields = {"plant": "batch", "disturbance": "none"} | fields
    with without_warnings():
        scenario = load_scenario(
            "infinity", robots=1, action="torque", horizon_s=seconds, preview_s=(), **fields
        )
        return run_policy(
            scenario,
            Torques(shares, scenario.control_period_s),
            SEED,
            options={"poses": [[0.0, 0.0, 0.0]]},
        )


def speed(record: Record) -> np.ndarray:
    """Forward speed along +y of the only robot, mm/s."""
    return np.gradient(record["y_mm"][:, 0], record.t_s)


def followed(seconds: float, **fields: Any) -> Record:
    """A run of ∞ under ``tuned``."""
    with without_warnings():
        scenario = load_scenario("infinity", plant="batch", horizon_s=seconds, **fields)
        fitted = fit_policy("reference:tuned", scenario)
        return run_policy(fitted.scenario, fitted.policy, SEED)


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
    floor.set(xlabel="x (mm)", ylabel="y (mm)", aspect="equal", xlim=(-500, 8500))
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


# --- motors --------------------------------------------------------------------------------------


def substep_speeds(disturbance: dict[str, Any], share: float, steps: int) -> np.ndarray:
    """Speed of a lifted left wheel in every substep after a torque is commanded, rad/s."""
    free = {"tyre": {"friction_scale": 0.0}}
    with without_warnings():
        plant = BatchPlant(
            "infinity",
            1,
            robots=1,
            action="torque",
            robot=FREE,
            disturbance=free | disturbance,
            end_on=(),
            preview_s=(),
        )
    plant.reset(seed=SEED)
    turned = []
    for _ in range(steps):
        plant.step(np.full((1, 1, 2), share))
        turned.append(plant.arrays.samples[:, Sample._fields.index("step_l"), 0, 0].copy())
    return np.concatenate(turned) / plant.scenario.physics_period_s


def draw_motors(figure: Figure) -> None:
    """Torque gains, dead band, limits, torque-speed curve, delays."""
    names = (
        "Delivered against commanded torque",
        "Torque–speed curve at full command",
        "Delays: speed of a lifted wheel, torque commanded at 0",
        "Torque gains (actuator), 40 episodes of three robots",
    )
    gain, curve, delay, gains = panels(figure, names)
    limit = ROBOT.torque_limit_Nmm
    cases = {
        "nominal": {},
        "torque_gain_l 0.8": {"torque_gain_l": 0.8},
        "dead_band_Nmm 3": {"dead_band_Nmm": 3.0},
        "current_limit 0.7": {"current_limit": 0.7},
    }
    for style, (label, fields) in zip(STYLES, cases.items(), strict=True):
        record = open_loop(
            lambda t_s: (0.1 * t_s - 1.0, 0.0), 20.0, disturbance={"actuator": fields}
        )
        commanded = limit * (0.1 * (record.t_s[1:] - 0.02) - 1.0)
        gain.plot(commanded, record["torque_l_Nmm"][1:, 0], label=label, **style)
    gain.set(xlabel="commanded torque (N·mm)", ylabel="delivered torque (N·mm)")
    legend(gain, loc="upper left")

    for style, (k, share) in zip(STYLES, ((0.025, 1.0), (0.025, 0.7), (0.05, 1.0)), strict=False):
        actuator = {"back_emf_s_rad": k, "current_limit": share}
        speeds, torques = torque_speed(actuator)
        curve.plot(speeds, torques, label=f"{k:g} s/rad, current × {share:g}", **style)
        curve.plot([0, 1 / k], [limit, 0], **LAW)
    curve.set(xlabel="wheel speed (rad/s)", ylabel="delivered torque (N·mm)", ylim=(0, 17))
    legend(curve, loc="upper right")

    cases = {
        "none": {},
        "dead_time_s 0.005": {"dead_time_s": 0.005},
        "computing_delay_s 0.02": {"computing_delay_s": 0.02},
        "both": {"dead_time_s": 0.005, "computing_delay_s": 0.02},
    }
    for style, (label, fields) in zip(STYLES, cases.items(), strict=True):
        speeds = substep_speeds({"actuator": fields}, 0.5, 3)
        delay.plot(1 + np.arange(len(speeds)), speeds, label=label, **style)
    delay.set(xlabel="time (ms)", ylabel="wheel speed (rad/s)")
    legend(delay, loc="upper left")

    left, right = (drawn("actuator", f"actuator.torque_gain_{side}", 40) for side in "lr")
    gains.plot(left.ravel(), right.ravel(), "o", ms=4, mfc="none", color=STYLES[0]["color"])
    gains.set(xlabel="gain, left", ylabel="gain, right", xlim=(0.88, 1.12), ylim=(0.88, 1.12))
    gains.set_aspect("equal")


def torque_speed(actuator: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Speed of a lifted left wheel (rad/s) and its torque (N·mm) as it speeds up at full command."""
    speeds = substep_speeds({"actuator": actuator}, 1.0, 60)
    inertia = ROBOT.wheel_inertia_kg_mm2
    step_s = 0.001
    before = np.concatenate([[0.0], speeds[:-1]])
    return before, inertia * (speeds - before) / step_s / 1000


def drawn(disturbance: Any, path: str, episodes: int) -> np.ndarray:
    """Values of a channel at the start of an episode, (episode, robot)."""
    with without_warnings():
        plant = BatchPlant("infinity", episodes, disturbance=disturbance, end_on=())
    plant.reset(seed=SEED)
    return plant.applied[:, :, number(path)].copy()


# --- robots --------------------------------------------------------------------------------------


def message_ages(disturbance: str, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Times (s) and ages (s) beyond the time gap of the messages that robot 1 uses."""
    with without_warnings():
        plant = BatchPlant("infinity", 1, disturbance=disturbance, end_on=(), time_gap_s=1.0)
    plant.reset(seed=SEED)
    scenario, arrays = plant.scenario, plant.arrays
    rest, lost, late = np.zeros((1, scenario.robot_count, 2)), [False], [0]
    for step in range(1, 1 + round(seconds / scenario.control_period_s) + scenario.gap_steps):
        plant.step(rest)
        lost.append(bool(arrays.dropped[step % len(arrays.dropped), 0, 0]))
        late.append(lateness(arrays, 0, 1, step, make_settings(scenario))[0])
    ages = []
    for step in range(scenario.gap_steps, len(lost)):
        wanted = step - scenario.gap_steps
        newest = max(wanted - late[step], 0)
        while lost[newest]:
            newest -= 1
        ages.append((wanted - newest) * scenario.control_period_s)
    return times(np.array(ages), scenario.control_period_s), np.array(ages)


def start_poses(episodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Start poses (x, y, heading) of the preset ``start`` and of ``nominal``, (episode, robot, 3)."""
    found = []
    for name in ("start", "nominal"):
        with without_warnings():
            plant = BatchPlant("infinity", episodes, disturbance=name, end_on=())
        plant.reset(seed=SEED)
        places = [Info._fields.index(key) for key in ("x_mm", "y_mm", "theta_rad")]
        found.append(plant.infos[:, :, places].copy())
    return found[0], found[1]


def draw_robots(figure: Figure) -> None:
    """Payload, start scatter, radio, different robots."""
    names = (
        "Payload (payload), 20 episodes of three robots",
        "Start (start), 6 episodes of three robots",
        "Radio (radio), robot 1",
        "Different robots (mixed), at the start",
    )
    payload, start, radio, row = panels(figure, names)
    masses, places = (drawn("payload", f"payload.{key}", 20) for key in ("mass_kg", "behind_mm"))
    for i, style in enumerate(STYLES[:3]):
        look = {"color": style["color"], "marker": MARKERS[i], "ls": "", "mfc": "none", "ms": 4}
        payload.plot(places[:, i], masses[:, i], label=f"robot {i}", **look)
    payload.set(xlabel="behind the axle (mm)", ylabel="mass (kg)", ylim=(0.12, 0.2))
    legend(payload, ncols=3, loc="upper right")

    scattered, nominal = start_poses(6)
    for i, style in enumerate(STYLES[:3]):
        x, y, theta = scattered[:, i].T
        look = {"color": style["color"], "width": 0.006, "zorder": 3}
        start.quiver(x, y, -np.sin(theta), np.cos(theta), scale=22, **look)
        start.plot(x, y, MARKERS[i], ms=3, color=style["color"], label=f"robot {i}")
        start.plot(*nominal[0, i, :2], "+", ms=11, color="black", zorder=4)
    start.plot([], [], "+", ms=11, color="black", label="nominal")
    start.set(
        xlabel="x (mm)", ylabel="y (mm)", aspect="equal", xlim=(1700, 3600), ylim=(1700, 2750)
    )
    legend(start, loc="center right")

    t_s, ages = message_ages("radio", 2.0)
    radio.step(t_s, 1000 * ages, where="post", lw=0.9, color=STYLES[0]["color"])
    radio.set(xlabel="time (s)", ylabel="age beyond the gap (ms)")

    with without_warnings():
        scenario = load_scenario("mixed", plant="batch", horizon_s=5.0)
        record = run_policy(
            scenario,
            Torques(lambda t_s: (0.0, 0.0), 0.02),
            SEED,
            options={"poses": [[-300.0 * i, 0.0, -math.pi / 2] for i in range(3)]},
        )
    for i, (style, robot) in enumerate(zip(STYLES, record.scenario.robot_models, strict=False)):
        centre = (-300.0 * i - robot.outline_offset_mm, 0.0)
        row.add_patch(Circle(centre, robot.outline_radius_mm, fc="0.95", ec=style["color"]))
        for corners in body_polygons(record, 0, i):
            row.add_patch(Polygon(corners, fc=style["color"]))
        row.text(-300.0 * i, 125, f"robot {i}\n{robot.mass_kg:g} kg", ha="center", fontsize=8)
    row.set(xlabel="x (mm)", ylabel="y (mm)", aspect="equal", xlim=(-780, 150), ylim=(-160, 230))


DRAWINGS: dict[str, Callable[[Figure], None]] = {
    "slip": draw_slip,
    "grip": draw_grip,
    "floor": draw_floor,
    "motors": draw_motors,
    "robots": draw_robots,
}
