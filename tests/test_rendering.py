from __future__ import annotations

import builtins
import math
import os
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pymunk
import pytest

import tlf_env
from tlf_env.physics.parameters import RobotParameters
from tlf_env.physics.shapes import PlacedShape
from tlf_env.rendering.drawing import FLOOR, clipped
from tlf_env.rendering.looks import CRATE, MOVER, NOSE, WALL, robot_colours
from tlf_env.rendering.renderer import ALARM, Renderer, round_length
from tlf_env.rendering.scene import Scene, scene_of

pygame = pytest.importorskip("pygame")

ANGLES = np.linspace(0, 2 * np.pi, 400)
PATH_MM = 2000 * np.stack([np.sin(ANGLES), np.sin(2 * ANGLES)], axis=-1)
BARE = {"close_up": None, "size_px": (480, 360)}


def make_renderer(robots: int = 3, **options: Any) -> Renderer:
    defaults: dict[str, Any] = {"mode": "rgb_array", "fps": 50.0}
    return Renderer([RobotParameters()] * robots, PATH_MM, **(defaults | options))


def make_scene(robots: int = 3, t_s: float = 0.0, **changes: Any) -> Scene:
    """Robots 300 mm apart on the x axis, heading along it, on their references; no ghosts."""
    zeros = np.zeros(robots)
    x_mm = 500.0 - 300.0 * np.arange(robots)
    fields = dict.fromkeys(Scene._fields, zeros) | {
        "t_s": t_s,
        "x_mm": x_mm,
        "theta_rad": np.full(robots, -math.pi / 2),
        "reference_x_mm": x_mm,
        "reference_theta_rad": np.full(robots, -math.pi / 2),
        "lost": np.zeros(robots, dtype=bool),
        "touched": np.zeros(robots, dtype=bool),
        "touched_by": np.zeros(robots, dtype=np.int8),
        "objects": (),
    }
    for axis in ("x_mm", "y_mm", "theta_rad"):
        fields[f"ghost_{axis}"] = np.full(robots, np.nan)
    return Scene(**(fields | changes))


def frame(renderer: Renderer, scene: Scene) -> np.ndarray:
    drawn = renderer.draw(scene)
    assert drawn is not None
    return drawn


def draw(scene: Scene, **options: Any) -> np.ndarray:
    return frame(make_renderer(len(scene.x_mm), **options), scene)


def count(image: np.ndarray, colour: tuple[int, int, int], tolerance: int = 40) -> int:
    return int((np.abs(image.astype(int) - colour).max(axis=-1) <= tolerance).sum())


@pytest.mark.parametrize("robots", [1, 2, 10, 40])
@pytest.mark.parametrize("size_px", [(960, 720), (320, 500), (64, 64)])
def test_frames_are_arrays_of_the_size_asked_for(robots: int, size_px: tuple[int, int]) -> None:
    image = draw(make_scene(robots), size_px=size_px)
    assert image.shape == (size_px[1], size_px[0], 3)
    assert image.dtype == np.uint8
    assert image.std() > 0


def test_frames_are_fresh_and_writable() -> None:
    renderer = make_renderer()
    first = frame(renderer, make_scene())
    kept = first.copy()
    second = frame(renderer, make_scene(t_s=0.1, x_mm=np.array([900.0, 600.0, 300.0])))
    assert np.array_equal(first, kept)
    assert not np.array_equal(first, second)
    second[:] = 0


def test_equal_scenes_give_equal_frames() -> None:
    assert np.array_equal(draw(make_scene()), draw(make_scene()))


