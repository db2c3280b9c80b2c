"""Estimators, wheel loops and observers of one's own, plugged in beside the built-in ones."""

from __future__ import annotations

import inspect
import math
import pickle
import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
import yaml
from helpers import PAPERS

import tlf_env
from baselines import ReferencePolicy
from tlf_env.envs.parallel import FormationParallelEnv
from tlf_env.onboard.estimator import EkfParameters
from tlf_env.onboard.memory import caller_state, give_caller_state
from tlf_env.onboard.observer import Message, ObserverParameters, Reference
from tlf_env.onboard.parts import (
    Estimated,
    Readings,
    checked_covariance,
    load_part,
    make_part,
)
from tlf_env.onboard.wheel_loop import WheelLoopParameters
from tlf_env.physics.parameters import RobotParameters

HERE = __name__  # of this module, for "module:factory"


# The paper's parts once more, written down plainly from its equations.


class PaperEkf:
    """Eqs (28)–(41) with matrices."""

    def __init__(self, robot: RobotParameters, period_s: float) -> None:
        self.robot, self.period_s, self.p = robot, period_s, EkfParameters()

    def reset(self, pose: np.ndarray) -> None:
        self.q, self.P, self.way = pose.copy(), np.zeros((3, 3)), [np.zeros(2)]

    def update(self, readings: Readings) -> Any:
        s_l, s_r = self.robot.wheel_radius_mm * readings.steps_rad
        u_1, u_2 = (s_r + s_l) / 2, (s_r - s_l) / self.robot.axle_width_mm
        middle = self.q[2] + u_2 / 2
        sin, cos = math.sin(middle), math.cos(middle)
        q = self.q + np.array([-u_1 * sin, u_1 * cos, u_2])
        F = np.array([[1, 0, -u_1 * cos], [0, 1, -u_1 * sin], [0, 0, 1]])
        G = np.array([[-sin, -u_1 * cos / 2], [cos, -u_1 * sin / 2], [0, 1]])
        sd = np.array([[self.p.alpha_1, self.p.alpha_2], [self.p.alpha_3, self.p.alpha_4]])
        Q = np.diag((sd @ np.abs([u_1, u_2])) ** 2)
        P = F @ self.P @ F.T + G @ Q @ G.T
        self.way.append(self.way[-1] + q[:2] - self.q[:2])
        if readings.fix_mm is not None:
            age = round((readings.t_s - readings.fix_t_s) / self.period_s)
            fix = readings.fix_mm + self.way[-1] - self.way[-1 - age]
            H = np.eye(2, 3)
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + self.p.fix_variance_mm2 * np.eye(2))
            q, P = q + K @ (fix - H @ q), (np.eye(3) - K @ H) @ P
        self.q, self.P = q, P
        return self.result()

    def result(self) -> Any:
        return self.q


class WholeEkf(PaperEkf):
    """With its covariance, and the twist of the odometry by default."""

    def result(self) -> Estimated:
        return Estimated(self.q, covariance=self.P)


class PaperWheelLoop:
    """Eq. (13) as k + kᵢ/s + kₚ/(s + p), each wheel with its own states, in N·mm."""

    def __init__(self, robot: RobotParameters, period_s: float) -> None:
        p = WheelLoopParameters()
        self.k, self.limit = p.gain_Nmm_s, robot.torque_limit_Nmm
        k_i = p.gain_Nmm_s * p.zeros_0 / p.pole_rad_s
        k_p = (
            -p.gain_Nmm_s * (p.pole_rad_s**2 - p.zeros_1 * p.pole_rad_s + p.zeros_0) / p.pole_rad_s
        )
        self.decay = np.array([1.0, math.exp(-p.pole_rad_s * period_s)])
        self.gain = np.array([k_i * period_s, k_p * (1 - self.decay[1]) / p.pole_rad_s])

    def reset(self) -> None:
        self.held = np.zeros((2, 2))  # (wheel, integrator and lag)

    def torque(self, wanted_rad_s: np.ndarray, measured_rad_s: np.ndarray) -> np.ndarray:
        error = wanted_rad_s - measured_rad_s
        after = self.decay * self.held + self.gain * error[:, None]
        asked = self.k * error + after.sum(axis=1)
        given = np.clip(asked, -self.limit, self.limit)
        winds_up = (given != asked) & (error * asked > 0)
        self.held = np.where(winds_up[:, None], self.held, after)
        return given


