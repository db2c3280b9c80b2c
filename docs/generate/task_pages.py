"""A page for each task: its path, what it asks of the robots, how the board's entries do on it, its file."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from shared import READ, Pages, cells, error, png, policies_of, policy_page, table

from baselines.runs.borders import shape_border
from baselines.runs.style import tidy
from baselines.runs.world import colour
from tlf_env.common.presets import preset_names, preset_summary, presets_folder
from tlf_env.physics.shapes import border
from tlf_env.physics.world import Obstacle, capsules_of
from tlf_env.rendering import looks
from tlf_env.task.actions import FULL_SPEED_MM_S, FULL_YAW_RATE_RAD_S
from tlf_env.task.feasibility import (
    grip_acceleration,
    motor_acceleration,
    start_note,
    wall_warnings,
    warnings_for,
)
from tlf_env.task.scenario import Scenario, load_scenario
from tlf_env.task.trajectories import reference_from
from tlf_env.task.warn import without_warnings

STEP_S = 0.01
RATE_STEPS = 5  # on both sides, for an acceleration
SPEEDS = "viridis"


def gymnasium_id(name: str) -> str:
    """The task's id in Gymnasium."""
    return f"tlf_env/{name.title().replace('_', '')}-v0"


def times_of(scenario: Scenario) -> np.ndarray:
    """Times of the horizon, s."""
    return np.arange(round(scenario.horizon_s / STEP_S) + 1) * STEP_S


def rate(values: np.ndarray) -> np.ndarray:
    """The rate of change over a tenth of a second, per s."""
    k = np.arange(len(values))
    after = np.minimum(k + RATE_STEPS, len(values) - 1)
    before = np.maximum(k - RATE_STEPS, 0)
    return (values[after] - values[before]) / ((after - before) * STEP_S)


def draw_world(scenario: Scenario, axes: Axes) -> None:
    """Walls, obstacles and what can be pushed, at the start."""
    for thing in scenario.world.fixed:
        if isinstance(thing, Obstacle):
            pieces = [shape_border(thing.shape, thing.x_mm, thing.y_mm, thing.angle_rad)]
        else:
            pieces = [
                border(np.array([(one.x_1, one.y_1), (one.x_2, one.y_2)]), one.radius)
                for one in capsules_of(thing)
            ]
        axes.add_collection(PolyCollection(pieces, fc=colour(looks.WALL), lw=0, zorder=1))
    for pushed in scenario.world.pushables:
        shape = shape_border(pushed.shape, pushed.x_mm, pushed.y_mm, pushed.angle_rad)
        axes.add_collection(
            PolyCollection([shape], fc=colour(looks.CRATE), ec=colour(looks.CRATE_EDGE), zorder=1)
        )
    for moving in scenario.world.moving:
        corners = moving.corners_mm()
        axes.plot(*corners.T, color=colour(looks.COURSE), ls=(0, (4, 3)), lw=1.0, zorder=1)
        shape = shape_border(moving.shape, *corners[0], moving.angle_rad)
        axes.add_collection(
            PolyCollection([shape], fc=colour(looks.MOVER), ec=colour(looks.MOVER_EDGE), zorder=2)
        )


