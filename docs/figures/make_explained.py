"""Pictures of ``docs/explained.md``: what a time gap is, what slip is, what an estimator sees.

``python docs/figures/make_explained.py`` simulates and draws them within a minute, with the
extra ``figures``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from family_runs import STYLES, legend
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch, Polygon

from baselines import ReferencePolicy
from baselines.runs.run import run_policy
from baselines.runs.style import GREY, METADATA, tidy
from tlf_env import BatchPlant
from tlf_env.common.files import atomic
from tlf_env.common.presets import read_preset_or_file
from tlf_env.engine import readout
from tlf_env.engine.layout import Sample
from tlf_env.numerics.angles import wrap
from tlf_env.onboard.estimator import Estimate
from tlf_env.physics.vehicle import RobotParameters
from tlf_env.task.info import Info
from tlf_env.task.scenario import load_scenario
from tlf_env.task.warn import without_warnings

FOLDER = Path(__file__).resolve().parents[1] / "images"
DPI = 130
ROBOT = RobotParameters()
BLUE, RED, GREEN, BLACK = (style["color"] for style in STYLES)
TRUE = {"color": "black", "ls": "-", "lw": 1.6}


# --- the robot -------------------------------------------------------------------------------------


def ahead(theta: float) -> np.ndarray:
    """The direction of a heading, counted from +y."""
    return np.array([-np.sin(theta), np.cos(theta)])


def right_of(theta: float) -> np.ndarray:
    """The direction to the right of a heading."""
    return np.array([np.cos(theta), np.sin(theta)])


def draw_robot(axes: Axes, pose: Any, colour: str, scale: float = 1.0, **look: Any) -> None:
    """A robot from above, to scale or enlarged: outline, wheels, and a nose that points ahead."""
    x, y, theta = pose
    forward, right = scale * ahead(theta), scale * right_of(theta)
    c = np.array([x, y])
    style = {"fc": "white", "ec": colour, "lw": 1.2, "zorder": 4} | look
    centre = c - ROBOT.outline_offset_mm * forward
    axes.add_patch(Circle(centre, scale * ROBOT.outline_radius_mm, **style))
    body = {key: value for key, value in look.items() if key in ("alpha", "zorder", "ls")}
    for side in (-1, 1):
        hub = c + side * ROBOT.axle_width_mm / 2 * right
        wheel = [
            hub + a * ROBOT.wheel_radius_mm * forward + b * 9 * right
            for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))
        ]
        axes.add_patch(Polygon(wheel, fc=colour, ec="none", **({"zorder": 5} | body)))
    nose = [c + 72 * forward, c + 48 * forward - 16 * right, c + 48 * forward + 16 * right]
    axes.add_patch(Polygon(nose, fc=colour, ec="none", **({"zorder": 5} | body)))


def arrow(axes: Axes, start: Any, end: Any, colour: str, **look: Any) -> None:
    """An arrow in the plane."""
    style = {"arrowstyle": "-|>", "mutation_scale": 13, "lw": 1.8, "shrinkA": 0, "shrinkB": 0}
    axes.add_patch(FancyArrowPatch(start, end, color=colour, **({"zorder": 7} | style | look)))


def plane(axes: Axes, title: str, adjustable: Literal["box", "datalim"] = "datalim") -> None:
    """A plane in mm."""
    axes.set(xlabel="x (mm)", ylabel="y (mm)", title=title)
    axes.set_aspect("equal", adjustable=adjustable)
    tidy(axes)


# --- time gap --------------------------------------------------------------------------------------


def draw_time_gap(figure: Figure) -> None:
    """Leader and followers on the ∞, and both gaps over time: constant in time, not in distance."""
    figure.set_size_inches(9.8, 4.8)
    now_s, gap_s, shown_s = 34.0, 5.0, 11.0
    scenario = load_scenario("infinity_from_rest", horizon_s=70.0)
    record = run_policy(scenario, ReferencePolicy(), 0)
    left, right = figure.subfigures(1, 2, width_ratios=(1.15, 1))
    axes = left.subplots()
    step = scenario.control_period_s
    now, gap = round(now_s / step), round(gap_s / step)
    axes.plot(*record.leader.T, color="0.8", lw=1.2, zorder=1)
    trail = slice(now - round(shown_s / step), now + 1)
    x, y = record["x_mm"][:, 0], record["y_mm"][:, 0]
    axes.plot(x[trail], y[trail], color=BLUE, lw=2.0, zorder=2, label="way of the leader")
    for second in range(11):
        k = now - round(second / step)
        axes.plot(x[k], y[k], "o", ms=3.5, color=BLUE, zorder=3)
        if second in (1, 2, 3, 4, 6, 7, 8, 9):
            side = right_of(record["theta_rad"][k, 0])
            axes.text(
                *(np.array([x[k], y[k]]) + 170 * side),
                f"−{second} s",
                fontsize=7,
                ha="center",
                va="center",
                color=BLUE,
            )
    for robot, colour in enumerate((BLUE, RED, GREEN)):
        columns = ("x_mm", "y_mm", "theta_rad")
        pose = np.array([record[one][now, robot] for one in columns])
        draw_robot(axes, pose, colour, scale=1.4)
        k = now - robot * gap
        name = ("leader, now", "robot 1, now", "robot 2, now")[robot]
        if robot:
            name += f"\nthe leader {robot * gap_s:g} s ago: +"
            axes.plot(x[k], y[k], "+", ms=17, mew=1.4, color="black", zorder=8)
        axes.text(
            *(pose[:2] + np.array((-230, 0) if robot else (-30, 260))),
            name,
            ha="right" if robot else "center",
            va="center",
            fontsize=8.5,
            color=colour,
        )
    plane(axes, f"at {now_s:g} s: followers are where the leader was")
    legend(axes, loc="lower left")

    distance, time = right.subplots(2, 1, sharex=True)
    late = record.t_s >= 12.0
    for robot, style in ((1, STYLES[1]), (2, STYLES[2])):
        apart = np.hypot(
            record["x_mm"][:, robot] - record["x_mm"][:, robot - 1],
            record["y_mm"][:, robot] - record["y_mm"][:, robot - 1],
        )
        distance.plot(
            record.t_s[late], apart[late], lw=1.4, label=f"robot {robot - 1} to {robot}", **style
        )
        off = gap_s + record["time_gap_error_s"][:, robot]
        time.plot(record.t_s[late], off[late], lw=1.4, label=f"robot {robot}", **style)
    for one in (distance, time):
        one.axvline(now_s, color=GREY, lw=0.8, ls=":")
        tidy(one)
    distance.set(ylabel="distance (mm)", title="the distance changes with the speed")
    distance.set_ylim(0, 3300)
    time.set(xlabel="time (s)", ylabel="time gap (s)", title="the time between them does not")
    time.set_ylim(4.5, 5.5)
    legend(distance, loc="upper right", ncols=2)
    legend(time, loc="upper right", ncols=2)


# --- runs without a controller ---------------------------------------------------------------------


class Drive(NamedTuple):
    """One robot with given commands; each array has a row for each control step, ``(time, …)``."""

    t_s: np.ndarray
    pose: np.ndarray  # x, y, heading: mm and rad
    estimate: np.ndarray  # the estimator's pose
    slip: np.ndarray  # imposed, δ₁ and δ₂
    estimated_slip: np.ndarray
    wheels: np.ndarray  # way (mm) and turn (rad) by the wheels in the step
    fixes: np.ndarray  # (fix, 3): time (s), x and y (mm), with the robot's place at that time


def drive(seconds: float, actions: Any, **fields: Any) -> Drive:
    """Drive one robot by actions that depend on the time only."""
    with without_warnings():
        plant = BatchPlant("infinity", 1, robots=1, end_on=(), horizon_s=1000.0, **fields)
    plant.reset(seed=0)
    arrays, period_s = plant.arrays, plant.scenario.control_period_s
    pose = [Info._fields.index(name) for name in ("x_mm", "y_mm", "theta_rad")]
    sample = [Sample._fields.index(name) for name in ("fix_x", "fix_y", "step_l", "step_r")]
    come, age = (Sample._fields.index(name) for name in ("has_fix", "fix_age"))
    rows: list[list[np.ndarray]] = [[] for _ in range(5)]
    fixes, steps = [], round(seconds / period_s)
    for step in range(steps + 1):
        turned = np.zeros(2)
        if step:
            plant.step(np.asarray(actions(step * period_s), dtype=float).reshape(1, 1, 2))
            readings = arrays.samples[:, :, 0, 0]
            step_l, step_r = readings[:, sample[2]].sum(), readings[:, sample[3]].sum()
            radius, width = ROBOT.wheel_radius_mm, ROBOT.axle_width_mm
            turned = np.array([radius * (step_l + step_r) / 2, radius * (step_r - step_l) / width])
            for k in np.flatnonzero(readings[:, come] > 0):
                at_s = (step - 1) * period_s + (k + 1) * plant.scenario.physics_period_s
                fixes.append((at_s - readings[k, age], *readings[k, sample[:2]]))
        estimate = readout.named(arrays, "estimate")
        slip = readout.named(arrays, "slip")
        values = (
            plant.infos[0, 0, pose],
            [getattr(estimate, name)[0, 0] for name in Estimate._fields[:3]],
            plant.applied[0, 0, :2],
            [slip.delta_1[0, 0], slip.delta_2[0, 0]],
            turned,
        )
        for kept, value in zip(rows, values, strict=True):
            kept.append(np.array(value))
    t_s = np.arange(steps + 1) * period_s
    return Drive(t_s, *map(np.array, rows), np.array(fixes))


def reckoned(run: Drive) -> np.ndarray:
    """Poses by the wheels alone, (time, 3)."""
    theta = run.pose[0, 2] + np.cumsum(run.wheels[:, 1])
    middle = theta - 0.5 * run.wheels[:, 1]
    way = run.wheels[:, :1] * np.stack([-np.sin(middle), np.cos(middle)], axis=1)
    return np.column_stack([run.pose[0, :2] + np.cumsum(way, axis=0), theta])


# --- slip ------------------------------------------------------------------------------------------

SLIP_FROM_S, SLIP_MM_S, SLIP_RAD_S = 2.0, -60.0, 0.25


def draw_slip(figure: Figure) -> None:
    """Motion by the wheels and of the body."""
    figure.set_size_inches(10.2, 4.6)
    ramp = {"type": "step", "at_s": SLIP_FROM_S}
    run = drive(
        6.0,
        lambda t_s: (0.2 * min(t_s, 1.0), 0.0),
        action="twist",
        limiter="none",
        preview_s=(),
        disturbance={
            "slip": {
                "delta_1_mm_s": ramp | {"value": SLIP_MM_S},
                "delta_2_rad_s": ramp | {"value": SLIP_RAD_S},
            }
        },
    )
    sketch, way, speeds = figure.subfigures(1, 3, width_ratios=(0.95, 0.75, 1.15))
    draw_sketch(sketch.subplots())
    axes = way.subplots()
    start, by_wheels = run.pose[0], reckoned(run)
    cos, sin = np.cos(-start[2]), np.sin(-start[2])
    turn = np.array([[cos, -sin], [sin, cos]])  # so that the robot starts at the origin, towards +y

    def local(poses: np.ndarray) -> np.ndarray:
        return np.column_stack([(poses[:, :2] - start[:2]) @ turn.T, poses[:, 2] - start[2]])

    true, wheels = local(run.pose), local(by_wheels)
    axes.plot(*wheels[:, :2].T, color=RED, ls="--", lw=1.6, label="by the wheels")
    axes.plot(*true[:, :2].T, label="of the body", **TRUE)
    for second in (2, 4, 6):
        k = round(second / 0.02)
        draw_robot(axes, wheels[k], RED, alpha=0.45, ls="--")
        draw_robot(axes, true[k], BLACK)
        centre = true[k, :2] - ROBOT.outline_offset_mm * ahead(true[k, 2])
        axes.text(*centre, f"{second} s", fontsize=8, ha="center", va="center", zorder=9)
    plane(axes, "one run: two paths", "box")
    axes.set(xlim=(-420, 180), ylim=(-60, 1200))
    legend(axes, loc="lower left")

    forward, yaw = speeds.subplots(2, 1, sharex=True)
    period_s = run.t_s[1]
    middle_s = run.t_s[1:] - 0.5 * period_s
    moved = np.diff(run.pose, axis=0)
    heading = 0.5 * (run.pose[1:, 2] + run.pose[:-1, 2])
    along = (moved[:, 0] * -np.sin(heading) + moved[:, 1] * np.cos(heading)) / period_s
    forward.plot(middle_s, run.wheels[1:, 0] / period_s, color=RED, ls="--", label="wheels")
    forward.plot(middle_s, along, label="body", **TRUE)
    yaw.plot(middle_s, run.wheels[1:, 1] / period_s, color=RED, ls="--", label="wheels")
    yaw.plot(middle_s, moved[:, 2] / period_s, label="body", **TRUE)
    for one, name in ((forward, "δ₁"), (yaw, "δ₂")):
        one.axvline(SLIP_FROM_S, color=GREY, ls=":", lw=0.9)
        tidy(one)
        wheel, body = (line.get_ydata()[-25:].mean() for line in one.lines[:2])
        both = {"arrowstyle": "<->", "color": BLUE, "lw": 1.5}
        one.annotate("", (5.0, wheel), (5.0, body), arrowprops=both)
        one.text(5.12, 0.5 * (wheel + body), name, color=BLUE, va="center", fontsize=12)
    forward.set(ylabel="forward speed (mm/s)", title="speeds of the wheels and of the body")
    yaw.set(xlabel="time (s)", ylabel="yaw rate (rad/s)")
    legend(forward, loc="lower right")


def draw_sketch(axes: Axes) -> None:
    """A robot from above on two moving floors, with the terms of eq. (14)."""
    half = ROBOT.axle_width_mm / 2
    draw_robot(axes, (0.0, 0.0, 0.0), BLACK)
    for side, letter, sigma in ((-1, "l", -79.5), (1, "r", -40.5)):
        x = side * half
        band = [(x - 24, -190), (x + 24, -190), (x + 24, 190), (x - 24, 190)]
        axes.add_patch(Polygon(band, fc="0.9", ec="0.75", lw=0.8, hatch="///", zorder=1))
        arrow(axes, (x, 55), (x, 175), RED)
        axes.text(
            x + side * 48, 150, f"$R\\,\\omega_{letter}$", ha="center", color=RED, fontsize=11
        )
        arrow(axes, (x, -95), (x, -95 + sigma), BLUE)
        axes.text(x + side * 44, -150, f"$\\sigma_{letter}$", ha="center", color=BLUE, fontsize=12)
    axes.annotate(
        "",
        (half, -205),
        (-half, -205),
        arrowprops={"arrowstyle": "<->", "color": "black", "lw": 0.9},
    )
    axes.text(0, -222, "L", ha="center", fontsize=10)
    axes.plot(0, 0, "o", ms=4, color="black", zorder=8)
    axes.text(9, -16, "c", fontsize=10, zorder=8)
    texts = (
        ("rolling, by the wheels:", RED),
        (r"$v=R\,(\omega_l+\omega_r)/2$,   $\omega=R\,(\omega_r-\omega_l)/L$", RED),
        ("slip, by the floor:", BLUE),
        (r"$\delta_1=(\sigma_l+\sigma_r)/2$,   $\delta_2=(\sigma_r-\sigma_l)/L$", BLUE),
        ("motion of the body, eq. (14):", "black"),
        (r"$u_1=v+\delta_1$,   $u_2=\omega+\delta_2$", "black"),
    )
    for row, (text, colour) in enumerate(texts):
        axes.text(0, -262 - 27 * row - 6 * (row // 2), text, ha="center", color=colour, fontsize=9)
    axes.set(xlim=(-215, 215), ylim=(-430, 200), title="slip moves the floor under a wheel")
    axes.set_aspect("equal")
    axes.axis("off")


# --- estimators ------------------------------------------------------------------------------------

FILTERS = ("ekf", "ekf-slip", "ekf-gyro")
SECONDS = 24.0


def draw_estimators(figure: Figure) -> None:
    """The same motion and readings, seen by three filters."""
    figure.set_size_inches(10.2, 8.0)
    names = ("slip-noise", "fixes-camera", "gyro")
    disturbance = {
        group: value
        for name in names
        for group, value in read_preset_or_file("disturbance", name).items()
    }
    runs = {
        name: drive(
            SECONDS,
            lambda t_s: (0.25 * min(t_s / 2, 1.0), 0.07 * np.sin(0.5 * t_s)),
            action="twist",
            limiter="none",
            estimator=name,
            disturbance=disturbance,
        )
        for name in FILTERS
    }
    first = runs[FILTERS[0]]
    for run in runs.values():
        np.testing.assert_array_equal(run.pose, first.pose)
    (whole, near), (heading, slip) = figure.subplots(2, 2)
    by_wheels = reckoned(first)
    whole.plot(*by_wheels[:, :2].T, color="#CC79A7", ls=(0, (5, 2)), lw=1.6, label="wheels alone")
    whole.plot(*first.pose[:, :2].T, label="true", **TRUE)
    draw_robot(whole, by_wheels[-1], "#CC79A7", scale=1.5)
    draw_robot(whole, first.pose[-1], BLACK, scale=1.5)
    plane(whole, f"{SECONDS:g} s: the wheels alone miss the slip")
    legend(whole, loc="best")

    from_s, to_s = 15.0, 15.5
    window = (first.t_s >= from_s) & (first.t_s <= to_s)
    origin = first.pose[window][0]
    fixes = first.fixes[(first.fixes[:, 0] >= from_s) & (first.fixes[:, 0] <= to_s)]

    def along(points: np.ndarray) -> np.ndarray:
        """Forward and left of the true pose at the beginning of the window."""
        apart = points[:, :2] - origin[:2]
        return np.stack([apart @ ahead(origin[2]), -apart @ right_of(origin[2])])

    near.plot(*along(first.pose[window]), label="true", **TRUE)
    near.plot(*along(fixes[:, 1:]), "x", color="0.35", ms=5, mew=1.1, label="fixes (30 per s)")
    for style, (name, run) in zip(STYLES, runs.items(), strict=False):
        near.plot(*along(run.estimate[window]), lw=1.2, label=name, **style)
        off = wrap_all(run.estimate[:, 2] - run.pose[:, 2])
        rms = np.sqrt(np.mean(off**2))
        heading.plot(run.t_s, off, lw=1.1, label=f"{name}, RMS {rms:.2g} rad", **style)
        if name != "ekf":
            slip.plot(run.t_s, run.estimated_slip[:, 1], lw=1.1, label=name, **style)
    near.set(
        xlabel="forward (mm)", ylabel="to the left (mm)", title="half a second of it, enlarged"
    )
    heading.axhline(0.0, color="black", lw=0.8)
    heading.set(
        xlabel="time (s)", ylabel="estimated − true heading (rad)", title="no fix shows the heading"
    )
    slip.plot(first.t_s, first.slip[:, 1], label="true", **(TRUE | {"lw": 1.0, "zorder": 1}))
    slip.set(xlabel="time (s)", ylabel="slip δ₂ (rad/s)", title="two filters estimate the slip")
    slip.set_xlim(10, 16)
    slip.set_ylim(-0.75, 0.75)
    tidy(near, heading, slip)
    heading.set_ylim(-1.9, 2.9)
    for one in (near, heading, slip):
        legend(one, loc="best", ncols=1 if one is heading else 2)


def wrap_all(angles: np.ndarray) -> np.ndarray:
    """Angles within ±π."""
    return np.array([wrap(angle) for angle in angles])


DRAWINGS = {"time_gap": draw_time_gap, "slip": draw_slip, "estimators": draw_estimators}


def main() -> None:
    """Write the pictures."""
    for name, draw in DRAWINGS.items():
        figure = Figure(layout="constrained", facecolor="white")
        draw(figure)
        with atomic(FOLDER / f"explained_{name}.png", "wb") as file:
            figure.savefig(file, dpi=DPI, format="png", metadata=METADATA.get("png"))


if __name__ == "__main__":
    main()