class PaperObserver:
    """Eqs (43), (50), (51) by Euler."""

    def __init__(self, robot: RobotParameters, period_s: float) -> None:
        self.period_s, self.p = period_s, ObserverParameters()

    def reset(self, pose: np.ndarray) -> None:
        self.q = pose.copy()

    def update(self, message: Message, t_s: float) -> Reference:
        theta, b = self.q[2], self.p.gain_per_s
        turn = math.remainder(message.theta - theta, 2 * math.pi)
        rates = np.array(
            [
                -message.u_1 * math.sin(theta) + b * (message.x - self.q[0]),
                message.u_1 * math.cos(theta) + b * (message.y - self.q[1]),
                message.u_2 + b * turn,
            ]
        )
        rates *= 0.5 * (1 - math.cos(math.pi * min(t_s / self.p.smoothing_s, 1.0)))
        reference = Reference(*self.q, math.hypot(*rates[:2]), rates[2])
        self.q = self.q + self.period_s * rates
        return reference


class Still:
    """A part for any role that does nothing."""

    made: ClassVar[list[tuple[float, float]]] = []

    def __init__(self, robot: RobotParameters, period_s: float) -> None:
        self.made.append((robot.mass_kg, period_s))
        self.pose = np.zeros(3)

    def reset(self, pose: np.ndarray | None = None) -> None:
        self.pose = np.zeros(3) if pose is None else pose

    def update(self, *_: Any) -> Any:
        return self.pose

    def torque(self, *_: Any) -> Any:
        return np.zeros(2)


class StillObserver(Still):
    def update(self, *_: Any) -> Any:
        return (*self.pose, 0.0, 0.0)


PAPERS_PARTS: dict[str, Callable[..., Any]] = {
    "estimator": PaperEkf,
    "wheel_loop": PaperWheelLoop,
    "observer": PaperObserver,
}


def drive(env: FormationParallelEnv, seconds: float, seed: int = 0) -> np.ndarray:
    """True (x, y) of every robot after every control step."""
    seen, _ = env.reset(seed=seed)
    return go_on(env, seen, seconds)


def go_on(env: FormationParallelEnv, seen: dict[str, np.ndarray], seconds: float) -> np.ndarray:
    policy, places = ReferencePolicy(), []
    for _ in range(round(seconds / env.scenario.control_period_s)):
        actions = {agent: policy.predict(row)[0] for agent, row in seen.items()}
        seen, *_ = env.step(actions)
        places.append(env.formation.state()[:, :2])
    return np.array(places)


# The same as the built-in ones


# With noise the ∞ starts in a skid that turns a last bit into 0.03 mm within 3 s, with any estimator.
@pytest.mark.parametrize(("task", "disturbance"), [("infinity", "none"), ("flower", "nominal")])
@pytest.mark.parametrize("role", [*PAPERS_PARTS, "all"])
def test_the_papers_parts_in_python_are_the_built_in_ones(
    task: str, disturbance: str, role: str
) -> None:
    parts = PAPERS_PARTS if role == "all" else {role: PAPERS_PARTS[role]}
    # In float64: a float32 observation would round 1e-12 mm up to 1e-5 mm.
    built_in, plain = (
        tlf_env.parallel_env(task, disturbance=disturbance, end_on=(), dtype="float64", **given)
        for given in (PAPERS, PAPERS | parts)
    )
    a, b = (drive(env, seconds=5.0) for env in (built_in, plain))
    assert np.abs(a - a[0]).max() > 30.0  # mm: they drive
    assert np.abs(a - b).max() < 1e-9


@pytest.mark.parametrize("period_s", [0.001, 0.02, 0.05])
def test_an_observer_looks_ahead_as_far_as_the_preview(period_s: float) -> None:
    options: dict[str, Any] = {
        "control_period_s": period_s,
        "time_gap_s": 0.5,
        "preview_s": (0.1, 0.5),
        "dtype": "float64",
        "end_on": (),
    }
    built_in = tlf_env.parallel_env("infinity", **options)
    plain = tlf_env.parallel_env("infinity", observer=PaperObserver, **options)
    assert np.abs(drive(built_in, 1.0) - drive(plain, 1.0)).max() < 1e-9
    a, b = (env.formation.arrays.observations for env in (built_in, plain))
    np.testing.assert_allclose(a, b, atol=1e-9)


