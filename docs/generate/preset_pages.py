"""A page for each disturbance that is shipped: its knobs, a draw of them, and how the board's entries do."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from shared import READ, STYLES, Pages, cells, error, png, policies_of, policy_page, table

from baselines.runs.style import GREY, MARKERS, tidy
from tlf_env import BatchPlant
from tlf_env.common.presets import preset_names, preset_summary, presets_folder
from tlf_env.disturbances.channels import CHANNELS, Channel, number
from tlf_env.disturbances.model import Disturbance
from tlf_env.disturbances.table import unit
from tlf_env.engine.layout import Sample
from tlf_env.task.info import Info
from tlf_env.task.scenario import load_scenario
from tlf_env.task.trajectories import reference_from
from tlf_env.task.warn import without_warnings

SEED, SECONDS, COLUMNS = 0, 20.0, 2
SCATTERED = 12  # episodes of the picture of starts
FAMILIES = {
    "slip": "slip",
    "tyre": "grip",
    "floor": "floor",
    "push": "floor",
    "actuator": "motors",
    "position": "sensors",
    "encoder": "sensors",
    "gyro": "sensors",
    "calibration": "sensors",
    "payload": "robots",
    "radio": "robots",
    "start": "robots",
}  # group of channels: the page that explains it


def set_channels(disturbance: Disturbance) -> list[Channel]:
    """The channels that a disturbance sets to something else than nominal."""
    return [one for one in CHANNELS if disturbance.constant(one.path) != one.nominal]


def described(disturbance: Disturbance, channel: Channel) -> str:
    """A channel's signal in words of its file."""
    signal = disturbance.signal(channel.path)
    given = signal.model_dump(exclude_defaults=True)
    if signal.type == "constant":
        return f"{signal.value:.4g}"
    values = ", ".join(f"`{key}` {value:g}" for key, value in given.items() if key != "type")
    return f"{signal.type.replace('_', ' ')}: {values}"


class Draw:
    """A draw of a disturbance: seed 0 of the ∞, robots at rest.

    Attributes
    ----------
    t_s, applied
        Times (s) and values of the channels, (time, robot, channel).
    fix_s, fix_mm
        Times (s) and errors in x (mm) of the position fixes of robot 0, by the times at which they come.
    """

    def __init__(self, name: str) -> None:
        with without_warnings():
            plant = BatchPlant("infinity", 1, disturbance=name, end_on=())
        plant.reset(seed=SEED)
        rest, rows, samples = np.zeros((1, plant.scenario.robot_count, 2)), [], []
        x_mm = plant.infos[0, 0, Info._fields.index("x_mm")]
        places = [Sample._fields.index(one) for one in ("fix_x", "has_fix")]
        for step in range(round(SECONDS / plant.scenario.control_period_s) + 1):
            if step:
                plant.step(rest)
                samples.append(plant.arrays.samples[:, places, 0, 0].copy())
            rows.append(plant.applied[0].copy())
        self.applied = np.array(rows)
        self.t_s = np.arange(len(rows)) * plant.scenario.control_period_s
        readings = np.concatenate(samples)
        t_s = (1 + np.arange(len(readings))) * plant.scenario.physics_period_s
        come = readings[:, 1] > 0
        self.fix_s, self.fix_mm = t_s[come], readings[come, 0] - x_mm


def start_poses(name: str, episodes: int) -> np.ndarray:
    """Start poses of the ∞ under a disturbance, (episode, robot, 3)."""
    with without_warnings():
        plant = BatchPlant("infinity", episodes, disturbance=name, end_on=())
    plant.reset(seed=SEED)
    places = [Info._fields.index(key) for key in ("x_mm", "y_mm", "theta_rad")]
    return plant.infos[:, :, places].copy()


