from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

from baselines import ReferencePolicy
from baselines.runs import figures
from baselines.runs.bodies import body_polygons
from baselines.runs.borders import moving_borders, pushed_borders
from baselines.runs.panels import MOST_POINTS, MOST_SHOWN, robot_colour, thinned
from baselines.runs.plane import snapshot_rows
from baselines.runs.run import Record, run_policy
from baselines.runs.world import colour, world_handles
from tlf_env import load_scenario
from tlf_env.rendering.looks import CRATE, MOVER, SLIPPERY, WALL

ALL = {"overview", "paths", "errors", "functionals", "wheels", "slip", "time_gap"}
UNITS = ("%", "mm", "s", "rad", "mm/s", "rad/s", "N·mm", "mm·s", "rad·s")
PNG = b"\x89PNG"


MIXED: list[dict[str, Any]] = [
    {},
    {"torque_limit_Nmm": 20.0, "axle_width_mm": 190.0, "wheel_radius_mm": 55.0},
    {"tyre": {"stiction_speed_mm_s": 2.0}, "outline_radius_mm": 150.0},
]


BOX_MM = ((-80.0, -110.0), (80.0, -110.0), (80.0, 60.0), (-80.0, 60.0))
WORLD: dict[str, Any] = {
    "trajectory": {
        "type": "waypoints",
        "points": [
            [0, 0, 0],
            [1, 30, 0],
            [2, 120, 0],
            [5, 600, 0],
            [9, 1300, 0],
        ],  # t_s, x_mm, y_mm
    },
    "robots": [{}, {"outline_polygon_mm": BOX_MM}],
    "time_gap_s": 3.0,
    "horizon_s": 7.0,
    "world": {
        "walls": [{"points_mm": [[-900, -500], [1500, -500], [1500, 800]], "thickness_mm": 60}],
        "obstacles": [{"shape": {"type": "circle", "radius_mm": 100}, "x_mm": 200, "y_mm": 400}],
        "pushables": [
            {
                "shape": {"type": "box", "width_mm": 200, "length_mm": 300},
                "x_mm": 500,
                "y_mm": 0,
                "mass_kg": 0.2,
                "floor_friction": 0.05,
            }
        ],
        "moving": [
            {
                "shape": {"type": "circle", "radius_mm": 90},
                "points_mm": [[-600, 600], [1200, 600]],
                "speed_mm_s": 150,
            }
        ],
        "patches": [{"x_mm": -600, "y_mm": 100, "radius_mm": 150, "friction_scale": 0.5}],
    },
}


class Away:
    """Drives off the reference as fast as it can, turning all the time."""

    def predict(self, observation: np.ndarray, *_: Any) -> tuple[np.ndarray, Any]:
        return np.tile(np.float32([1.0, 0.35]), (len(observation), 1)), None


@cache
def record(kind: str) -> Record:
    policy: Any = ReferencePolicy()
    if kind == "world":
        return run_policy(load_scenario(WORLD), policy, name="test")
    overrides: dict[str, Any] = {"robots": 3, "horizon_s": 7.0}
    if kind == "lost":
        policy, overrides = Away(), {"robots": 3, "horizon_s": 12.0, "lost_beyond_mm": 300.0}
    elif kind == "before the first gap":
        overrides = {"robots": 2, "horizon_s": 0.5}
    elif kind == "one step":
        overrides = {"robots": 2, "horizon_s": 0.02}
    elif kind == "mixed":
        overrides = {"robots": MIXED, "horizon_s": 0.1, "start_spacing_mm": 400.0}
    elif kind.isdigit():
        overrides["robots"] = int(kind)
    return run_policy(load_scenario("flower", **overrides), policy, name="test")


def drawn(figure: Figure) -> Figure:
    FigureCanvasAgg(figure).draw()
    return figure