# How they are given


@pytest.mark.parametrize("role", PAPERS_PARTS)
def test_a_class_and_its_name_agree_bitwise(role: str) -> None:
    part = PAPERS_PARTS[role]
    by_class = tlf_env.parallel_env("infinity", **{role: part})
    by_name = tlf_env.parallel_env("infinity", trust=True, **{role: f"{HERE}:{part.__name__}"})
    assert by_class.scenario == by_name.scenario
    np.testing.assert_array_equal(drive(by_class, 0.5), drive(by_name, 0.5))


def test_a_factory_may_be_any_callable() -> None:
    def tuned(robot: RobotParameters, period_s: float) -> PaperEkf:
        return PaperEkf(robot, period_s)

    runs = [
        drive(tlf_env.parallel_env("infinity", estimator=factory), 0.2)
        for factory in (PaperEkf, tuned, lambda robot, period_s: PaperEkf(robot, period_s))
    ]
    np.testing.assert_array_equal(runs[0], runs[1])
    np.testing.assert_array_equal(runs[0], runs[2])


def test_modules_beside_the_working_directory_are_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my_parts_here.py").write_text(f"from {HERE} import PaperEkf as Mine\n")
    monkeypatch.chdir(tmp_path)
    env = tlf_env.parallel_env("infinity", estimator="my_parts_here:Mine", trust=True)
    expected = drive(tlf_env.parallel_env("infinity", estimator=PaperEkf), 0.1)
    np.testing.assert_array_equal(drive(env, 0.1), expected)


