"""``tlf view``: every control changes what it names, and without one the episode is that of ``tlf run``."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import refused

from baselines import cli
from baselines.commands.live import menus
from baselines.live.session import MOST_LEVEL, MOST_PUSH_N, Session
from baselines.live.window import HEAD_PX, LiveWindow
from baselines.policies.registry import fit_policy
from baselines.runs.run import run_policy
from tests.live_helpers import (
    DISTURBANCES,
    ENTER,
    ESCAPE,
    POLICIES,
    SIZE_PX,
    does,
    key,
    let_go,
    moved,
    picture,
    pressed,
    pygame,
    released,
    short,
    wheel,
)


@pytest.fixture(autouse=True)
def no_display(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr("baselines.live.window.MOST_BUSY_S", 60.0)
    pygame.display.quit()
    yield
    pygame.display.quit()


def opened(session: Session | None = None, **options: Any) -> LiveWindow:
    session = session or Session(short(), "reference:linearised", 3)
    window = LiveWindow(
        session, policies=POLICIES, disturbances=DISTURBANCES, size_px=SIZE_PX, **options
    )
    does(window)
    return window


def positions(session: Session) -> np.ndarray:
    info = session.formation.info()
    return np.stack([info.x_mm, info.y_mm])


def run_to_end(session: Session) -> np.ndarray:
    rows = [positions(session)]
    while not session.ended:
        session.step()
        rows.append(positions(session))
    return np.array(rows)


# --- the episode


@pytest.mark.parametrize("policy", ["reference:linearised", "residual"])
@pytest.mark.parametrize("disturbance", ["slip", "payload", "patches", "nominal"])
def test_an_episode_without_a_hand_is_that_of_a_run(policy: str, disturbance: str) -> None:
    scenario = short(disturbance=disturbance, horizon_s=4.0)
    fitted = fit_policy(policy, scenario)
    record = run_policy(fitted.scenario, fitted.policy, 5)
    rows = run_to_end(Session(scenario, policy, 5))
    assert np.array_equal(rows[:, 0], record["x_mm"])
    assert np.array_equal(rows[:, 1], record["y_mm"])


def test_a_window_with_view_keys_leaves_the_episode_as_it_is() -> None:
    alone, shown = (Session(short(), "reference:linearised", 3) for _ in range(2))
    window = opened(shown)
    does(window, key("+"), key("f"), key("h"), elapsed_s=0.5)
    does(window, key(" "), elapsed_s=3.0)
    assert shown.formation.time_s == pytest.approx(0.5)
    does(window, key("."), key("."), elapsed_s=3.0)
    assert shown.formation.time_s == pytest.approx(0.54)
    does(window, key(" "), key("]"), key("0"), wheel(2), elapsed_s=0.0)
    while not shown.ended:
        does(window, elapsed_s=0.2)
    assert not shown.changes
    assert window.note() == ""
    assert np.array_equal(positions(shown), run_to_end(alone)[-1])


def test_time_runs_as_fast_as_wanted() -> None:
    window = opened()
    for k, speed in ((key(), 1.0), (key("]"), 2.0), (key("["), 1.0), (key("["), 0.5)):
        before = window.session.formation.time_s
        for _ in range(4):
            does(window, elapsed_s=0.04) if _ else does(window, k, elapsed_s=0.04)
        assert window.session.formation.time_s - before == pytest.approx(0.16 * speed, abs=0.021)
    assert "0.5 × real time" in window.state()


def test_a_patch_acts_at_once_and_is_shown() -> None:
    window = opened()
    session = window.session
    does(window, elapsed_s=0.5)
    plain = picture()
    at = (500.0, 300.0)
    does(window, pressed(at, button=3))
    x_mm, y_mm = window.renderer.place_mm((at[0], at[1] - HEAD_PX))
    row = session.formation.arrays.patches[0, -1]
    assert tuple(row[:2]) == pytest.approx((x_mm, y_mm))
    assert (picture() != plain).any(axis=-1).sum() > 500
    assert window.note() == "changed by hand: 1 patch"
    does(window, pressed(at, button=3))
    assert window.note() == "changed by hand: 2 patches"


def test_robots_slip_on_a_patch() -> None:
    slips = []
    for scale in (False, True):
        session = Session(short(disturbance="nominal"), "reference:linearised", 0)
        for k in range(200):
            session.step()
            if scale and k == 50:
                session.drop_patch(*positions(session)[:, 0].tolist())
        slips.append(positions(session))
    assert not np.array_equal(*slips)


def test_a_push_moves_the_robot_that_is_dragged() -> None:
    window, twin = opened(), Session(short(), "reference:linearised", 3)
    session = window.session
    does(window, elapsed_s=0.5)
    x, y = window.renderer.px_of(*positions(session)[:, 1].tolist())
    start, end = (x, y + HEAD_PX), (x + 60.0, y + HEAD_PX)
    does(window, key(code=pygame.K_LSHIFT), pressed(start), moved(end, start))
    assert not session.changes  # not yet
    does(window, let_go(end), released(pygame.K_LSHIFT))
    assert session.changes == ["push"]
    assert window.message.startswith("robot_1 is pushed with ")
    for _ in range(40):
        twin.step()
        if twin.formation.step_count > 25:
            session.step()
    pushed, alone = positions(session), positions(twin)
    assert pushed[0, 1] - alone[0, 1] > 1.0
    assert np.array_equal(pushed[:, 0], alone[:, 0])  # the leader does not feel it
    does(window, pressed(start), moved(end, start), let_go(end))
    assert (
        window.renderer.camera.centre_mm is not None
    )  # without shift the same drag moves the view


def test_a_push_is_bounded_and_ends() -> None:
    session = Session(short(), "reference:linearised", 3)
    assert session.push(0, 3.0, 4.0) == pytest.approx((3.0, 4.0))
    assert np.hypot(*session.push(0, 3e3, 4e3)) == pytest.approx(MOST_PUSH_N)
    session.step()
    assert np.isfinite(session.formation.arrays.imposed).sum() == 2
    for _ in range(12):
        session.step()
    assert not np.isfinite(session.formation.arrays.imposed).any()


def test_the_level_is_set_by_keys_and_slider() -> None:
    window = opened()
    does(window, key(code=pygame.K_UP), key(code=pygame.K_UP))
    assert window.session.level == pytest.approx(1.2)
    does(window, key(code=pygame.K_DOWN))
    assert window.session.level == pytest.approx(1.1)
    slider = window._slider
    does(window, pressed(slider.center), moved((slider.right, slider.centery)))
    assert window.session.level == pytest.approx(MOST_LEVEL)
    does(window, let_go(slider.center), moved((slider.left, slider.centery)))
    assert window.session.level == pytest.approx(MOST_LEVEL)
    does(window, pressed((slider.left - 3, slider.centery)), let_go(slider.center))
    assert window.session.level == 0.0
    assert window.note() == "changed by hand: level 0"


def test_the_level_acts_at_once() -> None:
    """At level 0 from the start a disturbance does nothing; what is drawn at the start stays."""
    weak, none = (
        Session(short(), "residual", 3),
        Session(short(disturbance_level=0.0), "residual", 3),
    )
    assert weak.set_level(0.0) == []
    assert np.array_equal(run_to_end(weak)[-1], run_to_end(none)[-1])
    assert Session(short(disturbance="payload"), "residual", 3).set_level(2.0) == ["payload"]


def test_patches_of_a_disturbance_follow_the_level() -> None:
    session = Session(short(disturbance="patches"), "residual", 3)
    before = session.formation.arrays.patches[0].copy()
    session.set_level(0.5)
    after = session.formation.arrays.patches[0]
    assert after[:, 3] == pytest.approx(1.0 + 0.5 * (before[:, 3] - 1.0))
    session.set_level(MOST_LEVEL)
    assert (session.formation.arrays.patches[0][:, 3] >= 0.0).all()


# --- switches


def choose(window: LiveWindow, letter: str, name: str) -> None:
    does(window, key(letter))
    assert window.menu is not None
    while list(window.menu.lines)[window.menu.at] != name:
        does(window, key(code=pygame.K_DOWN))
    does(window, key(code=ENTER))
    assert window.menu is None


def test_the_policy_is_switched_from_a_list() -> None:
    window = opened()
    does(window, pressed((400, 300), button=3), elapsed_s=0.5)
    choose(window, "p", "residual")
    session = window.session
    assert (session.policy, session.formation.step_count, session.changes) == ("residual", 0, [])
    assert session.scenario.action == "residual"
    assert "policy residual: seed 3 from its start; it asks for action residual" in window.message
    alone = Session(short(), "residual", 3)
    assert np.array_equal(run_to_end(session)[-1], run_to_end(alone)[-1])


def test_the_disturbance_is_switched_with_the_mouse() -> None:
    window = opened()
    does(window, key("t"))
    plate = window._menu_plate
    does(window, pressed((plate.centerx, plate.bottom - 16)))
    assert window.menu is None
    assert window.session.scenario.disturbance.name == "ice"
    assert "disturbance ice: seed 3 from its start" in window.message
    does(window, key("t"))
    does(window, pressed((5, 200)))  # beside the list
    assert window.menu is None
    assert window.session.scenario.disturbance.name == "ice"


def test_a_long_list_scrolls_in_a_small_window() -> None:
    policies, disturbances = menus()
    session = Session(short(), "reference:linearised", 3)
    window = LiveWindow(session, policies=policies, disturbances=disturbances, size_px=(560, 420))
    does(window, key("t"))
    for name in list(disturbances)[list(disturbances).index("slip") :]:
        assert window.menu is not None
        shown = window._shown_rows(window.menu)
        assert name in list(disturbances)[shown.start : shown.stop]
        assert window._menu_plate.top >= 0
        assert window._menu_plate.bottom <= 420
        does(window, key(code=pygame.K_DOWN))
    does(window, wheel(1))
    plate = window._menu_plate
    does(window, pressed((plate.centerx, plate.bottom - 16)))
    assert window.session.scenario.disturbance.name == list(disturbances)[-1]


def test_a_policy_that_does_not_fit_leaves_the_episode_as_it_is() -> None:
    window = opened()
    does(window, elapsed_s=0.5)
    choose(window, "p", "reference:no")
    assert window.session.policy == "reference:linearised"
    assert window.session.formation.time_s == pytest.approx(0.5)
    assert "no" in window.message


def test_a_key_that_is_held_acts_once_unless_it_is_made_for_it() -> None:
    window = opened()
    space, up = key(" ", pygame.K_SPACE), key(code=pygame.K_UP)
    does(window, space, space, space)
    assert window.controls.paused
    does(window, released(pygame.K_SPACE), space)
    assert not window.controls.paused
    does(window, up, up, up)
    assert window.session.level == pytest.approx(1.3)


def test_a_policy_without_a_name_is_refused() -> None:
    with pytest.raises(ValueError, match="policy '' is not one of"):
        Session(short(), "")


def test_restart_and_next_seed() -> None:
    window = opened()
    session = window.session
    does(window, pressed((400, 300), button=3), elapsed_s=0.5)
    does(window, key("r"))
    assert (session.seed, session.formation.step_count, session.changes) == (3, 0, [])
    does(window, key("n"))
    assert session.seed == 4
    assert "seed 4" in window.title()
    assert pygame.display.get_caption()[0].startswith("tlf: infinity, reference:linearised, slip")


def test_the_robot_that_is_followed_is_pushed_by_a_key() -> None:
    window = opened()
    does(window, key("f"), key("f"), key("f"))
    does(window, key("k"))
    assert window.message.startswith("robot_2 is pushed with 4.0 N")


def test_the_end_of_an_episode_is_said() -> None:
    window = opened(Session(short(horizon_s=0.2), "reference:linearised", 3))
    does(window, elapsed_s=5.0)
    does(window, elapsed_s=5.0)
    assert window.session.ended
    assert window.state() == "ended"
    does(window, key("r"))
    assert not window.session.ended


# --- the window


def test_all_keys_are_listed_on_the_screen() -> None:
    window = opened()
    plain = picture()
    does(window, key("h"))
    assert (picture() != plain).any(axis=-1).mean() > 0.02
    does(window, key("?"))
    assert np.array_equal(picture(), plain)


def test_the_view_moves_with_the_mouse() -> None:
    window = opened()
    place = window.renderer.place_mm((600, 300 - HEAD_PX))
    does(window, moved((600, 300)), wheel(3))
    assert window.renderer.place_mm((600, 300 - HEAD_PX)) == pytest.approx(place)
    does(window, pressed((600, 300)), moved((650, 330), (600, 300)), let_go((650, 330)))
    assert window.renderer.place_mm((650, 330 - HEAD_PX)) == pytest.approx(place)
    does(window, key("0"))
    assert window.renderer.camera.is_whole


@pytest.mark.parametrize("closing", [key("q"), key(code=ESCAPE), pygame.event.Event(pygame.QUIT)])
def test_it_closes(closing: Any) -> None:
    window = opened()
    pygame.event.post(closing)
    window.run()
    assert not window.open
    assert not pygame.display.get_init()


def test_a_window_of_another_size_is_filled() -> None:
    window = opened()
    pygame.display.set_mode((1000, 760), pygame.RESIZABLE)
    does(window, pygame.event.Event(pygame.VIDEORESIZE, size=(1000, 760), w=1000, h=760))
    assert window.renderer.size_px == (1000, 760 - HEAD_PX - 48)


def test_a_picture_of_the_window_is_saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    window = opened()
    does(window, key(code=pygame.K_F12), released(pygame.K_F12))
    does(window, key(code=pygame.K_F12))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["tlf-1.png", "tlf-2.png"]
    assert pygame.image.load(tmp_path / "tlf-1.png").get_size() == SIZE_PX


def test_both_themes_are_drawn() -> None:
    light = opened()
    bright = picture().mean()
    assert light.theme != opened(theme="dark").theme
    assert picture().mean() < 0.4 * bright


def test_plants_without_forces_say_so() -> None:
    for plant in ("kinematic", "batch"):
        window = opened(Session(short(plant=plant), "reference:linearised", 3))
        does(window, pressed((400, 300), button=3))
        assert window.message == f"plant {plant}: a patch has no effect"
        does(window, key("k"))
        assert window.message == f"plant {plant}: a push has no effect"
        does(window, key(code=pygame.K_UP))
        assert window.message == f"plant {plant}: the level cannot change while it runs"
        assert not window.session.changes


def test_the_lists_have_the_shipped_names() -> None:
    policies, disturbances = menus()
    assert {"reference:linearised", "residual", "kanayama", "nmpc"} <= set(policies)
    assert {"slip", "ice", "combined-hard"} <= set(disturbances)
    assert not {"module:factory", "FILE.zip"} & set(policies)


# --- the command


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["infinityx"], "did you mean 'infinity'"),
        (["infinity", "--policy", "residul"], "did you mean 'residual'"),
        (["infinity", "--disturbance", "slp"], "did you mean 'slip'"),
        (
            ["infinity", "--theme", "drk"],
            "theme 'drk' is not one of light, dark; did you mean 'dark'",
        ),
        (["infinity", "--seed", "-1"], "seed"),
        (["infinity", "--set", "time_gap=3"], "did you mean 'time_gap_s'"),
    ],
)
@pytest.mark.parametrize("command", ["view", "play"])
def test_bad_input_is_refused_in_one_line(
    command: str, words: list[str], message: str, capsys: Any, monkeypatch: Any, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    assert message in refused([command, *words], capsys, monkeypatch)


@pytest.mark.parametrize("command", ["view", "play"])
def test_without_a_display_it_says_so(
    command: str, capsys: Any, monkeypatch: Any, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SDL_VIDEODRIVER", "no such driver")
    line = refused([command, "infinity"], capsys, monkeypatch)
    assert "no window can be opened" in line
    assert "there is no display" in line


@pytest.mark.parametrize("command", ["view", "play"])
def test_without_pygame_it_says_what_to_install(
    command: str, capsys: Any, monkeypatch: Any, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "pygame", None)
    assert "pip install 'tlf-env[view]'" in refused([command, "infinity"], capsys, monkeypatch)


def test_the_command_shows_a_window(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[LiveWindow] = []

    def one_frame(window: LiveWindow) -> None:
        window.frame(0.1)
        shown.append(window)

    monkeypatch.setattr(LiveWindow, "run", one_frame)
    words = ["--policy", "residual", "--disturbance", "ice", "--seed", "7", "--theme", "dark"]
    cli.app(["view", "flower", "--robots", "2", *words], standalone_mode=False)
    (window,) = shown
    assert window.title() == "flower, residual, ice, seed 7"
    assert window.session.formation.time_s == pytest.approx(0.1)