def robot_lines(axes: Axes) -> list[Any]:
    return [line for line in axes.lines if str(line.get_label()).startswith("robot ")]


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        ("1", ALL - {"time_gap"}),
        ("3", ALL),
        ("10", ALL),
        ("lost", ALL),
        ("before the first gap", ALL - {"time_gap"}),
        ("one step", ALL - {"time_gap"}),
    ],
)
@pytest.mark.filterwarnings("error")
def test_every_figure_is_written_and_nothing_else(
    kind: str, names: set[str], tmp_path: Path
) -> None:
    folder = tmp_path / "new" / "folder"
    written = figures.write_figures(record(kind), folder)
    assert set(written) == {folder / f"{name}.png" for name in names} == set(folder.iterdir())
    assert all(path.read_bytes().startswith(PNG) for path in written)


def test_a_run_is_drawn_alike_every_time_and_in_every_format(tmp_path: Path) -> None:
    once, again = (
        figures.write_figures(record("1"), tmp_path / name, formats=("png", "pdf"))
        for name in ("once", "again")
    )
    assert {path.suffix for path in once} == {".png", ".pdf"}
    assert [path.name for path in once] == [path.name for path in again]
    assert [path.read_bytes() for path in once] == [path.read_bytes() for path in again]


@pytest.mark.parametrize("kind", ["1", "3", "lost"])
def test_every_axis_has_a_unit(kind: str) -> None:
    with_unit = re.compile(rf" \(({'|'.join(UNITS)})\)$")
    for name, draw in figures.FIGURES.items():
        if name == "time_gap" and kind == "1":
            continue
        for axes in draw(record(kind)).axes:
            assert with_unit.search(axes.get_ylabel()), (name, axes.get_ylabel())
            below = axes.get_subplotspec()
            if below is not None and below.is_last_row():
                assert with_unit.search(axes.get_xlabel()), (name, axes.get_xlabel())


@pytest.mark.parametrize("kind", ["1", "3", "lost"])
def test_a_scale_that_is_linear_in_part_says_so(kind: str) -> None:
    panels = [
        axes
        for name, draw in figures.FIGURES.items()
        if name != "time_gap" or kind != "1"
        for axes in draw(record(kind)).axes
    ]
    scales = {axes.get_yscale() for axes in panels}
    assert {"linear", "log", "symlog"} <= scales
    for axes in panels:
        notes = [text.get_text() for text in axes.texts if text.get_text().startswith("scale")]
        if axes.get_yscale() == "symlog":
            linear = axes.yaxis.get_transform().linthresh
            assert notes == [f"scale: linear within ±{linear:g}, log beyond"]
        else:
            assert notes == []


@pytest.mark.parametrize("n", [1, 3, 10])
def test_every_robot_has_its_lines(n: int) -> None:
    run = record(str(n))
    for name, panels in (("errors", 2), ("functionals", 4)):
        axes = figures.FIGURES[name](run).axes
        assert [len(robot_lines(panel)) for panel in axes] == [n] * panels
    assert len(robot_lines(figures.paths(run).axes[0])) == n
    assert [len(axes.lines) for axes in figures.wheels(run).axes] == [2, 2, 1, 1, 1] * n
    assert len(figures.slip(run).axes) == n
    if n > 1:
        gaps = figures.time_gap(run).axes
        assert [len(robot_lines(axes)) for axes in gaps] == [1] * (n - 1)
        assert [axes.get_ylabel().split("\n")[0] for axes in gaps] == [
            f"robot {i}" for i in range(1, n)
        ]


def test_robots_beyond_the_markers_have_other_lines() -> None:
    """Colour, marker and line together are different for each of 20 robots."""
    lines = robot_lines(figures.errors(record("20")).axes[0])
    looks = {(line.get_marker(), line.get_linestyle()) for line in lines}
    assert len(lines) == len(looks) == 20