def test_a_scenario_file_names_parts(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(
        "trajectory: {type: lissajous, amplitude_x_mm: 2000, amplitude_y_mm: 2000, "
        "rate_x_rad_s: 0.125, rate_y_rad_s: 0.25, centre_x_mm: 2500, centre_y_mm: 2500}\n"
        f"wheel_loop: {HERE}:PaperWheelLoop\n"
    )
    env = tlf_env.parallel_env(path, trust=True)
    assert env.scenario.wheel_loop == f"{HERE}:PaperWheelLoop"
    assert np.isfinite(drive(env, 0.1)).all()


def test_gymnasium_takes_parts_too() -> None:
    env = gymnasium.make(
        "tlf_env/Infinity-v0", action="residual", estimator=f"{HERE}:PaperEkf", trust=True
    )
    env.reset(seed=0)
    for _ in range(10):
        *_, info = env.step(np.zeros(2, np.float32))
    reference = gymnasium.make("tlf_env/Infinity-v0", action="residual", estimator="ekf")
    reference.reset(seed=0)
    for _ in range(10):
        *_, expected = reference.step(np.zeros(2, np.float32))
    assert info["y_mm"] == pytest.approx(expected["y_mm"], abs=1e-3)


def test_a_pickled_episode_goes_on_with_its_parts() -> None:
    env = tlf_env.parallel_env("infinity", **PAPERS_PARTS)
    seen, _ = env.reset(seed=0)
    still = {agent: np.array([0.3, 0.1], np.float32) for agent in env.agents}
    for _ in range(10):
        seen, *_ = env.step(still)
    copy = pickle.loads(pickle.dumps(env))
    np.testing.assert_array_equal(go_on(copy, seen, 0.4), go_on(env, seen, 0.4))


# When they are made, and for whom


def test_parts_are_made_anew_for_every_robot_at_every_reset() -> None:
    Still.made.clear()
    env = tlf_env.parallel_env(
        "infinity",
        robots=[{"mass_kg": 1.0 + 0.1 * i} for i in range(3)],
        estimator=Still,
        wheel_loop=Still,
        observer=StillObserver,
    )
    assert Still.made == []
    robots = [1.0, 1.1, 1.2]
    for _ in range(2):
        Still.made.clear()
        env.reset(seed=0)
        periods = sorted({period for _, period in Still.made})
        assert periods == [0.001, 0.02]
        for period, roles in ((0.001, 2), (0.02, 1)):
            masses = [mass for mass, made_with in Still.made if made_with == period]
            assert sorted(masses) == pytest.approx(sorted(robots * roles))


@pytest.mark.parametrize("with_loop", [True, False])
def test_estimators_are_called_between_the_wheel_loops(with_loop: bool) -> None:
    calls: list[Any] = []

    class Noting(Still):
        def update(self, readings: Readings) -> Any:
            calls.append(readings.t_s)
            return self.pose

    class NotingLoop(Still):
        def torque(self, *_: Any) -> Any:
            calls.append("torque")
            return np.zeros(2)

    loop = {"wheel_loop": importable(NotingLoop)} if with_loop else {}
    env = tlf_env.parallel_env("infinity", estimator=importable(Noting), **loop)
    env.reset(seed=0)
    for step in range(2):
        calls.clear()
        env.step({agent: np.zeros(2, np.float32) for agent in env.agents})
        ticks = range(20 * step + 1, 20 * step + 21)
        before = ["torque"] * 3 * with_loop
        assert calls == [call for tick in ticks for call in (*before, *[tick * 0.001] * 3)]


def test_every_episode_starts_with_fresh_parts() -> None:
    env = tlf_env.parallel_env("infinity", **PAPERS_PARTS)
    first = drive(env, 0.4, seed=3)
    drive(env, 0.2, seed=8)
    np.testing.assert_array_equal(drive(env, 0.4, seed=3), first)


def test_a_loop_that_gives_nothing_leaves_the_robots_standing() -> None:
    env = tlf_env.parallel_env("infinity", wheel_loop=Still, end_on=())
    places = drive(env, 0.4)
    np.testing.assert_allclose(places, np.broadcast_to(places[0], places.shape), atol=1e-9)


def test_torque_actions_pass_a_loop_by() -> None:
    with_loop = tlf_env.parallel_env("infinity", wheel_loop=Still, action="torque")
    without = tlf_env.parallel_env("infinity", action="torque")
    for env in (with_loop, without):
        env.reset(seed=0)
        for _ in range(20):
            env.step({agent: np.array([0.9, 0.8], np.float32) for agent in env.agents})
    np.testing.assert_array_equal(with_loop.formation.state(), without.formation.state())


def test_the_motors_clip_what_a_loop_asks_for() -> None:
    class Greedy(Still):
        def torque(self, *_: Any) -> Any:
            return np.array([1e9, -1e9])

    env = tlf_env.parallel_env("infinity", wheel_loop=importable(Greedy))
    env.reset(seed=0)
    *_, infos = env.step({agent: np.zeros(2, np.float32) for agent in env.agents})
    for info in infos.values():
        assert (info["torque_l_Nmm"], info["torque_r_Nmm"]) == pytest.approx((15.0, -15.0))
        assert info["saturation_fraction"] == 1.0


# What goes wrong is named


def importable(part: type) -> type:
    """Make a class of a test look like one of its module."""
    part.__qualname__ = part.__name__
    globals()[part.__name__] = part
    return part


METHODS = {"estimator": "update", "wheel_loop": "torque", "observer": "update"}
IMPOSSIBLE = [
    np.full(3, np.nan),
    np.array([np.inf, 0.0]),
    np.zeros(7),
    np.zeros((5, 1)),
    None,
    1.0,
    "forward",
    {},
    [[1.0, 2.0], [3.0]],
]


@pytest.mark.parametrize("value", IMPOSSIBLE, ids=str)
@pytest.mark.parametrize(("role", "method"), METHODS.items())
def test_an_impossible_answer_is_named_with_robot_and_part(
    role: str, method: str, value: Any
) -> None:
    base = StillObserver if role == "observer" else Still
    bad = importable(type("Bad", (base,), {method: lambda *_: value}))
    env = tlf_env.parallel_env("infinity", **{role: bad})
    what = rf"robot_[01]: the {role.replace('_', ' ')}'s {method}\(\) must return"
    with pytest.raises(ValueError, match=what):
        drive(env, 0.1)


@pytest.mark.parametrize("role", METHODS)
@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("no_such_module:Part", "cannot import 'no_such_module' of 'no_such_module:Part'"),
        (f"{HERE}:NoSuchPart", f"module '{HERE}' has no 'NoSuchPart'"),
        (f"{HERE}:HERE", f"'{HERE}:HERE' is not callable"),
    ],
)
def test_a_part_that_is_not_there_is_named(role: str, path: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        tlf_env.parallel_env("infinity", trust=True, **{role: path})


BROKEN = {
    "syntax_here": ("def broken(:\n", "SyntaxError"),
    "raises_here": ("raise RuntimeError('not\\ntoday')\n", "RuntimeError: not today"),
    "attribute_here": ("import math\nmath.no_such\n", "AttributeError: .*no_such"),
    "leaves_here": ("import sys\nsys.exit(0)\n", "SystemExit: 0"),
}


@pytest.mark.parametrize(("module", "text", "message"), [(k, *v) for k, v in BROKEN.items()])
def test_a_module_that_cannot_be_imported_is_told_in_one_line(
    module: str, text: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / f"{module}.py").write_text(text)
    monkeypatch.chdir(tmp_path)
    line = rf"^cannot import '{module}' of '{module}:Part': {message}[^\n]*$"
    with pytest.raises(ValueError, match=line):
        tlf_env.parallel_env("infinity", estimator=f"{module}:Part", trust=True)
    assert str(tmp_path) not in sys.path


class NoReset:
    def __init__(self, robot: RobotParameters, period_s: float) -> None:
        pass

    def update(self, *_: Any) -> Any:
        return np.zeros(3)

    torque = update


class OtherReset(Still):
    def reset(self, pose: Any, speed: Any) -> None:
        pass


class Keyworded(Still):
    def __init__(self, robot: RobotParameters, period_s: float, *, gain: float) -> None:
        super().__init__(robot, period_s)


def given_a_class(robot: RobotParameters, period_s: float) -> type:
    return Still


WANTED = {
    "estimator": r"reset\(pose\) and update\(readings\)",
    "wheel_loop": r"reset\(\) and torque\(wanted_rad_s, measured_rad_s\)",
    "observer": r"reset\(pose\) and update\(message, t_s\)",
}


@pytest.mark.parametrize("role", METHODS)
@pytest.mark.parametrize("path", ["os:getcwd", "builtins:dict", f"{HERE}:Keyworded", "json:loads"])
def test_a_factory_that_does_not_take_robot_and_period_is_named(role: str, path: str) -> None:
    env = tlf_env.parallel_env("infinity", trust=True, **{role: path})
    wanted = rf"^{role} '{path}' cannot be made by factory\(robot, period_s\): [^\n]+$"
    with pytest.raises(ValueError, match=wanted):
        env.reset(seed=0)


@pytest.mark.parametrize("role", METHODS)
@pytest.mark.parametrize("part", ["NoReset", "given_a_class"])
def test_a_part_without_a_method_is_named_with_what_it_needs(role: str, part: str) -> None:
    env = tlf_env.parallel_env("infinity", trust=True, **{role: f"{HERE}:{part}"})
    with pytest.raises(ValueError, match=rf"^{role} '{HERE}:{part}' .*{WANTED[role]}$"):
        env.reset(seed=0)


@pytest.mark.parametrize("role", METHODS)
def test_a_method_that_takes_something_else_is_named(role: str) -> None:
    env = tlf_env.parallel_env("infinity", **{role: OtherReset})
    with pytest.raises(ValueError, match=rf"^{role} .*OtherReset': reset\(.*cannot be called as"):
        env.reset(seed=0)


def test_an_error_inside_a_part_keeps_its_kind() -> None:
    class Raises(Still):
        def update(self, *_: Any) -> Any:
            raise KeyError("mine")

    env = tlf_env.parallel_env("infinity", estimator=importable(Raises))
    with pytest.raises(KeyError, match="mine"):
        drive(env, 0.1)


def test_the_kinematic_plant_has_no_wheel_loop() -> None:
    with pytest.raises(ValueError, match="'kinematic' has no torques"):
        tlf_env.parallel_env("infinity", plant="kinematic", wheel_loop=Still)
    env = tlf_env.parallel_env("infinity", plant="kinematic", estimator=PaperEkf)
    assert np.isfinite(drive(env, 0.1)).all()


# The page that explains all this


def test_what_the_page_shows_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    root = Path(__file__).resolve().parent.parent
    page = (root / "docs" / "parts.md").read_text(encoding="utf-8")
    monkeypatch.syspath_prepend(root / "examples")
    shown = ModuleType("my_policies")
    vars(shown).update(np=np, gymnasium=gymnasium)
    monkeypatch.setitem(sys.modules, shown.__name__, shown)
    for code in re.findall(r"^```python\n(.*?)^```", page, re.DOTALL | re.MULTILINE):
        exec(code, vars(shown))
    for role, name in (
        ("estimator", "Odometry"),
        ("estimator", "GyroOdometry"),
        ("wheel_loop", "Proportional"),
        ("observer", "Follow"),
    ):
        env = tlf_env.parallel_env("infinity", trust=True, **{role: f"my_policies:{name}"})
        assert np.isfinite(drive(env, 0.2)).all()
    for robots in re.findall(r"^```yaml\n(.*?)^```", page, re.DOTALL | re.MULTILINE):
        env = tlf_env.parallel_env("infinity", **yaml.safe_load(robots))
        assert [robot.mass_kg for robot in env.scenario.robot_models] == [1.6] * 3
        assert np.isfinite(drive(env, 0.2)).all()


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_a_covariance_is_symmetric_but_for_rounding_at_any_scale(scale):
    """A millionth of the product of both standard deviations is rounding."""
    covariance = scale * np.array([[4.0, 1.0, 0.2], [1.0, 9.0, 0.3], [0.2, 0.3, 1.0]])
    for share, fits in ((0.9e-6, True), (1.1e-6, False)):
        other = covariance.copy()
        other[0, 1] += share * scale * 2.0 * 3.0
        if fits:
            assert checked_covariance(other, "the estimator") is not None
        else:
            with pytest.raises(ValueError, match="a symmetric covariance"):
                checked_covariance(other, "the estimator")


def test_a_method_is_checked_after_one_without_a_signature():
    class Odd:
        def __init__(self, robot, period_s):
            self.reset = {}.update  # of a built-in type: nothing says what it takes

        def update(self):
            """Takes no readings."""

    with pytest.raises(ValueError, match=r"signature|no signature"):
        inspect.signature({}.update)
    with pytest.raises(ValueError, match=r"update\(\) cannot be called as update\(readings\)"):
        make_part("estimator", "mine:Odd", Odd, RobotParameters(), 0.02)


@pytest.mark.parametrize(
    "value", [np.eye(2), np.diag([1.0, math.nan, 1.0]), "wide", [[1.0, 0.0, True]] * 3, np.eye(4)]
)
def test_a_covariance_is_three_by_three_finite_numbers(value):
    with pytest.raises(ValueError, match=r"must return a covariance of 3 × 3 finite numbers"):
        checked_covariance(value, "the estimator")


def test_a_working_directory_that_could_be_imported_from_still_can_be_afterwards(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    here = str(Path.cwd())
    for before in ([*sys.path], [*sys.path, here]):
        monkeypatch.setattr(sys, "path", [*before])
        assert load_part("policy", f"{HERE}:PaperEkf", trust=True) is PaperEkf
        assert sys.path == before


class Remembering:
    """A caller with a hook."""

    def __init__(self):
        self.value = 0

    def get_state(self):
        return self.value

    def set_state(self, state):
        self.value = state


def test_a_caller_takes_a_state_with_a_hook_only_if_it_has_one():
    numbers: dict[str, np.ndarray] = {}
    one, other = Remembering(), Remembering()
    one.value = 7
    tree = caller_state(one, "policy", "policy", numbers, memory=[1, 2])
    assert give_caller_state(other, tree, "policy", numbers) == [1, 2]
    assert other.value == 7
    plain = caller_state(object(), "policy", "policy", numbers)
    assert give_caller_state(object(), plain, "policy", numbers) is None
    for caller, state in ((object(), tree), (Remembering(), plain)):
        with pytest.raises(ValueError, match="the policy does not take its state"):
            give_caller_state(caller, state, "policy", numbers)