def draw_channel(axes: Axes, draw: Draw, channel: Channel) -> None:
    """A channel of three robots over time, and its nominal value."""
    values = draw.applied[:, :, number(channel.path)]
    same = np.ptp(values, axis=1).max() == 0.0
    for robot, style in enumerate(STYLES[: 1 if same else values.shape[1]]):
        label = "all robots" if same else f"robot {robot}"
        axes.plot(draw.t_s, values[:, robot], lw=1.2, label=label, **style)
    axes.axhline(channel.nominal, color=GREY, lw=0.9, ls=(0, (1, 2)), label="nominal")
    axes.set_title(f"{channel.path}: {channel.meaning}", fontsize="small")
    symbol = unit(channel.path)
    axes.set(xlabel="time (s)", ylabel="value" if symbol == "1" else f"value ({symbol})")
    axes.legend(fontsize=7, ncols=4, loc="upper right", framealpha=0.85, edgecolor="none")
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.3 * (high - low))


def draw_fixes(axes: Axes, draw: Draw) -> None:
    """Errors of the position fixes."""
    every = max(1, len(draw.fix_s) // 4000)
    look = {"color": "#0072B2", "ls": "", "marker": ".", "ms": 2}
    axes.plot(draw.fix_s[::every], draw.fix_mm[::every], rasterized=True, **look)
    axes.set_title("errors of the fixes of robot 0, at rest", fontsize="small")
    axes.set(xlabel="time (s)", ylabel="fix − true x (mm)")


def draw_starts(axes: Axes, name: str) -> None:
    """Start poses of some episodes."""
    poses, nominal = start_poses(name, SCATTERED), start_poses("nominal", 1)[0]
    for robot, (style, marker) in enumerate(zip(STYLES, MARKERS, strict=False)):
        if robot == poses.shape[1]:
            break
        x, y, theta = poses[:, robot].T
        look = {"color": style["color"], "width": 0.006, "zorder": 3}
        axes.quiver(x, y, -np.sin(theta), np.cos(theta), scale=24, **look)
        axes.plot(x, y, marker, ms=3.5, color=style["color"], label=f"robot {robot}")
    axes.plot(*nominal[:, :2].T, "+", ms=11, color="black", zorder=4, label="nominal")
    axes.set_title(f"start poses of {SCATTERED} episodes", fontsize="small")
    axes.set(xlabel="x (mm)", ylabel="y (mm)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(fontsize=7, loc="lower right", framealpha=0.85, edgecolor="none")


def draw_patches(axes: Axes, disturbance: Disturbance) -> None:
    """The patches on the path of the ∞."""
    path = reference_from(load_scenario("infinity").trajectory, np.linspace(0.0, 50.3, 1000))
    axes.plot(*path[:, :2].T, color="#0072B2", lw=1.2, label="path of infinity")
    for patch in disturbance.tyre.patches:
        place = (patch.x_mm, patch.y_mm)
        axes.add_patch(Circle(place, patch.radius_mm, fc="#D55E00", alpha=0.6, lw=0))
        axes.annotate(f"× {patch.friction_scale:g}", place, ha="center", va="center", fontsize=8)
    axes.set_title("patches: factor on the friction", fontsize="small")
    axes.set(xlabel="x (mm)", ylabel="y (mm)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(fontsize=7, loc="upper center", framealpha=0.85, edgecolor="none")


def picture(name: str, disturbance: Disturbance) -> bytes:
    """A panel for each knob that is drawn or varies, over 20 s of seed 0."""
    draw, channels = Draw(name), set_channels(disturbance)
    groups = {one.path.split(".")[0] for one in channels}
    drawn = [one for one in channels if disturbance.constant(one.path) is None]
    panels: list[Callable[[Axes], None]] = []
    if "start" in groups:
        panels.append(functools.partial(draw_starts, name=name))
    if disturbance.tyre.patches:
        panels.append(functools.partial(draw_patches, disturbance=disturbance))
    if not channels or ("position" in groups and "slip" not in groups):
        panels.append(functools.partial(draw_fixes, draw=draw))
    wide = [] if drawn or panels else channels  # constants, where there is nothing else to see
    panels = [
        functools.partial(draw_channel, draw=draw, channel=one) for one in drawn or wide
    ] + panels
    columns = min(len(panels), COLUMNS)
    rows = -(-len(panels) // columns)
    tall = 1.4 if rows == 1 or disturbance.tyre.patches else 0.0
    size = (6.4 if columns == 1 else 9.6, 2.4 * rows + tall)
    figure = Figure(figsize=size, layout="constrained", facecolor="white")
    found = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axes in found[len(panels) :]:
        axes.set_visible(False)
    for axes, panel in zip(found, panels, strict=False):
        panel(axes)
        tidy(axes)
    return png(figure)


def knobs(disturbance: Disturbance) -> str:
    """A table of the channels that are set."""
    rows: list[Sequence[object]] = [
        (
            f"[`{channel.path}`](../disturbances/{FAMILIES[channel.path.split('.')[0]]}.md)",
            described(disturbance, channel),
            unit(channel.path),
            f"{channel.nominal:.4g}",
            channel.meaning,
        )
        for channel in set_channels(disturbance)
    ]
    rows += [
        (
            "[`tyre.patches`](../disturbances/grip.md)",
            f"({patch.x_mm:g}, {patch.y_mm:g}) mm, radius {patch.radius_mm:g} mm: {patch.friction_scale:g}",
            "1",
            "1",
            "factor on the friction of a wheel on this disc",
        )
        for patch in disturbance.tyre.patches
    ]
    if not rows:
        return (
            "It sets no channel: every one has its nominal value. What is left is the nominal noise of the "
            "fixes.\n"
        )
    return table(("knob", "value", "unit", "nominal", "meaning"), rows)


def standings(name: str) -> str:
    """How the entries of the board do under the disturbance."""
    found = {(cell["policy"], cell["task"]): cell for cell in cells(disturbance=name)}
    if not found:
        return (
            "The board does not have this disturbance. To compare policies under it:\n\n```sh\n"
            f"tlf bench --tasks infinity --disturbances {name} --policies reference:linearised,residual "
            "--seeds 20000:20010\n```\n"
        )
    tasks = list(dict.fromkeys(task for _, task in found))
    rows = [
        (
            f"[`{policy['policy']}`](../policies/{policy_page(policy['policy'])})",
            *(error(found[policy["policy"], task]) for task in tasks),
        )
        for policy in policies_of()
    ]
    heads = [f"[{one}](../tasks/{one}.md)" for one in tasks]
    return READ + "\n\n" + table(("policy", *heads), rows, right=len(tasks))


def page(name: str) -> tuple[str, bytes]:
    """The page of a disturbance and its picture."""
    disturbance = load_scenario("infinity", disturbance=name).disturbance
    file = (presets_folder("disturbance") / f"{name}.yaml").read_text("utf-8")
    summary = preset_summary("disturbance", name)
    text = f"""# {name}

{summary}

```sh
tlf run infinity --disturbance {name}
tlf run infinity --disturbance {name} --level 0.5  # half of it
```

## What it sets

{knobs(disturbance)}
![A draw of {name}, seed {SEED}]({name}.png)
*Seed {SEED} on the ∞, robots at rest. No robot is given these values. Where there is one line, all
robots have the same value; constants are in the table.*

## How policies do

{standings(name)}
## The file

`configs/disturbances/{name}.yaml`

```yaml
{file.rstrip()}
```
"""
    return text, picture(name, disturbance)


def pages() -> Pages:
    """The pages of all shipped disturbances, and their index."""
    found: Pages = {}
    rows = []
    on_board = {cell["disturbance"] for cell in cells()}
    for name in preset_names("disturbance"):
        found[f"presets/{name}.md"], found[f"presets/{name}.png"] = page(name)
        disturbance = load_scenario("infinity", disturbance=name).disturbance
        set_to = [f"`{channel.path}`" for channel in set_channels(disturbance)]
        set_to += ["`tyre.patches`"] if disturbance.tyre.patches else []
        rows.append(
            (
                f"[{name}]({name}.md)",
                preset_summary("disturbance", name),
                ", ".join(set_to) or "–",
                "yes" if name in on_board else "no",
            )
        )
    found["presets/index.md"] = (
        "# Shipped disturbances\n\nA disturbance sets *channels*, the knobs of what acts on a robot "
        "([disturbances](../disturbances.md)). These are shipped; `tlf list disturbances` prints them. Each "
        "page shows the values of seed 0 over time. The same seed gives the same values to every policy.\n\n"
        + table(("disturbance", "what", "channels", "on the board"), rows)
    )
    return found