def test_arrays_need_no_display() -> None:
    code = """
        import pygame
        from tests.test_rendering import draw, make_scene
        draw(make_scene())
        assert not pygame.display.get_init()
    """
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    path = os.pathsep.join([str(Path.cwd()), *sys.path])
    result = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        env={**environment, "SDL_VIDEODRIVER": "no such driver", "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout == ""


def test_robots_are_where_the_scene_says_and_to_scale() -> None:
    scene = make_scene(1)
    with_robot = draw(scene, **BARE)
    without = draw(scene._replace(x_mm=np.array([np.nan])), **BARE)
    rows, columns = np.nonzero((with_robot != without).any(axis=-1))
    px_per_mm = 360 / (4000 + 6 * 110)  # the path's height and the margins fill the picture
    in_picture = rows > 60  # below the text
    for pixels in (rows[in_picture], columns[in_picture]):
        assert np.ptp(pixels) + 1 == pytest.approx(220 * px_per_mm, abs=4)
    assert rows[in_picture].mean() == pytest.approx(180, abs=2)


@pytest.mark.parametrize("wheel", ["l", "r", "c"])
def test_a_slipping_wheel_is_marked_the_stronger_the_faster(wheel: str) -> None:
    marks = [
        count(draw(make_scene(1, **{f"slip_{wheel}_mm_s": np.array([slip])})), ALARM)
        for slip in (0.0, 1.9, 60.0)
    ]
    rolling, below_threshold, fast = marks
    assert rolling == below_threshold < fast
    slow, faster = (
        draw(make_scene(1, **{f"slip_{wheel}_mm_s": np.array([slip])})) for slip in (5.0, 30.0)
    )
    assert (slow != faster).any()


@pytest.mark.parametrize(
    "change",
    [
        {"wheel_angle_l_rad": np.full(3, 0.5)},
        {"wheel_angle_r_rad": np.full(3, 0.5)},
        {"castor_rad": np.full(3, 1.0)},
        {"theta_rad": np.zeros(3)},
        {"reference_y_mm": np.full(3, 100.0)},
        {"reference_theta_rad": np.full(3, 0.7)},
        {"position_error_mm": np.full(3, 12.3)},
        {"time_gap_error_s": np.full(3, -0.2)},
        {"lost": np.array([False, True, False])},
        {"touched": np.array([False, True, False])},
        {"t_s": 1.0},
    ],
    ids=lambda change: next(iter(change)),
)
def test_everything_in_a_scene_shows(change: dict[str, Any]) -> None:
    assert (draw(make_scene()) != draw(make_scene(**change))).any()


def test_what_a_robot_touched_is_written_beside_it() -> None:
    touched = {"touched": np.array([False, True, False])}
    pictures = [draw(make_scene(**touched, touched_by=np.array([0, by, 0]))) for by in range(4)]
    for i, picture in enumerate(pictures):
        assert all((picture != other).any() for other in pictures[:i])


def test_ghosts_of_followers_show_in_their_colour() -> None:
    there = make_scene(
        ghost_x_mm=np.array([np.nan, 0.0, np.nan]),
        ghost_y_mm=np.array([np.nan, 1000.0, np.nan]),
        ghost_theta_rad=np.zeros(3),
    )
    colour = robot_colours(3)[1]
    assert count(draw(there), colour) > count(draw(make_scene()), colour) + 50


def trail_pixels(renderer: Renderer, scene: Scene) -> int:
    """How many pixels a renderer with a past paints otherwise than one without."""
    return int((frame(renderer, scene) != draw(scene, **BARE)).any(axis=-1).sum())


def test_trails_grow_and_a_new_episode_forgets_them() -> None:
    renderer = make_renderer(1, **BARE)
    first = frame(renderer, make_scene(1))
    scenes = [make_scene(1, 1.0 * k, x_mm=np.array([500.0 + 200.0 * k])) for k in range(1, 6)]
    lengths = [trail_pixels(renderer, scene) for scene in scenes]
    assert lengths[0] > 5
    assert lengths == sorted(set(lengths))
    assert np.array_equal(frame(renderer, make_scene(1)), first)


def test_trails_end_after_their_time() -> None:
    renderer = make_renderer(1, trail_s=2.0, **BARE)
    frame(renderer, make_scene(1))
    moved = {"x_mm": np.array([-1500.0])}
    assert trail_pixels(renderer, make_scene(1, 1.0, **moved)) > 100
    assert trail_pixels(renderer, make_scene(1, 1.9, **moved)) > 0
    assert trail_pixels(renderer, make_scene(1, 4.0, **moved)) == 0


@pytest.mark.parametrize("size_px", [(960, 720), (333, 517), (70, 64)])
def test_only_what_changes_is_drawn_anew(size_px: tuple[int, int]) -> None:
    """A picture after others is, px by px, the one that is drawn from an empty canvas."""
    ghost = {f"ghost_{axis}": np.full(3, 300.0) for axis in ("x_mm", "y_mm", "theta_rad")}
    scenes = [
        make_scene(
            t_s=0.5 * k,
            x_mm=np.array([2500.0 - 700.0 * k, 100.0 * k**2, -900.0]),
            y_mm=np.array([60.0 * k, -800.0, 90.0 * k]),
            lost=np.array([False, k % 2 == 0, False]),
            touched=np.array([k % 3 == 0, False, False]),
            objects=(PlacedShape("moving", ((300.0 * k, 1200.0),), 200.0),),
            **(ghost if k % 2 else {}),
        )
        for k in range(8)
    ]
    renderer, anew = make_renderer(size_px=size_px), make_renderer(size_px=size_px)
    for scene in scenes:
        anew._background = None
        assert np.array_equal(frame(renderer, scene), frame(anew, scene))


def test_long_trails_stay_short_in_memory() -> None:
    renderer = make_renderer(1, trail_s=1.0, size_px=(64, 64))
    for k in range(1000):
        frame(renderer, make_scene(1, 0.02 * k))
    assert len(renderer._trail) < 110


@pytest.mark.parametrize(
    ("x_mm", "y_mm"), [(9000, 0), (-9000, 0), (0, 9000), (0, -9000), (1e9, 1e9), (-1e12, 0)]
)
def test_a_robot_that_leaves_shows_as_an_arrow_at_the_edge(x_mm: float, y_mm: float) -> None:
    renderer = make_renderer(1, **BARE)
    frame(renderer, make_scene(1))
    image = frame(renderer, make_scene(1, 0.1, x_mm=np.array([x_mm]), y_mm=np.array([y_mm])))
    inside = image[12:-12, 12:-12]
    colour = robot_colours(1)[0]
    assert count(image, colour, 60) > count(inside, colour, 60)


def test_values_that_are_not_numbers_do_no_harm() -> None:
    nowhere = np.full(3, np.nan)
    scene = make_scene(x_mm=nowhere, theta_rad=nowhere, slip_l_mm_s=nowhere, reference_x_mm=nowhere)
    renderer = make_renderer()
    frame(renderer, make_scene())
    frame(renderer, scene._replace(t_s=0.1))
    frame(renderer, scene._replace(t_s=0.2, position_error_mm=nowhere))
    assert make_renderer().draw(scene) is not None


def test_patches_shade_the_floor() -> None:
    patch = {"x_mm": 0.0, "y_mm": 1200.0, "radius_mm": 300.0}
    bare = draw(make_scene())
    slippery = draw(make_scene(), patches=[{**patch, "scale": 0.5}])
    grippy = draw(make_scene(), patches=[{**patch, "scale": 1.5}])
    assert count(bare, FLOOR, 2) > count(slippery, FLOOR, 2)
    assert (slippery != grippy).any()


def test_the_close_up_can_be_left_out() -> None:
    with_it, without = draw(make_scene()), draw(make_scene(), close_up=None)
    corner = slice(450, 700), slice(20, 180)
    assert with_it[corner].std() > 3 * without[corner].std()


def test_colours_differ() -> None:
    for robots in (1, 3, 7, 8, 20):
        assert len(set(robot_colours(robots))) == robots
        assert ALARM not in robot_colours(robots)


@pytest.mark.parametrize("robots", [3, 9])
def test_a_robot_has_the_colour_that_it_has_in_the_figures(robots: int) -> None:
    figures = pytest.importorskip("baselines.runs.figures")
    from matplotlib.colors import to_rgb

    from baselines import ReferencePolicy
    from baselines.runs.run import run_policy
    from tlf_env import load_scenario

    run = run_policy(load_scenario("flower", robots=robots, horizon_s=0.02), ReferencePolicy())
    labelled = {line.get_label(): line for line in figures.paths(run).axes[0].lines}
    x_mm = 3000.0 - 750.0 * np.arange(robots)
    renderer = make_renderer(robots, close_up=None, size_px=(1920, 1440))
    everyone = frame(renderer, make_scene(robots, x_mm=x_mm))
    for i in range(robots):
        colour = tuple(round(255 * c) for c in to_rgb(labelled[f"robot {i}"].get_color()))
        others = np.where(np.arange(robots) == i, np.nan, x_mm)
        without = frame(renderer, make_scene(robots, x_mm=others))
        assert count(everyone, colour, 0) > count(without, colour, 0) + 20


def test_a_nose_cannot_be_taken_for_pointing_elsewhere() -> None:
    left, right, tip = np.array(NOSE)
    base, sides = math.dist(left, right), (math.dist(left, tip), math.dist(right, tip))
    assert sides[0] == pytest.approx(sides[1])
    assert sides[0] > 1.8 * base


def test_round_lengths() -> None:
    assert [round_length(least) for least in (0.9, 1.0, 1.1, 3.0, 70.0, 600.0)] == pytest.approx(
        [1.0, 1.0, 2.0, 5.0, 100.0, 1000.0]
    )


def test_impossible_options_are_refused() -> None:
    with pytest.raises(ValueError, match="mode 'video' is not one of human, rgb_array"):
        make_renderer(mode="video")
    with pytest.raises(ValueError, match=r"size_px \(960, 10\) must be at least 64"):
        make_renderer(size_px=(960, 10))


def test_without_pygame_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    real_import = builtins.__import__

    def no_pygame(name: str, *arguments: Any, **options: Any) -> Any:
        if name.split(".")[0] == "pygame":
            raise ImportError(name)
        return real_import(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", no_pygame)
    with pytest.raises(ImportError, match=r"pip install 'tlf-env\[view\]'"):
        make_renderer()


def test_closing_twice_is_fine_and_drawing_then_does_nothing() -> None:
    renderer = make_renderer()
    frame(renderer, make_scene())
    renderer.close()
    renderer.close()
    assert renderer.draw(make_scene()) is None


@pytest.fixture
def window(monkeypatch: pytest.MonkeyPatch) -> Iterator[Renderer]:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame.display.quit()
    renderer = make_renderer(mode="human", fps=1000.0)
    yield renderer
    renderer.close()
    assert not pygame.display.get_init()


def test_a_window_shows_what_an_array_holds(window: Renderer) -> None:
    assert window.draw(make_scene()) is None
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
    assert np.array_equal(shown, draw(make_scene()))


def test_closing_the_window_quietly_stops_drawing(window: Renderer) -> None:
    window.draw(make_scene())
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    for k in range(3):
        assert window.draw(make_scene(t_s=0.1 * k)) is None
    assert not pygame.display.get_init()
    window.close()


def test_the_picture_follows_the_window_in_size(window: Renderer) -> None:
    window.draw(make_scene())
    pygame.display.set_mode((500, 400), pygame.RESIZABLE)
    window.draw(make_scene(t_s=0.1))
    window.draw(make_scene(t_s=0.2))
    surface = pygame.display.get_surface()
    assert surface.get_size() == (500, 400)
    assert pygame.surfarray.array3d(surface)[:, -100:].std() > 0


def test_a_window_keeps_to_its_frame_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    renderer = make_renderer(mode="human", fps=20.0, size_px=(64, 64))
    renderer.draw(make_scene())
    begin = time.perf_counter()
    for k in range(4):
        renderer.draw(make_scene(t_s=0.05 * k))
    assert time.perf_counter() - begin > 0.15
    renderer.close()


@pytest.mark.parametrize("robots", [1, 3])
def test_the_scene_of_a_formation_is_its_truth(robots: int) -> None:
    from tlf_env import parallel_env
    from tlf_env.rendering.scene import scene_of

    env = parallel_env("infinity", robots=robots, control_period_s=0.05, time_gap_s=1.0)
    env.reset(seed=1)
    start = scene_of(env.formation)
    kept = Scene(*(np.array(field) for field in start))
    assert np.isnan(start.ghost_x_mm).all()
    past = []
    for _ in range(30):
        past.append(scene_of(env.formation))
        env.step({agent: np.array([0.3, 0.0]) for agent in env.agents})
    scene, gap_ago = scene_of(env.formation), past[10]
    for field, before in zip(start, kept, strict=True):
        assert np.array_equal(field, before, equal_nan=True)
    assert scene.t_s == pytest.approx(1.5)
    state = env.formation.state()
    assert np.array_equal(scene.x_mm, state[:, 0])
    assert np.allclose(np.sin(scene.theta_rad), state[:, 2])
    assert all(np.shape(field) == (robots,) for field in scene[1:-1])
    assert (scene.wheel_angle_l_rad > 0).all()
    assert np.isnan(scene.ghost_x_mm[0])
    assert np.allclose(scene.ghost_x_mm[1:], gap_ago.x_mm[:-1])
    assert np.allclose(scene.ghost_y_mm[1:], gap_ago.y_mm[:-1])
    assert np.allclose(scene.ghost_theta_rad[1:], gap_ago.theta_rad[:-1], atol=0.02)
    error = np.hypot(scene.reference_x_mm - scene.x_mm, scene.reference_y_mm - scene.y_mm)
    assert np.allclose(scene.position_error_mm, error)
    assert draw(scene, size_px=(160, 120)).std() > 0


def test_a_ghost_that_stood_still_heads_as_its_robot_does() -> None:
    from tlf_env import parallel_env
    from tlf_env.rendering.scene import scene_of

    env = parallel_env("infinity", control_period_s=0.05, time_gap_s=1.0, disturbance="none")
    env.reset(seed=1)
    for _ in range(22):
        env.step({agent: np.zeros(2) for agent in env.agents})
    scene = scene_of(env.formation)
    assert np.allclose(scene.ghost_theta_rad[1:], scene.theta_rad[:-1], atol=1e-6)


ROUTE = {
    "trajectory": {
        "type": "waypoints",
        "points": [  # t_s, x_mm, y_mm
            [0, 0, 0],
            [6, 1500, 0],
            [12, 3000, 1200],
            [18, 3000, 3000],
            [30, 0, 3000],
        ],
    },
    "robots": 2,
    "time_gap_s": 1.0,
    "horizon_s": 10.0,
}
POSES = np.array([[-500.0, 700.0, 0.3], [-900.0, 200.0, -1.0]])


def still(agents: list[str]) -> dict[str, np.ndarray]:
    return {agent: np.zeros(2) for agent in agents}


@pytest.mark.parametrize(
    "options",
    [None, {"poses": POSES}, {"phase_s": 8.0}],
    ids=["plain", "poses", "phase"],
)
@pytest.mark.parametrize("steps", [0, 1, 60])
def test_nothing_of_an_episode_shows_in_the_next(options: Any, steps: int) -> None:
    used, fresh = (tlf_env.parallel_env(ROUTE, render_mode="rgb_array") for _ in range(2))
    used.reset(seed=3)
    for _ in range(steps):
        used.step({agent: np.array([1.0, 0.3]) for agent in used.agents})
        used.render()
    used.render()
    for env in (used, fresh):
        env.reset(seed=5, options=options)
    for _ in range(3):
        assert np.array_equal(used.render(), fresh.render())
        for env in (used, fresh):
            env.step(still(env.agents))


def test_the_path_shown_is_that_of_the_episode() -> None:
    renderer = make_renderer(1, **BARE)
    frame(renderer, make_scene(1))
    renderer.begin(0.5 * PATH_MM)
    other = Renderer([RobotParameters()], 0.5 * PATH_MM, mode="rgb_array", fps=50.0, **BARE)
    assert np.array_equal(frame(renderer, make_scene(1)), frame(other, make_scene(1)))


def patched(scale: float | None, level: float) -> np.ndarray:
    """The first frame with a patch of some friction, or none, at a disturbance level."""
    patch = {"x_mm": 1500.0, "y_mm": 1500.0, "radius_mm": 400.0, "friction_scale": scale}
    tyre = {"patches": [] if scale is None else [patch]}
    env = tlf_env.parallel_env(
        ROUTE, render_mode="rgb_array", disturbance={"tyre": tyre}, disturbance_level=level
    )
    env.reset(seed=0)
    image = env.render()
    assert image is not None
    return image


def test_patches_show_as_strong_as_the_level_makes_them() -> None:
    assert np.array_equal(patched(0.5, 0.0), patched(None, 0.0))
    assert np.array_equal(patched(1.0, 1.0), patched(None, 1.0))
    assert np.array_equal(patched(0.5, 0.5), patched(0.75, 1.0))
    assert not np.array_equal(patched(0.5, 1.0), patched(0.75, 1.0))
    assert not np.array_equal(patched(0.75, 1.0), patched(None, 1.0))


@pytest.fixture
def drawings(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Times (s) of the scenes drawn, in a window that is not shown."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame.display.quit()
    times_s: list[float] = []
    draw_scene = Renderer.draw

    def noting(renderer: Renderer, scene: Scene) -> np.ndarray | None:
        times_s.append(round(scene.t_s, 6))
        return draw_scene(renderer, scene)

    monkeypatch.setattr(Renderer, "draw", noting)
    return times_s


def shown() -> np.ndarray:
    """What the window shows, ``(height, width, 3)``."""
    return pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)


def test_a_window_is_drawn_once_by_reset_and_once_by_every_step(drawings: list[float]) -> None:
    env = tlf_env.parallel_env(ROUTE, render_mode="human")
    twin = tlf_env.parallel_env(ROUTE, render_mode="rgb_array")
    env.reset(seed=1)
    twin.reset(seed=1)
    assert drawings == [0.0]
    assert np.array_equal(shown(), twin.render())
    del drawings[:]
    for _ in range(3):
        env.step(still(env.agents))
        twin.step(still(twin.agents))
        assert env.render() is None
    assert drawings == [0.02, 0.04, 0.06]
    twin.close()
    env.reset(seed=1)
    assert drawings[-1] == 0.0
    env.close()
    assert not pygame.display.get_init()


@pytest.mark.parametrize("made_by", ["gymnasium", "aec"])
def test_the_other_interfaces_draw_once_per_step_too(made_by: str, drawings: list[float]) -> None:
    if made_by == "gymnasium":
        env = gymnasium.make("tlf_env/Infinity-v0", render_mode="human", horizon_s=0.06)
        env.reset(seed=0)
        for _ in range(3):
            env.step(np.zeros(2, np.float32))
    else:
        env = tlf_env.aec_env("infinity", render_mode="human", horizon_s=0.06)
        env.reset(seed=0)
        for agent in env.agent_iter():
            ended = env.terminations[agent] or env.truncations[agent]
            env.step(None if ended else np.zeros(2, np.float32))
    env.close()
    assert drawings == [0.0, 0.02, 0.04, 0.06]


def test_the_window_stays_closed_once_its_user_has_closed_it(drawings: list[float]) -> None:
    env = tlf_env.parallel_env(ROUTE, render_mode="human")
    env.reset(seed=1)
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    for _ in range(2):
        env.step(still(env.agents))
    env.reset(seed=1)
    assert not pygame.display.get_init()
    env.close()


# --- the world -------------------------------------------------------------------------------------

SQUARE = ((-300.0, 900.0), (300.0, 900.0), (300.0, 1500.0), (-300.0, 1500.0))
FORMS = {
    "circle": (((0.0, 1200.0),), 300.0),
    "segment": (((-300.0, 1200.0), (300.0, 1200.0)), 100.0),
    "polygon": (SQUARE, 0.0),
    "rounded": (SQUARE[::-1], 50.0),
}


def pixel(renderer: Renderer, image: np.ndarray, x_mm: float, y_mm: float) -> tuple[int, ...]:
    column, row = renderer._view.px(np.array([x_mm, y_mm])) / 2
    return tuple(image[int(row), int(column)].tolist())


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    ("kind", "colour"), [("fixed", WALL), ("loose", CRATE), ("moving", MOVER), ("zone", FLOOR)]
)
def test_a_thing_is_where_the_scene_says_and_to_scale(form: str, kind: Any, colour: Any) -> None:
    corners_mm, radius_mm = FORMS[form]
    thing = PlacedShape(kind, corners_mm, radius_mm)
    renderer = make_renderer(1, close_up=None)
    image = frame(renderer, make_scene(1, objects=(thing,)))
    bare = draw(make_scene(1), close_up=None)
    x_mm, y_mm = np.array(corners_mm).mean(axis=0)
    assert pixel(renderer, image, x_mm + 40.0, y_mm + 20.0) == colour  # off grid and diagonals
    away = np.abs(image.astype(int) - bare).max(axis=-1) > 0
    rows, columns = np.nonzero(away)
    scale = renderer._view.scale / 2
    width_mm, height_mm = np.ptp(np.array(corners_mm), axis=0) + 2 * radius_mm
    assert np.ptp(columns) + 1 == pytest.approx(width_mm * scale, abs=4)
    assert np.ptp(rows) + 1 == pytest.approx(height_mm * scale, abs=4)


def test_a_line_without_thickness_shows() -> None:
    line = PlacedShape("fixed", ((-500.0, 1200.0), (500.0, 1250.0)), 0.0)
    assert (draw(make_scene(objects=(line,))) != draw(make_scene())).any(axis=-1).sum() > 100


def test_things_that_move_leave_nothing_behind() -> None:
    kinds: Any = ("fixed", "loose", "moving")
    renderer, bare = make_renderer(**BARE), draw(make_scene(), **BARE)
    assert np.array_equal(frame(renderer, make_scene()), bare)
    for k, kind in enumerate(kinds):
        thing = PlacedShape(kind, ((100.0 * k, 1200.0),), 200.0)
        shown = frame(renderer, make_scene(objects=(thing,)))
        assert (shown != bare).any()
        assert np.array_equal(frame(renderer, make_scene()), bare)


def test_the_view_contains_a_room_but_not_the_whole_world() -> None:
    wide = make_renderer(1, close_up=None)
    room = tuple(
        PlacedShape("fixed", ends, 20.0)
        for ends in (((-2900.0, -2900.0), (2900.0, -2900.0)), ((-2900.0, 2900.0), (2900.0, 2900.0)))
    )
    image = frame(wide, make_scene(1, objects=room))
    for y_mm in (-2900.0, 2900.0):
        assert pixel(wide, image, -1000.0, y_mm) == WALL
    far = PlacedShape("fixed", ((-1e9, 2000.0), (1e9, 1e9)), 20.0)
    near = make_renderer(1, close_up=None)
    frame(near, make_scene(1, objects=(far,)))
    assert near._view.height / near._view.scale < 2 * (2000.0 + 1500.0) + 1000.0


def test_the_view_stays_when_a_wall_is_added() -> None:
    renderer = make_renderer(1)
    frame(renderer, make_scene(1))
    before = renderer._view
    wall = PlacedShape("fixed", ((-2900.0, 1000.0), (2900.0, 1000.0)), 20.0)
    image = frame(renderer, make_scene(1, 0.1, objects=(wall,)))
    assert renderer._view == before
    assert pixel(renderer, image, 700.0, 1000.0) == WALL
    renderer.begin(PATH_MM)
    frame(renderer, make_scene(1, objects=(wall,)))
    assert renderer._view != before


@pytest.mark.parametrize("far_mm", [1e4, 1e6, 1e12])
def test_a_thing_of_any_size_is_cut_at_the_edges(far_mm: float) -> None:
    corners = ((-far_mm, 1000.0), (far_mm, 1000.0), (far_mm, far_mm), (-far_mm, far_mm))
    renderer = make_renderer(1, size_px=(480, 360))
    image = frame(renderer, make_scene(1, objects=(PlacedShape("fixed", corners, 0.0),)))
    assert pixel(renderer, image, 330.0, 1700.0) == WALL
    assert pixel(renderer, image, 330.0, 830.0) == FLOOR


def test_clipping_keeps_what_is_inside() -> None:
    low, high = np.array([0.0, 0.0]), np.array([2.0, 1.0])
    inside = np.array([(0.5, 0.1), (1.5, 0.1), (1.0, 0.9)])
    assert np.array_equal(clipped(inside, low, high), inside)
    assert not len(clipped(inside + 5.0, low, high))
    whole = clipped(np.array([(-9.0, -9.0), (9.0, -9.0), (9.0, 9.0), (-9.0, 9.0)]), low, high)
    assert {tuple(corner) for corner in whole.tolist()} == {(0, 0), (2, 0), (2, 1), (0, 1)}


BOX_MM = ((-80.0, -110.0), (80.0, -110.0), (80.0, 60.0), (-80.0, 60.0))


def test_a_polygonal_outline_is_drawn_to_scale() -> None:
    box = RobotParameters(outline_polygon_mm=BOX_MM)
    renderer = Renderer([box], PATH_MM, mode="rgb_array", fps=50.0, close_up=None)
    scene = make_scene(1, theta_rad=np.zeros(1))
    image, nowhere = frame(renderer, scene), scene._replace(x_mm=np.array([np.nan]))
    away = np.abs(image.astype(int) - frame(renderer, nowhere)).max(axis=-1) > 0
    away[:100] = False  # the text
    rows, columns = np.nonzero(away)
    scale = renderer._view.scale / 2
    # the wheels stand out of the box to both sides
    assert np.ptp(columns) + 1 == pytest.approx((156 + 22) * scale, abs=4)
    assert np.ptp(rows) + 1 == pytest.approx(170 * scale, abs=4)
    touched = scene._replace(touched=np.array([True]))
    red = np.abs(frame(renderer, touched).astype(int) - ALARM).max(axis=-1) <= 60
    red[:100] = False
    rows, columns = np.nonzero(red)
    assert np.ptp(columns) + 1 == pytest.approx(160 * scale, abs=4)
    assert np.ptp(rows) + 1 == pytest.approx(170 * scale, abs=4)


WORLD = {
    "walls": [{"points_mm": [[-900, 700], [3600, 700]], "thickness_mm": 40}],
    "obstacles": [{"shape": {"type": "circle", "radius_mm": 80}, "x_mm": 300, "y_mm": -500}],
    "pushables": [
        {
            "shape": {"type": "box", "width_mm": 200, "length_mm": 200},
            "x_mm": 250,
            "y_mm": 0,
            "mass_kg": 0.2,
            "floor_friction": 0.05,
        }
    ],
    "moving": [
        {
            "shape": {"type": "circle", "radius_mm": 100},
            "points_mm": [[-400, -800], [900, -800]],
            "speed_mm_s": 300,
            "random_start": True,
        }
    ],
}
DRIVEN = {"disturbance": "none", "world": WORLD, "end_on": (), "robots": 2}


@pytest.mark.filterwarnings("ignore::tlf_env.task.warn.ReferenceWarning")
def test_a_look_does_not_change_a_run() -> None:
    seen: list[list[np.ndarray]] = []
    for looks in (False, True):
        env = tlf_env.parallel_env(ROUTE, render_mode="rgb_array", **DRIVEN)
        env.reset(seed=4)
        rows = []
        for _ in range(100):
            env.step({agent: np.array([0.8, 0.0]) for agent in env.agents})
            if looks:
                env.render()
            rows += [env.state(), env.formation.plant.object_poses(env.formation.step_count)]
        seen.append(rows)
    pushed = seen[0][-1][0, 0] - seen[0][1][0, 0]
    assert pushed > 50.0
    for one, other in zip(*seen, strict=True):
        assert np.array_equal(one, other)


@pytest.mark.filterwarnings("ignore::tlf_env.task.warn.ReferenceWarning")
def test_the_objects_of_a_scene_are_those_of_the_space() -> None:
    env = tlf_env.parallel_env(ROUTE, **DRIVEN)
    env.reset(seed=4)
    for _ in range(40):
        env.step({agent: np.array([0.8, 0.0]) for agent in env.agents})
    objects = scene_of(env.formation).objects
    assert [one.kind for one in objects] == ["fixed", "fixed", "loose", "moving"]
    space = env.space  # puts all bodies where they are now
    places = {body.body_type: body.position for body in list(space.bodies)[2:]}
    crate, person = objects[2:]
    assert np.allclose(np.mean(crate.corners_mm, axis=0), places[pymunk.Body.DYNAMIC])
    assert np.allclose(person.corners_mm[0], places[pymunk.Body.KINEMATIC], atol=1e-9)
    poses = env.formation.plant.object_poses(env.formation.step_count)
    assert np.array_equal(poses[1, :2], person.corners_mm[0])


def test_what_a_user_puts_into_the_space_shows() -> None:
    env = tlf_env.parallel_env(ROUTE, robots=2, end_on=())
    env.reset(seed=4)
    space, bodies = env.space, env.robot_bodies
    assert scene_of(env.formation).objects == ()
    trailer = pymunk.Body(1.0, 1000.0)
    trailer.position = bodies["robot_1"].local_to_world((-300.0, 0.0))
    turntable = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
    turntable.position, turntable.angular_velocity = (1000.0, 1000.0), 1.0
    bumper = pymunk.Segment(bodies["robot_0"], (-100.0, 90.0), (100.0, 90.0), 5.0)
    zone = pymunk.Circle(space.static_body, 100.0, (2000.0, 2000.0))
    zone.sensor = True
    rope = pymunk.SlideJoint(trailer, bodies["robot_1"], (0.0, 0.0), (0.0, -80.0), 0.0, 400.0)
    table = pymunk.Poly.create_box(turntable, (300.0, 100.0))
    space.add(trailer, pymunk.Circle(trailer, 60.0), rope, bumper, zone, turntable, table)
    space.add(pymunk.Segment(space.static_body, (500.0, 2000.0), (900.0, 2000.0), 0.0))
    objects = scene_of(env.formation).objects
    kinds = sorted(one.kind for one in objects)
    assert kinds == ["fixed", "link", "loose", "loose", "moving", "zone"]
    for _ in range(25):
        env.step({agent: np.array([0.5, 0.0]) for agent in env.agents})
    later = scene_of(env.formation).objects
    moved = {one.kind for one, other in zip(objects, later, strict=True) if one != other}
    assert moved == {"link", "loose", "moving"}
    link = next(one for one in later if one.kind == "link")
    ends = [trailer.position, env.robot_bodies["robot_1"].local_to_world((0.0, -80.0))]
    assert np.allclose(link.corners_mm, ends)
    ahead = next(one for one in later if one.radius_mm == 5.0)
    robot = env.robot_bodies["robot_0"]
    assert np.allclose(ahead.corners_mm, [robot.local_to_world((x, 90.0)) for x in (-100.0, 100.0)])