def picture(scenario: Scenario) -> bytes:
    """The leader's reference in the plane, coloured by its speed, and its twist over time."""
    t_s = times_of(scenario)
    reference = reference_from(scenario.trajectory, t_s, scenario.start_ramp_s)
    figure = Figure(figsize=(9.6, 4.6), layout="constrained", facecolor="white")
    left, right = figure.subfigures(1, 2, width_ratios=(1.15, 1))
    plane = left.subplots()
    draw_world(scenario, plane)
    corners = reference[:, None, :2]
    pieces = np.concatenate([corners[:-1:5], corners[5::5][: len(corners[:-1:5])]], axis=1)
    line = LineCollection(list(pieces), cmap=SPEEDS, lw=2.4, zorder=3)
    line.set_array(reference[:-1:5, 3][: len(pieces)])
    line.set_clim(0.0, max(reference[:, 3].max(), 1.0))
    plane.add_collection(line)
    left.colorbar(line, ax=plane, label="speed of the reference (mm/s)", shrink=0.8)
    x, y, theta = reference[0, :3]
    back = np.array([math.sin(theta), -math.cos(theta)])
    for number, robot in enumerate(scenario.robot_models):
        c = np.array([x, y]) + number * scenario.start_spacing_mm * back
        place = c + robot.outline_offset_mm * back
        plane.add_patch(
            Circle(place, robot.outline_radius_mm, fc="white", ec="black", lw=1.0, zorder=4)
        )
        plane.text(*place, str(number), ha="center", va="center", fontsize=7, zorder=5)
    ahead = np.array([x, y]) - 450 * back
    arrow = {"arrowstyle": "-|>", "color": "#D55E00", "lw": 1.8}
    plane.annotate("", ahead, (x, y) - 110 * back, arrowprops=arrow, zorder=6)
    plane.autoscale_view()
    plane.set_aspect("equal", adjustable="datalim")
    plane.set(xlabel="x (mm)", ylabel="y (mm)", title="path, and the robots at the start")
    speed, turn = right.subplots(2, 1, sharex=True)
    speed.plot(t_s, reference[:, 3], color="#0072B2", lw=1.2)
    turn.plot(t_s, reference[:, 4], color="#D55E00", lw=1.2)
    speed.set(ylabel="speed u₁* (mm/s)", title="what the leader should do")
    speed.set_ylim(0, 1.1 * max(reference[:, 3].max(), 1.0))
    turn.set(xlabel="time (s)", ylabel="yaw rate u₂* (rad/s)")
    tidy(plane, speed, turn)
    return png(figure)


def needs(scenario: Scenario) -> str:
    """The largest values of the reference, beside the limits of the first robot."""
    reference = reference_from(scenario.trajectory, times_of(scenario), scenario.start_ramp_s)
    speed, turn = reference[:, 3], reference[:, 4]
    along, sideways = np.abs(rate(speed)), np.abs(speed * turn)
    robot = scenario.robot_models[0]
    static, dynamic = grip_acceleration(robot)
    rows = [
        ("speed, mm/s", f"{speed.max():.0f}", f"{FULL_SPEED_MM_S:.0f}, the full scale of a twist"),
        ("yaw rate, rad/s", f"{np.abs(turn).max():.2f}", f"{FULL_YAW_RATE_RAD_S:.0f}, its scale"),
        (
            "acceleration forward, mm/s²",
            f"{along.max():.0f}",
            f"{motor_acceleration(robot):.0f}, what the motors give on a straight",
        ),
        (
            "acceleration sideways, mm/s²",
            f"{sideways.max():.0f}",
            f"{dynamic:.0f} to {static:.0f}, dynamic and static grip of the drive wheels",
        ),
    ]
    return table(("of the reference", "largest", "limit of the robot"), rows)


def facts(name: str, scenario: Scenario) -> str:
    """What the task is, in numbers."""
    t_s = times_of(scenario)
    reference = reference_from(scenario.trajectory, t_s, scenario.start_ramp_s)
    length_m = np.hypot(*np.diff(reference[:, :2], axis=0).T).sum() / 1000
    kind = scenario.trajectory.type
    rows = [
        ("path", f"[`{kind}`](../trajectories.md#{kind}), {length_m:.1f} m in the horizon"),
        ("robots", scenario.robot_count),
        ("time gap", f"{scenario.time_gap_s:g} s"),
        ("distance at the start", f"{scenario.start_spacing_mm:g} mm"),
        ("horizon", f"{scenario.horizon_s:g} s, {scenario.horizon_steps} control steps"),
        (
            "start",
            f"the reference gets from rest to its speed within {scenario.start_ramp_s:g} s"
            if scenario.start_ramp_s
            else f"the reference starts at {reference[0, 3]:.0f} mm/s, the robots at rest",
        ),
        ("ids", f"`{gymnasium_id(name)}` (Gymnasium), `tlf_env/{name}-v0` (PettingZoo)"),
    ]
    return table(("what", "value"), rows)


def hints(scenario: Scenario) -> list[str]:
    """What the robots cannot do of it, and what they lack at the start."""
    first = scenario.robot_models[0]
    ramp_s = scenario.start_ramp_s
    found = warnings_for(
        scenario.trajectory,
        first,
        scenario.horizon_s,
        robots=scenario.robot_count,
        time_gap_s=scenario.time_gap_s,
        start_spacing_mm=scenario.start_spacing_mm,
        start_ramp_s=ramp_s,
    )
    found += wall_warnings(scenario.trajectory, first, scenario.world, scenario.horizon_s, ramp_s)
    note = None if ramp_s else start_note(scenario.trajectory, first)
    return ([note] if note else []) + found