def test_lines_show_what_was_recorded() -> None:
    run = record("3")
    position, heading = figures.errors(run).axes
    for i, (line, other) in enumerate(
        zip(robot_lines(position), robot_lines(heading), strict=True)
    ):
        np.testing.assert_array_equal(line.get_ydata(), run["position_error_mm"][:, i])
        np.testing.assert_array_equal(other.get_ydata(), run["heading_error_rad"][:, i])
    left, _, torque, _, share = figures.wheels(run).axes[5:10]
    # A mean over 1 s in the middle of the run, within the record's own steps.
    k, half = len(run.t_s) // 2, round(0.5 / run.scenario.control_period_s)
    mean = 100 * run["saturation_fraction"][k - half : k + half + 1, 1].mean()
    assert share.lines[0].get_ydata()[k] == pytest.approx(mean, abs=3.0)
    np.testing.assert_array_equal(left.lines[0].get_ydata(), run["omega_l_command_rad_s"][:, 1])
    np.testing.assert_array_equal(left.lines[1].get_ydata(), run["omega_l_rad_s"][:, 1])
    np.testing.assert_array_equal(torque.lines[0].get_ydata(), run["torque_l_Nmm"][:, 1])
    slip = figures.slip(run).axes[2].lines[0]
    np.testing.assert_array_equal(slip.get_ydata(), run["slip_mm_s"][:, 2])
    gap = robot_lines(figures.time_gap(run).axes[1])[0]
    after = run.t_s >= run.scenario.time_gap_s
    np.testing.assert_array_equal(gap.get_ydata(), run["time_gap_error_s"][after, 2])


def test_the_functionals_are_shown_whole_and_from_the_settle_time_on() -> None:
    run = record("3")
    whole, _, late, _ = figures.functionals(run).axes
    settled = run.t_s >= run.scenario.settle_s
    J = run["J_mm_s"][:, 1]
    np.testing.assert_array_equal(robot_lines(whole)[1].get_ydata(), J)
    np.testing.assert_array_equal(robot_lines(late)[1].get_ydata(), J[settled] - J[settled][0])


@pytest.mark.parametrize("kind", ["3", "lost"])
def test_nothing_lies_beyond_the_limits(kind: str) -> None:
    run = record(kind)
    plane, position, gap = figures.overview(run).axes
    for axes, columns in ((plane.get_xlim(), ("x_mm",)), (plane.get_ylim(), ("y_mm",))):
        for column in columns:
            assert axes[0] < run[column].min() - run.scenario.robot.outline_radius_mm
            assert axes[1] > run[column].max() + run.scenario.robot.outline_radius_mm
    assert position.get_ylim()[1] > run["position_error_mm"].max()
    after = run.t_s >= run.scenario.time_gap_s
    late = run["time_gap_error_s"][after, 1:]
    assert gap.get_ylim()[0] <= late.min()
    assert gap.get_ylim()[1] >= late.max()
    limit = run.scenario.robot.torque_limit_Nmm
    for axes in figures.wheels(run).axes:
        data = np.concatenate([line.get_ydata() for line in axes.lines])
        assert axes.get_ylim()[0] < data.min()
        assert axes.get_ylim()[1] > data.max()
        if axes.get_ylabel().startswith("torque"):
            assert [(p.get_y(), p.get_height()) for p in axes.patches] == [(-limit, 2 * limit)]


@pytest.mark.parametrize("name", ["overview", "paths", "errors", "functionals"])
@pytest.mark.parametrize("kind", ["1", "3", "20", "20 lost", "3 slim", "world"])
def test_texts_stay_clear_of_the_axes_and_of_each_other(kind: str, name: str) -> None:
    run = record(kind.split()[0])
    if kind.endswith("lost"):  # the longest names
        columns = {**run.columns, "position_error_mm": 1000 + run["position_error_mm"]}
        run = replace(run, columns=columns, lost_at_s=np.full(run.robots, 1.0))
    if kind.endswith("slim"):  # the narrowest plane, and a name longer than it
        y_mm = np.linspace(0.0, 9000.0, len(run.t_s))
        along = {"x_mm": 0.0 * run["x_mm"], "y_mm": np.tile(y_mm[:, None], (1, run.robots))}
        leader = np.stack([0.0 * y_mm, y_mm], axis=-1)
        policy = "a_learned_policy of several words and numbers, 1 to 9, of a long training"
        run = replace(run, columns={**run.columns, **along}, leader=leader, policy=policy)
    figure = drawn(figures.FIGURES[name](run))
    whole = figure.bbox
    panels = [axes.get_window_extent() for axes in figure.axes]
    title = next(text for text in figure.texts if text.get_text() == figure.get_suptitle())
    for text in (figure.legends[0], title):
        box = text.get_window_extent()
        assert whole.x0 <= box.x0 < box.x1 <= whole.x1
        assert whole.y0 <= box.y0 < box.y1 <= whole.y1
        assert not any(box.overlaps(panel) for panel in panels)
    if name in ("overview", "paths"):
        times = [text.get_window_extent() for text in figure.axes[0].texts]
        assert all(panels[0].x0 < t.x0 < t.x1 < panels[0].x1 for t in times)
        assert all(panels[0].y0 < t.y0 < t.y1 < panels[0].y1 for t in times)
        assert not any(a.overlaps(b) for a in times for b in times if a is not b)


