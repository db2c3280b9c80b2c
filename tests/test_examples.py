"""Every example runs, says how to start it, and prints what it promises."""

from __future__ import annotations

import importlib
import inspect
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from helpers import PAPERS

import tlf_env
from baselines import ReferencePolicy, load_policy
from tlf_env import EndReason
from tlf_env.envs.single import FormationEnv

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"
SCRIPTS = sorted(path.stem for path in EXAMPLES.glob("*.py"))
FILES = sorted(path.stem for path in EXAMPLES.glob("*.yaml"))
NEEDS = {
    "learn_to_follow": "stable_baselines3",
    "linear_design": "control",
    "train_ppo": "stable_baselines3",
}

every_script = pytest.mark.parametrize("name", SCRIPTS)


@pytest.fixture
def example(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The script ``name``, imported as from its own folder."""
    pytest.importorskip(NEEDS.get(name, "tlf_env"))
    monkeypatch.syspath_prepend(EXAMPLES)
    return importlib.import_module(name)


def test_there_is_something_to_run() -> None:
    assert len(SCRIPTS) == 15
    assert FILES == ["mixed_formation", "own_robot"]


@every_script
def test_every_script_says_what_it_shows_and_how_to_start_it(
    example: ModuleType, name: str
) -> None:
    said = inspect.getdoc(example) or ""
    assert f"    python examples/{name}.py" in said
    assert inspect.getdoc(example.main)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("quickstart_parallel", ("ended by HORIZON", "robot_2", "mm off its reference")),
        ("quickstart_gymnasium", ("reference", "random residual", "ended by")),
        ("custom_estimator", ("ekf", "ComplementaryFilter", "mm RMS")),
        ("custom_wheel_loop", ("AVC", "PI", "mm RMS")),
        ("custom_observer", ("paper", "delay line", "mm RMS")),
        ("custom_policy", ("infinity, ReferencePolicy", "flower, PurePursuit", "mm RMS")),
    ],
)
def test_a_short_run_prints_its_result(
    example: ModuleType, words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    example.main(horizon_s=6.0)
    said = capsys.readouterr().out
    assert all(word in said for word in words)
    assert len(said.splitlines()) <= 6


@pytest.mark.parametrize("name", ["ukf_estimator"])
def test_filters_are_compared_in_a_table(
    example: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    example.main(disturbance="slip-ramps", horizon_s=0.3)
    title, _, *rows = capsys.readouterr().out.splitlines()
    assert title == "slip-ramps, from 0.1 to 0.3 s, RMS of the worst robot"
    assert [row.split()[3] for row in rows] == ["ekf", "ekf-slip", "SlipUkf"] * 4
    assert all(row.split()[-1] == "0" for row in rows)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("push_a_box", ("pushed 6", "by hand 0.441 N", "let go at 198 mm/s")),
        ("trailer_on_a_rope", ("taut after 0.7", "pulls with 0.196 N", "= 0.196 N")),
        ("user_force", ("motors at their limit", "by hand 0.40", "coasts on by")),
        ("person_crossing", ("blind  : touched an obstacle", "looking: touched nothing")),
        ("warehouse", ("robot_2", "nothing", "a pallet in the way of robot_0 was pushed")),
    ],
)
def test_a_world_is_run_and_its_result_printed(
    example: ModuleType, words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    example.main()
    said = capsys.readouterr().out
    assert all(word in said for word in words), said
    assert len(said.splitlines()) <= 6


@pytest.mark.parametrize("name", ["linear_design"])
def test_the_design_prints_margins(
    example: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib").use("Agg")
    example.main(figure=tmp_path / "bode.png")
    said = capsys.readouterr().out.splitlines()
    for line, kappa in zip(said[:2], ("0.7705", "0.6167"), strict=True):
        assert f"{kappa} rad/s per N·mm" in line
        assert line.endswith("stable")
        assert not line.endswith("unstable")
    assert (tmp_path / "bode.png").stat().st_size > 10_000


@pytest.mark.parametrize("name", ["train_ppo"])
def test_training_runs_and_saves(
    example: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "follower.safetensors"
    example.main(robot_steps=400, formations=4, horizon_s=5.0, out=out)
    assert "reference" in capsys.readouterr().out
    assert load_policy(out).card.residual_base == "linearised"


@pytest.mark.parametrize("name", ["learn_to_follow"])
def test_learning_is_judged_before_and_after(
    example: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    example.main(steps=100, episodes=2, horizon_s=4.0)
    before, after = capsys.readouterr().out.splitlines()
    assert before.startswith("before: mean return")
    assert after.startswith("after: mean return")
    assert "held 2 of 2" in before


# What the parts of the examples are worth, on the whole task


@pytest.mark.parametrize(
    ("name", "role", "part"),
    [
        ("custom_estimator", "estimator", "ComplementaryFilter"),
        ("ukf_estimator", "estimator", "SlipUkf"),
        ("custom_wheel_loop", "wheel_loop", "PiLoop"),
        ("custom_observer", "observer", "DelayLine"),
    ],
)
@pytest.mark.slow
def test_the_parts_hold_the_infinity(example: ModuleType, role: str, part: str) -> None:
    env = tlf_env.parallel_env("infinity", **PAPERS | {role: getattr(example, part)})
    seen, _ = env.reset(seed=0)
    policy, errors = ReferencePolicy("consistent"), []
    while env.agents:
        actions = {agent: policy.predict(row)[0] for agent, row in seen.items()}
        seen, *_, infos = env.step(actions)
        errors.append([info["position_error_mm"] for info in infos.values()])
    assert infos["robot_0"]["end"] == EndReason.HORIZON
    settled = np.array(errors)[len(errors) * 2 // 5 :]
    assert np.sqrt((settled**2).mean(axis=0)).max() < 10.0


@pytest.mark.parametrize("name", ["custom_policy"])
def test_a_policy_of_ones_own_drives_the_others(example: ModuleType) -> None:
    pursuit = example.PurePursuit()
    env = FormationEnv(learner="robot_1", others=pursuit)
    seen, _ = env.reset(seed=0)
    for _ in range(200):
        seen, _, terminated, truncated, _ = env.step(pursuit.predict(seen)[0])
    assert not terminated
    assert not truncated
    batch = np.stack([seen, seen])
    assert np.array_equal(pursuit.predict(batch)[0][1], pursuit.predict(seen)[0])
    assert env.action_space.contains(pursuit.predict(seen)[0])


@pytest.mark.parametrize("name", ["custom_observer"])
def test_a_delay_line_moves_the_reference_as_its_twist_says(example: ModuleType) -> None:
    from tlf_env.onboard.observer import Message
    from tlf_env.physics.parameters import RobotParameters

    line = example.DelayLine(RobotParameters(), 0.01)
    line.reset(np.array([0.0, 0.0, 0.2]))
    at_rest = Message(100.0, 300.0, 0.0, 0.0, 0.0)
    references = np.array([line.update(at_rest, 0.01 * k) for k in range(701)])
    moved = np.diff(references[:, :3], axis=0) / 0.01
    twist = 0.5 * (references[1:, 3:] + references[:-1, 3:])
    np.testing.assert_allclose(np.hypot(*moved[:, :2].T), twist[:, 0], atol=0.01)
    np.testing.assert_allclose(moved[:, 2], twist[:, 1], atol=1e-4)
    np.testing.assert_allclose(references[-1], [*at_rest], atol=1e-9)


# The examples of worlds against calculations by hand


@pytest.mark.parametrize(
    ("name", "mass_kg", "friction"), [("push_a_box", 1.5, 0.03), ("push_a_box", 2.0, 0.02)]
)
def test_a_box_costs_its_friction_and_slides_as_far_as_it_allows(
    example: ModuleType, mass_kg: float, friction: float
) -> None:
    box = example.BOX | {"mass_kg": mass_kg, "floor_friction": friction}
    found, without = example.drive([box]), example.drive([])
    grip = friction * 9807.0
    assert found.motors_N - without.motors_N == pytest.approx(mass_kg * grip / 1000.0, rel=0.01)
    assert found.let_go_mm_s == pytest.approx(example.SPEED_MM_S, rel=0.02)
    # Each substep of 1 ms takes 1 ms · µ·g of the speed.
    assert found.slid_mm == pytest.approx(found.let_go_mm_s**2 / (2 * grip), rel=0.01)
    assert abs(found.turned_rad) < 1e-3


@pytest.mark.parametrize("name", ["push_a_box"])
def test_a_box_pushed_beside_its_centre_turns(example: ModuleType) -> None:
    turned = [example.drive([example.BOX | {"x_mm": x}]).turned_rad for x in (-60.0, 60.0)]
    assert turned[0] > 0.005  # the left robot pushes beside the centre, the right one outside of it
    assert turned[1] == pytest.approx(-turned[0], rel=1e-3)


@pytest.mark.parametrize("name", ["user_force"])
@pytest.mark.parametrize("stiffness_N_m", [1.5, 4.0])
def test_a_stiffer_spring_stops_a_robot_earlier_with_the_same_force(
    example: ModuleType, stiffness_N_m: float
) -> None:
    at_limit, end = example.pull(example.SpringBalance(stiffness_N_m))
    assert -at_limit.force_N == pytest.approx(0.404, rel=0.03)
    coast_mm = at_limit.speed_mm_s * np.sqrt(1.29 / stiffness_N_m)
    assert end.y_mm - at_limit.y_mm == pytest.approx(coast_mm, rel=0.08)
    assert end.speed_mm_s == pytest.approx(0.0, abs=1e-6)
    assert -end.force_N == pytest.approx(stiffness_N_m * end.y_mm / 1000.0, abs=1e-6)


@pytest.mark.parametrize("name", ["person_crossing"])
@pytest.mark.parametrize("start_s", [0.5, 1.5, 3.0, 6.0])
def test_a_robot_that_looks_is_not_touched(example: ModuleType, start_s: float) -> None:
    time_s, touched, _ = example.drive(start_s, looking=True)
    assert touched == tlf_env.TouchedBy.NOTHING
    assert time_s == pytest.approx(example.HORIZON_S)


@pytest.mark.parametrize("name", ["quickstart_parallel", "custom_estimator"])
@pytest.mark.slow
def test_a_script_runs_from_the_shell(name: str) -> None:
    done = subprocess.run(
        [sys.executable, EXAMPLES / f"{name}.py", "--horizon-s", "6"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "robot_0" in done.stdout or "mm RMS" in done.stdout