def standings(name: str) -> str:
    """How the entries of the board do on the task."""
    found = {(cell["policy"], cell["disturbance"]): cell for cell in cells(task=name)}
    if not found:
        return (
            "The board does not have this task. To compare policies on it:\n\n```sh\n"
            f"tlf bench --tasks {name} --disturbances nominal,slip-noise --policies "
            "reference:linearised,residual --seeds 20000:20010\n```\n"
        )
    disturbances = list(dict.fromkeys(disturbance for _, disturbance in found))
    shown = [one for one in SHOWN if one in disturbances] or disturbances
    rows = [
        (
            f"[`{policy['policy']}`](../policies/{policy_page(policy['policy'])})",
            *(error(found[policy["policy"], disturbance]) for disturbance in shown),
        )
        for policy in policies_of()
    ]
    heads = [f"[{one}](../presets/{one}.md)" for one in shown]
    more = ", ".join(one for one in disturbances if one not in shown)
    rest = f"\n\nAlso on the [board](../leaderboard.md): {more}.\n" if more else "\n"
    return READ + "\n\n" + table(("policy", *heads), rows, right=len(shown)) + rest


SHOWN = ("nominal", "noise", "slip", "slip-noise", "ice", "start", "combined-hard", "swell")


def page(name: str) -> tuple[str, bytes]:
    """The page of a task and its picture."""
    scenario = load_scenario(name)
    file = (presets_folder() / f"{name}.yaml").read_text("utf-8")
    comment = " ".join(
        line.lstrip("# ") for line in file.splitlines() if line.startswith("#") and line != "#"
    )
    notes = hints(scenario)
    said = "\n".join(f"- {note}" for note in notes)
    worth = (
        f"Beside these limits:\n\n{said}\n"
        if notes
        else "Nothing of the reference is beyond what the robots can do.\n"
    )
    text = f"""# {name}

{comment}

```sh
tlf run {name}    # a table and figures
tlf run {name} --disturbance slip-noise
```

```python
import tlf_env

env = tlf_env.parallel_env("{name}", disturbance="slip-noise")
```

![The path of {name} coloured by speed, and the reference's speed and yaw rate over time]({name}.png)
*The circles are the outlines of the robots at the start, with their numbers; the arrow is the direction of
travel.*

{facts(name, scenario)}
## What the robots need

{needs(scenario)}
{worth}
How the limits follow from the robot: [trajectories](../trajectories.md#what-a-robot-can-do).

## How policies do

{standings(name)}
## The file

`configs/{name}.yaml`; every field that it leaves out has the [default](../scenario.md).

```yaml
{file.rstrip()}
```
"""
    return text, picture(scenario)


def pages() -> Pages:
    """The pages of all tasks, and their index."""
    found: Pages = {}
    rows: list[Sequence[object]] = []
    with without_warnings():
        for name in preset_names():
            found[f"tasks/{name}.md"], found[f"tasks/{name}.png"] = page(name)
            scenario = load_scenario(name)
            reference = reference_from(
                scenario.trajectory, times_of(scenario), scenario.start_ramp_s
            )
            rows.append(
                (
                    f"[{name}]({name}.md)",
                    scenario.robot_count,
                    f"{scenario.time_gap_s:g}",
                    f"{scenario.horizon_s:g}",
                    f"{reference[:, 3].max():.0f}",
                    f"{np.abs(reference[:, 3] * reference[:, 4]).max():.0f}",
                    preset_summary("scenario", name),
                )
            )
    found["tasks/index.md"] = (
        "# Tasks\n\nA task is a scenario that is shipped: a path of the leader, a number of robots, a time "
        "gap, a horizon and a world. `tlf list tasks` prints them, `tlf show NAME` prints one with all fields, "
        "and [a path of your own](../trajectories.md#a-path-of-your-own) is a task too.\n\n"
        + table(
            (
                "task",
                "robots",
                "gap, s",
                "horizon, s",
                "top speed, mm/s",
                "sideways, mm/s²",
                "what",
            ),
            rows,
        )
        + "\n*Sideways*: the largest acceleration across the path. At half the friction (`ice`) the drive "
        "wheels hold about half of the grip in the pages' tables.\n"
    )
    return found
