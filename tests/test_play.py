"""``tlf play``: a leader that is driven by hand, and the path that is kept."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from baselines import cli
from baselines.commands.path import write_path
from baselines.live.drive import LATERAL_MM_S2, SPEED_MM_S, DrivenReference, DriveSession, Hand
from baselines.live.play import PlayWindow
from baselines.paths.read import read_log
from baselines.policies.registry import fit_policy
from baselines.runs.run import run_policy
from tests.live_helpers import does, key, pygame, released, short
from tlf_env.task.scenario import load_scenario

DT_S = 0.02


@pytest.fixture(autouse=True)
def no_display(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr("baselines.live.window.MOST_BUSY_S", 60.0)
    pygame.display.quit()
    yield
    pygame.display.quit()


def drive_for(session: DriveSession, seconds: float, *hand: float) -> None:
    session.drive.hand = Hand(*hand)
    for _ in range(round(seconds / DT_S)):
        session.step()


def driven(**options: Any) -> DriveSession:
    """A drive with turns both ways, a stop and a new start."""
    session = DriveSession(short(disturbance="nominal"), "reference:linearised", **options)
    drive_for(session, 1.0)
    drive_for(session, 4.0, 1.0, 0.0)
    drive_for(session, 4.0, 1.0, 1.0)
    drive_for(session, 4.0, -1.0, 0.0)
    drive_for(session, 4.0, 1.0, -1.0)
    drive_for(session, 1.0, 1.0, 0.0)
    return session


@pytest.mark.parametrize("seed", range(5))
def test_the_reference_moves_like_a_robot_can(seed: int) -> None:
    random, drive = np.random.default_rng(seed), DrivenReference(100.0, -200.0, 0.7)
    rows = [drive.reference()]
    for k in range(3000):
        if k % 40 == 0:
            drive.hand = Hand(*random.uniform(-1.0, 1.0, 2).tolist())
        drive.advance(DT_S)
        rows.append(drive.reference())
    x, y, theta, speed, yaw_rate = np.array(rows).T
    assert (speed >= 0.0).all()
    assert speed.max() <= SPEED_MM_S
    assert np.abs(np.diff(speed)).max() <= 200.0 * DT_S + 1e-9
    assert np.abs(speed * yaw_rate).max() <= LATERAL_MM_S2 + 1e-9
    assert (yaw_rate[speed == 0.0] == 0.0).all()
    way = np.hypot(np.diff(x), np.diff(y))
    assert way == pytest.approx(0.5 * DT_S * (speed[1:] + speed[:-1]), abs=1e-9)
    assert np.diff(theta) == pytest.approx(DT_S * yaw_rate[1:], abs=1e-12)


def test_directions_are_those_of_the_keys() -> None:
    drive = DrivenReference(0.0, 0.0, 0.0)  # heading along +y
    drive.hand = Hand(1.0, 0.0)
    for _ in range(100):
        drive.advance(DT_S)
    assert drive.y > 100.0
    assert drive.x == 0.0
    drive.hand = Hand(1.0, 1.0)
    for _ in range(100):
        drive.advance(DT_S)
    assert drive.x < -1.0  # to the left
    drive.hand = Hand(-1.0, 0.0)
    for _ in range(200):
        drive.advance(DT_S)
    place = drive.x, drive.y
    drive.advance(DT_S)
    assert (drive.x, drive.y) == place
    assert drive.speed == 0.0


def test_the_leader_follows_and_the_others_keep_the_gap() -> None:
    session = DriveSession(short(disturbance="nominal"), "reference:linearised")
    drive_for(session, 5.0, 1.0, 0.0)
    drive_for(session, 5.0, 1.0, 0.5)
    for _ in range(5):
        drive_for(session, 3.0, 1.0, 0.5)
        info = session.formation.info()
        assert info.position_error_mm.max() < 15.0
    assert not session.formation.arrays.lost.any()
    gap = session.formation.scenario.gap_steps
    leader = session.formation.true_positions(session.formation.step_count - gap)[:, 0]
    follower = session.formation.info()
    assert np.hypot(follower.x_mm[1] - leader[0], follower.y_mm[1] - leader[1]) < 15.0


def test_a_drive_without_motion_has_no_path() -> None:
    session = DriveSession(short(), "reference:linearised")
    drive_for(session, 1.0)
    times, points = session.path()
    assert (times.shape, points.shape) == ((0,), (0, 2))


def test_the_path_is_accepted_and_driven_again(tmp_path: Path) -> None:
    session = driven()
    times, points = session.path()
    assert times[0] == 0.0
    assert np.diff(times) == pytest.approx(0.1)
    assert 16.0 < times[-1] < 18.0
    path = tmp_path / "drive.csv"
    write_path(path, times, points)
    log = read_log(path)
    assert log.xy_mm == pytest.approx(points, abs=1e-5)
    scenario = load_scenario(path)
    fitted = fit_policy("reference", scenario)
    record = run_policy(fitted.scenario, fitted.policy, 0)
    assert record["position_error_mm"][:, 0].max() < 100.0
    assert np.sqrt(np.mean(record["position_error_mm"][:, 0] ** 2)) < 20.0
    there = np.stack([np.interp(record.t_s, times, values) for values in points.T], axis=-1)
    assert np.abs(record.leader - there).max() < 3.0
    assert not np.isfinite(record.lost_at_s).any()


def test_a_restart_begins_a_new_path() -> None:
    session = driven()
    session.restart()
    assert not len(session.path()[0])
    assert session.drive.speed == 0.0
    session.use_disturbance("ice")
    drive_for(session, 2.0, 1.0, 0.0)
    assert len(session.path()[0]) == pytest.approx(20, abs=1)


def opened(**options: Any) -> PlayWindow:
    session = DriveSession(short(), "reference:linearised", 1, **options)
    window = PlayWindow(session, size_px=(900, 700))
    does(window)
    return window


ARROWS = (pygame.K_UP, pygame.K_DOWN, pygame.K_LEFT, pygame.K_RIGHT)
LETTERS = (pygame.K_w, pygame.K_s, pygame.K_a, pygame.K_d)


@pytest.mark.parametrize("keys", [ARROWS, LETTERS], ids=["arrows", "letters"])
def test_keys_drive_while_they_are_held(keys: tuple[int, ...]) -> None:
    forward, brake, left, right = keys
    window = opened()
    does(window, key(code=forward))
    assert window.hand() == Hand(1.0, 0.0)
    does(window, key(code=left))
    assert window.hand() == Hand(1.0, 1.0)
    does(window, key(code=right))
    assert window.hand() == Hand(1.0, 0.0)
    does(window, released(left), released(forward), key(code=brake))
    assert window.hand() == Hand(-1.0, -1.0)
    does(window, released(right), released(brake))
    assert window.hand() == Hand(0.0, 0.0)


def test_a_stick_drives() -> None:
    def axis(number: int, value: float) -> Any:
        return pygame.event.Event(pygame.JOYAXISMOTION, axis=number, value=value, instance_id=0)

    window = opened()
    does(window, axis(1, -0.6), axis(0, 0.4))
    assert window.hand() == pytest.approx(Hand(0.6, -0.4))
    does(window, axis(1, 0.05), axis(0, -0.1))
    assert window.hand() == Hand(0.0, 0.0)  # a stick at rest
    does(window, axis(3, 1.0))
    assert window.hand() == Hand(0.0, 0.0)


def test_the_window_drives_the_leader() -> None:
    window = opened()
    does(window, key(code=pygame.K_UP))
    for _ in range(20):
        does(window, elapsed_s=0.1)
    session = window.session
    assert session.drive.speed > 200.0
    assert session.formation.named("motion").omega_l[0] > 5.0
    assert "mm/s" in window.state()
    assert session.level == 1.0  # the key is not that of the level
    does(window, key(" "), elapsed_s=0.1)
    assert window.controls.paused
    does(window, key(code=pygame.K_UP), elapsed_s=0.1)
    assert not window.controls.paused


def test_the_view_follows_a_leader_that_leaves_it() -> None:
    window = opened()
    window.renderer.camera.zoom = 6.0
    does(window, key(code=pygame.K_UP))
    for _ in range(60):
        does(window, elapsed_s=0.1)
    assert window.renderer.camera.follow == 0


def test_the_command_writes_the_path(tmp_path: Path, capsys: Any, monkeypatch: Any) -> None:
    def forwards(window: PlayWindow) -> None:
        does(window, key(code=pygame.K_w))
        for _ in range(30):
            does(window, elapsed_s=0.1)

    monkeypatch.setattr(PlayWindow, "run", forwards)
    path = tmp_path / "made" / "drive.csv"
    cli.app(["play", "infinity", "--out", str(path)], standalone_mode=False)
    said = capsys.readouterr().out.replace("\n", "")
    assert f"tlf run {path}" in said
    assert load_scenario(path).horizon_s > 2.0
    monkeypatch.setattr(PlayWindow, "run", lambda window: None)
    other = tmp_path / "other.csv"
    cli.app(["play", "infinity", "--out", str(other)], standalone_mode=False)
    assert "no path is written" in capsys.readouterr().err
    assert not other.exists()
    with pytest.raises(ValueError, match=r"must end in \.csv"):
        cli.app(["play", "infinity", "--out", str(tmp_path / "drive")], standalone_mode=False)