@pytest.mark.parametrize("kind", ["1", "3", "lost"])
def test_robots_are_drawn_at_the_snapshots_and_each_time_is_named_once(kind: str) -> None:
    run = record(kind)
    plane = figures.overview(run).axes[0]
    rows = snapshot_rows(run)
    assert rows[0] == len(run.t_s) - 1
    assert [text.get_text() for text in plane.texts] == [f"{run.t_s[k]:g} s" for k in rows]
    outlines = [patch for patch in plane.patches if isinstance(patch, Circle)]
    assert len(outlines) == len(rows) * run.robots
    assert {circle.get_radius() for circle in outlines} == {run.scenario.robot.outline_radius_mm}
    parts = [part for part in plane.collections if isinstance(part, PolyCollection)]
    assert len(parts) == len(outlines)
    assert plane.get_aspect() == 1.0


def test_every_robot_is_drawn_with_its_own_measures() -> None:
    run = record("mixed")
    models = run.scenario.robot_models
    rows = [figures.wheels(run).axes[5 * i : 5 * i + 4] for i in range(3)]
    bands = [[axes.patches[0] for axes in row[2:]] for row in rows]
    for model, row, two in zip(models, rows, bands, strict=True):
        limit = model.torque_limit_Nmm
        assert [(p.get_y(), p.get_height()) for p in two] == [(-limit, 2 * limit)] * 2
        assert [axes.get_yticks().tolist() for axes in row[2:]] == [[-limit, 0, limit]] * 2
    assert [two[0].get_y() for two in bands] == [-15.0, -20.0, -15.0]
    levels = [axes.lines[-1].get_ydata()[0] for axes in figures.slip(run).axes]
    assert levels == [model.tyre.stiction_speed_mm_s for model in models]

    plane = figures.paths(run).axes[0]
    outlines = [patch for patch in plane.patches if isinstance(patch, Circle)]
    assert [circle.get_radius() for circle in outlines] == [
        model.outline_radius_mm for model in models
    ]
    assert plane.get_xlim()[1] > run["x_mm"].max() + 150.0
    for i, model in enumerate(models):
        left, right, castor, _ = body_polygons(run, 0, i)
        axle_mm = np.linalg.norm(left.mean(axis=0) - right.mean(axis=0))
        assert axle_mm == pytest.approx(model.axle_width_mm)
        assert np.linalg.norm(left[2] - left[1]) == pytest.approx(2 * model.wheel_radius_mm)
        c = np.array([run["x_mm"][0, i], run["y_mm"][0, i]])
        behind_mm = np.linalg.norm(castor.mean(axis=0) - c)
        trailing = model.castor_pivot_mm + model.castor_trail_mm * np.cos(run["castor_rad"][0, i])
        aside = model.castor_trail_mm * np.sin(run["castor_rad"][0, i])
        assert behind_mm == pytest.approx(np.hypot(trailing, aside))


def test_the_legend_names_a_torque_limit_that_all_motors_share_and_no_other() -> None:
    for kind, text in (
        ("3", "motors saturate at ±15 N·mm"),
        ("mixed", "motors saturate at the band's edges"),
    ):
        legend = figures.wheels(record(kind)).legends[0]
        assert legend.get_texts()[-1].get_text() == text


def test_snapshots_keep_their_distance() -> None:
    run = record("1")
    rows = snapshot_rows(run)
    assert len(rows) > 1
    places = np.stack([run["x_mm"][rows, 0], run["y_mm"][rows, 0]], axis=-1)
    apart = np.linalg.norm(places[:, None] - places, axis=-1)
    assert (apart[~np.eye(len(rows), dtype=bool)] > 2 * run.scenario.robot.outline_radius_mm).all()


