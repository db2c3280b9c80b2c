"""``tlf view`` and ``tlf play`` on a virtual display, driven by real keys and a real mouse.

    make check-live

It needs Xvfb and xdotool. Pictures of the windows, in both themes, are left in ``results/live``.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pygame

from tlf_env.rendering.looks import THEMES
from tlf_env.task.scenario import load_scenario

ROOT = Path(__file__).resolve().parents[1]
PICTURES = ROOT / "results" / "live"
SCREEN_PX = (1280, 900)
SIZE_PX = (1180, 820)
LEFT, TOP = ((a - b) // 2 for a, b in zip(SCREEN_PX, SIZE_PX, strict=True))
PATIENCE_S = 120.0


@contextmanager
def display() -> Iterator[dict[str, str]]:
    """The environment of a virtual display."""
    reading, writing = os.pipe()
    screen = f"{SCREEN_PX[0]}x{SCREEN_PX[1]}x24"
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(writing), "-screen", "0", screen],
        pass_fds=[writing],
        stderr=subprocess.DEVNULL,
    )
    os.close(writing)
    try:
        with os.fdopen(reading) as pipe:
            number = pipe.readline().strip()
        path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
        environment = {k: v for k, v in os.environ.items() if not k.startswith("SDL_")}
        yield {**environment, "DISPLAY": f":{number}", "PYTHONPATH": path}
    finally:
        server.terminate()
        server.wait()


class Hand:
    """Keys and mouse on a display, and the pictures that a window saves of itself."""

    def __init__(self, environment: dict[str, str], folder: Path) -> None:
        self._environment, self._folder = environment, folder

    def does(self, *words: object, wait_s: float = 0.4) -> None:
        """Let xdotool do something."""
        command = ["xdotool", *map(str, words)]
        subprocess.run(command, env=self._environment, check=True)
        time.sleep(wait_s)

    def types(self, text: str, wait_s: float = 0.4) -> None:
        """Press keys one after the other."""
        for letter in text:
            self.does("type", letter, wait_s=0.15)
        time.sleep(wait_s)

    def points(self, x: float, y: float) -> None:
        """Move the mouse to a place in the window."""
        self.does("mousemove", LEFT + round(x), TOP + round(y), wait_s=0.1)

    def picture(self, name: str) -> np.ndarray:
        """A picture that the window saves, which is kept under a name."""
        path = self._folder / f"tlf-{len(list(self._folder.glob('tlf-*.png'))) + 1}.png"
        end = time.monotonic() + PATIENCE_S
        while not path.exists():
            if time.monotonic() > end:
                raise TimeoutError(f"no picture {name} within {PATIENCE_S:g} s")
            self.does("key", "F12", wait_s=1.0)  # a window that is not open yet does not get it
        time.sleep(0.2)  # it is written
        shutil.copy(path, PICTURES / f"{name}.png")
        surface = pygame.image.load(path)
        assert surface.get_size() == SIZE_PX, surface.get_size()
        return pygame.surfarray.array3d(surface).swapaxes(0, 1).astype(int)


def differing(one: np.ndarray, other: np.ndarray) -> float:
    """Share of the picture that two pictures differ in, without the bar."""
    return float((np.abs(one - other) > 8).any(axis=-1)[:-48].mean())


def run(words: list[str], folder: Path, check: Callable[[Hand], None]) -> str:
    """Run a command with a window in a folder, do something with it, and close it; what it printed."""
    folder.mkdir()
    with display() as environment:
        process = subprocess.Popen(
            [sys.executable, "-m", "baselines", *words],
            cwd=folder,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        try:
            hand = Hand(environment, folder)
            check(hand)
            hand.types("q")
            printed, _ = process.communicate(timeout=30)
        finally:
            if process.poll() is None:
                process.kill()
    assert process.returncode == 0, printed
    return printed


def check_view(theme: str) -> Callable[[Hand], None]:
    """The keys and the mouse of ``tlf view``, each with a picture."""

    def check(hand: Hand) -> None:
        hand.picture(f"view-{theme}-start")
        time.sleep(3.0)
        hand.types(" ")
        paused = hand.picture(f"view-{theme}-paused")
        time.sleep(1.0)
        assert differing(paused, hand.picture(f"view-{theme}-paused")) == 0.0
        hand.types(".")
        assert 0.0 < differing(paused, hand.picture(f"view-{theme}-step")) < 0.05
        hand.types("h")
        keys = hand.picture(f"view-{theme}-keys")
        assert differing(paused, keys) > 0.01
        hand.types("h")
        hand.points(330, 260)
        hand.does("click", 3)
        patch = hand.picture(f"view-{theme}-patch")
        assert 0.001 < differing(paused, patch) < 0.1
        hand.points(590, 380)
        for _ in range(3):
            hand.does("click", 4, wait_s=0.1)
        zoomed = hand.picture(f"view-{theme}-zoomed")
        assert differing(patch, zoomed) > 0.01
        hand.does("mousedown", 1, wait_s=0.1)
        hand.points(690, 480)
        hand.does("mouseup", 1)
        assert differing(zoomed, hand.picture(f"view-{theme}-moved")) > 0.01
        hand.types("0ff++++")
        followed = hand.picture(f"view-{theme}-followed")
        hand.does("keydown", "shift", wait_s=0.1)
        hand.points(SIZE_PX[0] / 2, 40 + (SIZE_PX[1] - 88) / 2)  # robot_1 is in the middle
        hand.does("mousedown", 1, wait_s=0.1)
        hand.points(SIZE_PX[0] / 2 + 150, 330)
        pushing = hand.picture(f"view-{theme}-pushing")
        assert 0.0005 < differing(followed, pushing) < 0.1
        hand.does("mouseup", 1)
        hand.does("keyup", "shift")
        hand.types(" ")
        hand.points(SIZE_PX[0] - 120, SIZE_PX[1] - 24)
        hand.does("click", 1)
        time.sleep(2.0)
        hand.picture(f"view-{theme}-changed")
        hand.types("0p")
        hand.picture(f"view-{theme}-policies")
        for _ in range(2):
            hand.does("key", "Up", wait_s=0.1)
        hand.does("key", "Escape")
        hand.types("t")
        hand.picture(f"view-{theme}-disturbances")
        hand.does("key", "Down", wait_s=0.1)
        hand.does("key", "Return", wait_s=2.0)
        hand.types("n]", wait_s=2.0)
        hand.picture(f"view-{theme}-next-seed")

    return check


def check_play(hand: Hand) -> None:
    """Drive forward, and round a turn."""
    hand.picture("play-start")
    hand.does("keydown", "Up", wait_s=4.0)
    hand.does("keydown", "a", wait_s=4.0)
    hand.picture("play-turning")
    hand.does("keyup", "a", wait_s=2.0)
    hand.does("keyup", "Up", wait_s=5.0)
    hand.picture("play-stopped")


def main() -> None:
    """Run all checks; an assertion or an exception if one fails."""
    missing = [name for name in ("Xvfb", "xdotool") if shutil.which(name) is None]
    if missing:
        sys.exit(f"check-live needs {' and '.join(missing)} (apt install xvfb xdotool)")
    folder = PICTURES / "running"
    shutil.rmtree(PICTURES, ignore_errors=True)
    folder.mkdir(parents=True)
    for theme in THEMES:
        words = ["view", "infinity", "--disturbance", "slip", "--theme", theme]
        run(words, folder / theme, check_view(theme))
        print(f"tlf view --theme {theme}: every control changed the picture", flush=True)
    printed = run(["play", "warehouse", "--robots", "3"], folder / "play", check_play)
    path = folder / "play" / "drive.csv"
    assert "tlf run drive.csv" in printed, printed
    driven = load_scenario(path)
    assert driven.horizon_s > 8.0, driven.horizon_s
    print(f"tlf play: a path of {driven.horizon_s:g} s that tlf run accepts")
    print(f"Pictures: {PICTURES}")


if __name__ == "__main__":
    main()
