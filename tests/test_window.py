"""Keys and mouse of ``render_mode="human"``: they change the view and the time, never the episode."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import tlf_env
from tlf_env.rendering.renderer import Renderer
from tlf_env.rendering.window import WAITING_FPS, Window

pygame = pytest.importorskip("pygame")

ROUTE = {
    "trajectory": {"type": "waypoints", "points": [[0, 0, 0], [6, 1500, 0], [30, 1500, 3000]]},
    "robots": 2,
    "time_gap_s": 2.0,
    "horizon_s": 4.0,
}
PRESSES = {" ": pygame.K_SPACE, "": pygame.K_PAGEUP}


@pytest.fixture(autouse=True)
def no_display(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame.display.quit()
    monkeypatch.setattr(pygame.time, "Clock", lambda: Clock())
    yield
    pygame.display.quit()


class Clock:
    """A clock that notes how long a frame may take, and does not wait."""

    wanted: list[float] = []
    waiting: list[Any] = []  # events that come while a window waits

    def tick(self, fps: float) -> None:
        self.wanted.append(fps)
        if fps == WAITING_FPS:
            assert self.waiting, "the window waits for ever"
            pygame.event.post(self.waiting.pop(0))


def key(text: str, code: int = 0) -> Any:
    return pygame.event.Event(pygame.KEYDOWN, unicode=text, key=code or PRESSES.get(text, 0), mod=0)


def wheel(notches: int) -> Any:
    return pygame.event.Event(pygame.MOUSEWHEEL, x=0, y=notches, flipped=False)


def mouse(kind: int, pos: tuple[int, int], **more: Any) -> Any:
    return pygame.event.Event(kind, pos=pos, **more)


def window_of(env: Any) -> tuple[Renderer, Window]:
    renderer = env._renderer
    assert renderer._window is not None
    return renderer, renderer._window


def episode(events: dict[int, list[Any]]) -> list[np.ndarray]:
    env = tlf_env.parallel_env(ROUTE, render_mode="human", disturbance="slip")
    observations, _ = env.reset(seed=3)
    seen = list(observations.values())
    for k in range(60):
        for event in events.get(k, []):
            pygame.event.post(event)
        action = {agent: np.array([0.3, 0.1 * np.sin(k)]) for agent in env.agents}
        observations, rewards, *_ = env.step(action)
        seen += [*observations.values(), np.array(list(rewards.values())), env.state()]
    env.close()
    return seen


@pytest.mark.filterwarnings("ignore::tlf_env.task.warn.ReferenceWarning")
def test_no_key_changes_an_episode() -> None:
    Clock.waiting[:] = [key("."), key("+"), key("."), key(" ")]
    everything = {
        1: [key("+"), key("-"), key("f"), key("h")],
        5: [key("["), key("]"), key("]"), key("", pygame.K_PAGEUP)],
        7: [mouse(pygame.MOUSEMOTION, (300, 200), rel=(0, 0), buttons=(0, 0, 0)), wheel(3)],
        8: [mouse(pygame.MOUSEBUTTONDOWN, (300, 200), button=1)],
        9: [mouse(pygame.MOUSEMOTION, (350, 260), rel=(50, 60), buttons=(1, 0, 0))],
        10: [mouse(pygame.MOUSEBUTTONUP, (350, 260), button=1), key("0"), key("?")],
        12: [key(" ")],
    }
    plain, with_keys = episode({}), episode(everything)
    assert not Clock.waiting  # it did wait
    for one, other in zip(plain, with_keys, strict=True):
        assert np.array_equal(one, other)


@pytest.fixture
def env() -> Iterator[Any]:
    made = tlf_env.parallel_env(ROUTE | {"time_gap_s": 2.5}, render_mode="human")
    made.reset(seed=1)
    yield made
    made.close()


def step(env: Any, *events: Any) -> None:
    for event in events:
        pygame.event.post(event)
    env.step({agent: np.zeros(2) for agent in env.agents})


def test_the_view_follows_keys_and_mouse(env: Any) -> None:
    renderer, _ = window_of(env)
    whole = renderer.view
    step(env, key("+"))
    assert renderer.view.scale == pytest.approx(1.25 * whole.scale)
    step(env, key("-"))
    assert renderer.view.scale == pytest.approx(whole.scale)
    at_px = (700, 200)
    place = renderer.place_mm(at_px)
    step(env, mouse(pygame.MOUSEMOTION, at_px, rel=(0, 0), buttons=(0, 0, 0)), wheel(4))
    assert renderer.view.scale == pytest.approx(1.25**4 * whole.scale)
    assert renderer.place_mm(at_px) == pytest.approx(place)
    assert renderer.px_of(*place) == pytest.approx(at_px)
    step(env, mouse(pygame.MOUSEBUTTONDOWN, at_px, button=1))
    step(env, mouse(pygame.MOUSEMOTION, (650, 260), rel=(-50, 60), buttons=(1, 0, 0)))
    assert renderer.place_mm((650, 260)) == pytest.approx(place)
    step(env, mouse(pygame.MOUSEBUTTONUP, (650, 260), button=1))
    step(env, mouse(pygame.MOUSEMOTION, (0, 0), rel=(-650, -260), buttons=(0, 0, 0)))
    assert renderer.place_mm((650, 260)) == pytest.approx(place)
    step(env, key("f"), key("f"))
    x_mm, y_mm = env.state()[12:14] * 1000.0
    middle = renderer.px_of(float(x_mm), float(y_mm))
    assert middle == pytest.approx((renderer.size_px[0] / 2, renderer.size_px[1] / 2))
    step(env, key("0"))
    assert renderer.view == whole


def test_pause_step_and_speed_only_wait(env: Any) -> None:
    _, window = window_of(env)
    Clock.wanted.clear()
    step(env, key("]"))
    assert Clock.wanted == [100.0]
    step(env, key("["), key("["))
    assert Clock.wanted[-1] == 25.0
    Clock.waiting[:] = [key("+"), key("h"), key(".")]
    step(env, key(" "))
    assert window.controls.paused
    assert window.controls.help
    assert not Clock.waiting
    Clock.waiting[:] = [key(" ")]
    step(env)
    assert not window.controls.waits


def test_the_keys_are_listed_on_the_screen_only_when_asked(env: Any) -> None:
    def corner() -> np.ndarray:
        return pygame.surfarray.array3d(pygame.display.get_surface())[-300:, :200].copy()

    plain = corner()
    step(env, key("h"))
    assert (corner() != plain).mean() > 0.05
    step(env, key("?"))
    assert np.array_equal(corner(), plain)


def test_a_window_can_be_closed_while_it_is_paused(env: Any) -> None:
    Clock.waiting[:] = [pygame.event.Event(pygame.QUIT)]
    step(env, key(" "))
    assert not pygame.display.get_init()
    step(env)
    env.reset(seed=1)
    assert not pygame.display.get_init()


@pytest.mark.parametrize("theme", tlf_env.rendering.looks.THEMES)
def test_robots_and_text_stand_out_from_the_floor(theme: str) -> None:
    from tlf_env.rendering.looks import THEMES, robot_colours

    def luminance(colour: tuple[int, int, int]) -> float:
        part = np.array(colour) / 255.0
        linear = np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)
        return float(linear @ (0.2126, 0.7152, 0.0722))

    def contrast(one: tuple[int, int, int], other: tuple[int, int, int]) -> float:
        low, high = sorted((luminance(one), luminance(other)))
        return (high + 0.05) / (low + 0.05)

    chosen = THEMES[theme]
    assert contrast(chosen.ink, chosen.floor) > 7.0
    assert contrast(chosen.alarm, chosen.floor) > 4.0
    for robots in (1, 3, 7, 12, 40):
        for colour in robot_colours(robots, chosen):
            assert contrast(colour, chosen.floor) > 1.4
            assert colour != chosen.alarm