@pytest.mark.parametrize(
    ("theta", "castor", "left", "right", "wheel", "nose"),
    [
        (0.0, 0.0, (-78, 0), (78, 0), (0, -100), (0, 76)),  # faces +y
        (np.pi / 2, 0.0, (0, -78), (0, 78), (100, 0), (-76, 0)),  # faces −x
        (0.0, np.pi / 2, (-78, 0), (78, 0), (15, -85), (0, 76)),  # the fork turned to the left
    ],
)
def test_bodies_are_to_scale_and_face_where_they_head(
    theta: float, castor: float, left: Any, right: Any, wheel: Any, nose: Any
) -> None:
    run = record("1")
    at = {"x_mm": 1000.0, "y_mm": -500.0, "theta_rad": theta, "castor_rad": castor}
    columns = {**run.columns, **{name: np.full((1, 1), value) for name, value in at.items()}}
    polygons = body_polygons(replace(run, columns=columns), 0, 0)
    polygons = [polygon - (1000.0, -500.0) for polygon in polygons]
    for polygon, centre in zip(polygons, (left, right, wheel), strict=False):
        np.testing.assert_allclose(polygon.mean(axis=0), centre, atol=1e-9)
    np.testing.assert_allclose(polygons[3][2], nose, atol=1e-9)
    lengths = [np.linalg.norm(polygon[2] - polygon[1]) for polygon in polygons[:3]]
    np.testing.assert_allclose(lengths, [100.0, 100.0, 40.0])


def test_a_lost_robot_is_called_lost_and_its_heading_is_not_drawn_across_the_wrap() -> None:
    run = record("lost")
    assert np.abs(np.diff(run["heading_error_rad"], axis=0)).max() > np.pi  # it does wrap
    position, heading = figures.errors(run).axes
    assert all(str(line.get_label()).endswith(", lost") for line in robot_lines(position))
    assert "lost" in [text.get_text() for text in position.texts]
    for line in robot_lines(heading):
        steps = np.abs(np.diff(line.get_ydata()))
        assert np.nanmax(steps) <= np.pi


def test_the_settle_time_is_marked() -> None:
    run = record("3")
    _, position, gap = figures.overview(run).axes
    for axes in (position, gap):
        dashed = [line for line in axes.lines if line.get_linestyle() == "--"]
        assert [set(line.get_xdata()) for line in dashed] == [{run.scenario.settle_s}]
    assert position.texts[0].get_text().startswith(f"settle time {run.scenario.settle_s:g} s")


def test_the_title_names_task_policy_disturbance_and_seed() -> None:
    run = record("1")
    assert run.title == "flower, policy test, disturbance nominal, seed 0"
    half = load_scenario(run.scenario, disturbance_level=0.5)
    assert "nominal × 0.5" in replace(run, scenario=half).title


@pytest.mark.parametrize("count", [1, 10, 4000, 4001, 99_999])
def test_thinning_keeps_the_ends_and_the_extremes(count: int) -> None:
    t_s = np.arange(count) * 0.001
    values = np.random.default_rng(count).normal(size=count)
    kept_s, kept = thinned(t_s, values)
    assert len(kept) <= MOST_POINTS + 2
    assert (kept_s[0], kept_s[-1]) == (t_s[0], t_s[-1])
    assert (kept.min(), kept.max()) == (values.min(), values.max())
    np.testing.assert_array_equal(values[np.searchsorted(t_s, kept_s)], kept)


@pytest.mark.parametrize("n", range(1, 21))
def test_colours_and_markers_distinguish_robots(n: int) -> None:
    run = replace(record("1"), lost_at_s=np.full(n, np.inf))
    colours = {tuple(to_rgb(robot_colour(run, i))) for i in range(n)}
    assert len(colours) == n
    assert all(np.dot(c, (0.2126, 0.7152, 0.0722)) < 0.85 for c in colours)  # none lost on white


