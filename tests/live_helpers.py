"""Events of a window, and a session to show, for the tests of live windows."""

from __future__ import annotations

from typing import Any

import pytest

from tlf_env.task.scenario import load_scenario

pygame = pytest.importorskip("pygame")

SIZE_PX = (900, 700)
ENTER, ESCAPE = pygame.K_RETURN, pygame.K_ESCAPE
POLICIES = {"reference:linearised": "The default.", "residual": "PPO.", "reference:no": "None."}
DISTURBANCES = {"nominal": "Nothing.", "slip": "Slip.", "ice": "Half the friction."}


def short(task: str = "infinity", **fields: Any) -> Any:
    return load_scenario(task, **{"disturbance": "slip", "horizon_s": 6.0, **fields})


def key(text: str = "", code: int = 0) -> Any:
    return pygame.event.Event(pygame.KEYDOWN, unicode=text, key=code, mod=0)


def released(code: int) -> Any:
    return pygame.event.Event(pygame.KEYUP, key=code, mod=0)


def moved(pos: tuple[float, float], before: tuple[float, float] | None = None) -> Any:
    x, y = round(pos[0]), round(pos[1])
    rel = (0, 0) if before is None else (x - round(before[0]), y - round(before[1]))
    return pygame.event.Event(pygame.MOUSEMOTION, pos=(x, y), rel=rel, buttons=(0, 0, 0))


def pressed(pos: tuple[float, float], button: int = 1) -> Any:
    at = round(pos[0]), round(pos[1])
    return pygame.event.Event(pygame.MOUSEBUTTONDOWN, pos=at, button=button)


def let_go(pos: tuple[float, float], button: int = 1) -> Any:
    at = round(pos[0]), round(pos[1])
    return pygame.event.Event(pygame.MOUSEBUTTONUP, pos=at, button=button)


def wheel(notches: int) -> Any:
    return pygame.event.Event(pygame.MOUSEWHEEL, x=0, y=notches, flipped=False)


def does(window: Any, *events: Any, elapsed_s: float = 0.0) -> None:
    """Let a window take events in one frame."""
    pygame.event.clear()
    for event in events:
        pygame.event.post(event)
    window.frame(elapsed_s)


def picture() -> Any:
    """What the window shows, ``(height, width, 3)``."""
    return pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