def test_very_many_robots_get_a_spread_of_rows() -> None:
    run = record("10")
    assert len(figures.slip(run).axes) == 10
    many = {name: np.tile(column, (1, 40)) for name, column in run.columns.items()}
    crowd = replace(
        run,
        scenario=load_scenario(run.scenario, robots=400),
        columns=many,
        lost_at_s=np.tile(run.lost_at_s, 40),
        touched_at_s=np.tile(run.touched_at_s, 40),
    )
    rows = figures.slip(crowd).axes
    assert len(rows) == MOST_SHOWN
    assert rows[0].get_ylabel().startswith("robot 0\n")
    assert rows[-1].get_ylabel().startswith("robot 399\n")


def test_pyplot_is_left_alone() -> None:
    code = "import sys, baselines.runs.figures; sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# --- the world -------------------------------------------------------------------------------------


def pixels(figure: Figure, points_mm: list[tuple[float, float]]) -> list[np.ndarray]:
    """Colours, 0 to 1, at places of the plane."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image = np.asarray(canvas.buffer_rgba())[::-1, :, :3] / 255
    at = figure.axes[0].transData.transform(points_mm).astype(int)
    return [image[row, column] for column, row in at.tolist()]


def test_the_world_is_where_the_scenario_says() -> None:
    run = record("world")
    assert run.objects is not None
    pushed, person = run.objects[-1, :, :2].tolist()
    places = [(0.0, -500.0), (1500.0, 300.0), (210.0, 410.0), tuple(pushed), tuple(person)]
    wanted = [WALL, WALL, WALL, CRATE, MOVER, SLIPPERY]
    found = pixels(figures.paths(run), [*places, (-600.0, 100.0)])
    for here, colour_there in zip(found, wanted, strict=True):
        np.testing.assert_allclose(here, colour(colour_there), atol=0.01)


def test_things_are_shown_where_they_were_and_where_they_are() -> None:
    run = record("world")
    assert run.objects is not None
    assert run.objects[-1, 0, 0] > run.objects[0, 0, 0] + 50.0  # it was pushed
    plane = figures.overview(run).axes[0]
    shown = [path.vertices for part in plane.collections for path in part.get_paths()]
    rows = snapshot_rows(run)
    things = pushed_borders(run, 0) + pushed_borders(run, -1)
    things += [one for row in rows for one in moving_borders(run, row)]
    assert len(things) == 2 + len(rows)
    for thing in things:
        assert any(len(one) == len(thing) + 1 and np.allclose(one[:-1], thing) for one in shown)
    (course,) = (line for line in plane.lines if line.get_linestyle() == "--")
    assert course.get_xydata().tolist() == WORLD["world"]["moving"][0]["points_mm"]


def test_the_legend_names_what_the_world_has_and_no_more() -> None:
    wanted = [
        "wall or obstacle",
        "can be pushed, at the start",
        "can be pushed, at the end",
        "moving obstacle, its path",
        "tyre friction × 0.5",
    ]
    run = record("world")
    for draw in (figures.overview, figures.paths):
        texts = [text.get_text() for text in draw(run).legends[0].get_texts()]
        assert texts[-len(wanted) :] == wanted
    assert world_handles(record("3")) == []
    assert not any(path.get_zorder() < 2 for path in figures.paths(record("3")).axes[0].collections)


def test_the_plane_contains_the_world() -> None:
    plane = figures.overview(record("world")).axes[0]
    (left, right), (low, high) = plane.get_xlim(), plane.get_ylim()
    assert left < -930
    assert right > 1530
    assert low < -530
    assert high > 830


def test_a_polygonal_outline_is_drawn_as_one() -> None:
    run = record("world")
    plane = figures.paths(run).axes[0]
    (outline,) = (patch for patch in plane.patches if isinstance(patch, Polygon))
    theta, c = run["theta_rad"][-1, 1], (run["x_mm"][-1, 1], run["y_mm"][-1, 1])
    e, f = (np.cos(theta), np.sin(theta)), (-np.sin(theta), np.cos(theta))
    np.testing.assert_allclose(outline.get_xy()[:-1], c + np.array(BOX_MM) @ np.array([e, f]))
    nose = body_polygons(run, -1, 1)[3]
    ahead = (nose - c) @ np.array(f)
    assert ahead.max() == pytest.approx(0.95 * 60.0)
