"""What an estimator of one's own receives, and where what it returns goes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from test_parts import PaperEkf, WholeEkf

import tlf_env
from baselines import ReferencePolicy
from tlf_env.engine.formation import Formation
from tlf_env.envs.parallel import FormationParallelEnv
from tlf_env.onboard.observer import Message
from tlf_env.onboard.parts import Estimated, Readings
from tlf_env.physics.parameters import RobotParameters
from tlf_env.task.observation import TRACKING_ENTRIES, Tracking

EXACT_FIXES = {"noise_std_mm": 0}


class Probe:
    """Keeps its readings, and returns the pose of a filter with whatever ``more`` gives."""

    def __init__(
        self, robot: RobotParameters, period_s: float, more: Callable[[Readings], dict[str, Any]]
    ) -> None:
        self.robot, self.filter, self.more = robot, PaperEkf(robot, period_s), more
        self.readings: list[Readings] = []
        self.returned: list[dict[str, Any]] = []

    def reset(self, pose: np.ndarray) -> None:
        self.filter.reset(pose)

    def update(self, readings: Readings) -> Estimated:
        self.readings.append(readings)
        self.returned.append(self.more(readings))
        return Estimated(self.filter.update(readings), **self.returned[-1])

    def column(self, name: str) -> np.ndarray:
        return np.array([getattr(one, name) for one in self.readings])


class Run:
    """A formation driven by the reference controller, with a probe in every robot."""

    def __init__(
        self,
        more: Callable[[Readings], dict[str, Any]] = lambda _: {},
        always: np.ndarray | None = None,
        **options: Any,
    ) -> None:
        self.probes: list[Probe] = []

        def made(robot: RobotParameters, period_s: float) -> Probe:
            self.probes.append(Probe(robot, period_s, more))
            return self.probes[-1]

        self.env: FormationParallelEnv = tlf_env.parallel_env(
            "infinity", estimator=made, end_on=(), dtype="float64", **options
        )
        self.seen, _ = self.env.reset(seed=5)
        self.always, self.policy = always, ReferencePolicy()

    @property
    def formation(self) -> Formation:
        return self.env.formation

    def step(self, times: int = 1) -> None:
        for _ in range(times):
            rows = np.stack(list(self.seen.values()))
            actions = self.policy.predict(rows)[0]
            if self.always is not None:
                actions = np.tile(self.always, (3, 1))
            self.seen, *_ = self.env.step(dict(zip(self.env.agents, actions, strict=True)))

    def entry(self, name: str) -> np.ndarray:
        """An entry of the observation in physical units, for each robot."""
        rows = np.stack(list(self.seen.values()))
        return rows[:, Tracking._fields.index(name)] * TRACKING_ENTRIES[name].scale

    def message(self) -> Message:
        """The last broadcast, each field for each robot."""
        arrays = self.formation.arrays
        return Message(*arrays.slot(arrays.messages, self.formation.step_count)[:, :, 0])


# Where what it returns goes


def test_slip_is_what_controllers_receive() -> None:
    run = Run(lambda now: {"slip": (20.0 + now.t_s, -0.1 * now.t_s)})
    run.step(10)
    np.testing.assert_allclose(run.entry("slip_1"), 20.2)
    np.testing.assert_allclose(run.entry("slip_2"), -0.02)
    slip = run.formation.named("slip")
    np.testing.assert_allclose([slip.delta_1, slip.delta_2], [[20.2] * 3, [-0.02] * 3])


def test_twist_is_what_followers_receive_as_its_mean_over_a_control_step() -> None:
    rng = np.random.default_rng(1)
    run = Run(lambda _: {"twist": rng.normal(0.0, [300.0, 1.0])})
    for _ in range(3):
        run.step()
        message = run.message()
        for robot, probe in enumerate(run.probes):
            mean = np.mean([one["twist"] for one in probe.returned[-20:]], axis=0)
            np.testing.assert_allclose([message.u_1[robot], message.u_2[robot]], mean, rtol=1e-9)


def test_a_twist_that_is_not_returned_is_odometry_and_slip() -> None:
    run = Run(lambda now: {"slip": (1000.0 * now.t_s, -now.t_s)})
    run.step(15)
    message, times = run.message(), run.probes[0].column("t_s")[-20:]
    mean_1, mean_2 = 1000.0 * times.mean(), -times.mean()
    np.testing.assert_allclose(message.u_1, run.entry("odometry_u_1") + mean_1, rtol=1e-9)
    np.testing.assert_allclose(message.u_2, run.entry("odometry_u_2") + mean_2, rtol=1e-9)


def test_without_anything_returned_the_twist_is_the_odometry() -> None:
    run = Run()
    run.step(15)
    np.testing.assert_allclose(run.message().u_1, run.entry("odometry_u_1"), rtol=1e-12)
    assert run.entry("odometry_u_1").min() > 1.0
    np.testing.assert_array_equal(run.entry("slip_1"), 0.0)


def test_the_pose_is_broadcast_and_observed() -> None:
    run = Run()
    run.step(5)
    message, poses = run.message(), np.array([probe.filter.q for probe in run.probes]).T
    np.testing.assert_array_equal([message.x, message.y, message.theta], poses)


def test_the_covariance_is_in_the_row_and_only_while_it_is_returned() -> None:
    P = np.array([[4.0, 0.1, -0.02], [0.1, 3.0, 0.03], [-0.02, 0.03, 0.01]])
    run = Run(lambda now: {"covariance": P * now.t_s} if now.t_s < 0.0405 else {})
    run.step(2)
    row = run.formation.named("estimate")
    expected = 0.04 * P[np.triu_indices(3)]
    np.testing.assert_allclose(np.array(row)[3:], np.tile(expected, (3, 1)).T, rtol=1e-12)
    run.step()
    np.testing.assert_array_equal(np.array(run.formation.named("estimate"))[3:], 0.0)


def test_a_filter_with_its_covariance_is_the_built_in_one() -> None:
    rows = []
    for estimator in ("ekf", WholeEkf):
        env = tlf_env.parallel_env("flower", estimator=estimator, dtype="float64", end_on=())
        seen, _ = env.reset(seed=1)
        for _ in range(25):
            actions = ReferencePolicy().predict(np.stack(list(seen.values())))[0]
            seen, *_ = env.step(dict(zip(env.agents, actions, strict=True)))
        rows.append(np.array(env.formation.named("estimate")))
    np.testing.assert_allclose(rows[1], rows[0], rtol=1e-7, atol=1e-12)
    assert rows[0][3:].any(axis=1).all()


def test_a_controller_takes_the_returned_slip_off_its_command() -> None:
    """That of the followers here; the leader's acceleration is at its limit."""
    wanted = []
    for slip in (0.0, 25.0):
        run = Run(lambda _, slip=slip: {"slip": (slip, 0.0), "twist": (0.0, 0.0)})
        run.policy = ReferencePolicy("tuned")
        run.step(2)
        wanted.append(np.array(run.formation.named("wanted")))
    difference = 50.0 * (wanted[0] - wanted[1])[:, 1:]  # mm/s at wheels of 50 mm
    np.testing.assert_allclose(difference, 25.0, rtol=1e-6)


# What it receives


def test_time_and_steps_are_those_of_the_substeps() -> None:
    run = Run()
    run.step(12)
    for robot, probe in enumerate(run.probes):
        np.testing.assert_allclose(probe.column("t_s"), 0.001 * np.arange(1, 241), rtol=1e-12)
        rolled = 50.0 * probe.column("steps_rad")[-20:].sum(axis=0) / 0.02
        assert rolled.mean() == pytest.approx(run.entry("odometry_u_1")[robot], rel=1e-9)
        turn = (rolled[1] - rolled[0]) / 156.0
        assert turn == pytest.approx(run.entry("odometry_u_2")[robot], rel=1e-9, abs=1e-12)


def test_every_period_has_a_fix_by_default() -> None:
    run = Run(disturbance={"position": EXACT_FIXES})
    run.step(10)
    info = run.formation.info()
    for robot, probe in enumerate(run.probes):
        assert all(one.fix_t_s == one.t_s for one in probe.readings)
        np.testing.assert_allclose(
            probe.readings[-1].fix_mm, [info.x_mm[robot], info.y_mm[robot]], rtol=1e-12
        )


@pytest.mark.parametrize("delay_s", [0.0, 0.02, 0.05])
def test_rare_and_late_fixes_carry_the_time_at_which_they_were_true(delay_s: float) -> None:
    period_s = 0.02  # the control period: the true positions of these times are in infos
    channels = EXACT_FIXES | {"period_s": period_s, "delay_s": delay_s}
    run = Run(disturbance={"position": channels})
    true = {0: None}
    for k in range(1, 21):
        run.step()
        info = run.formation.info()
        true[k] = np.array([info.x_mm, info.y_mm]).T
    for robot, probe in enumerate(run.probes):
        fixes = [one for one in probe.readings if one.fix_mm is not None]
        expected = [k * period_s for k in range(1, 21) if k * period_s + delay_s < 0.4005]
        np.testing.assert_allclose([one.fix_t_s for one in fixes], expected, atol=1e-9)
        for one in fixes:
            assert one.t_s - one.fix_t_s == pytest.approx(delay_s, abs=1e-9)
            place = true[round(one.fix_t_s / period_s)][robot]
            np.testing.assert_allclose(one.fix_mm, place, rtol=1e-9)
        without = [one for one in probe.readings if one.fix_mm is None]
        assert len(without) == 400 - len(expected)
        assert all(one.fix_t_s is None for one in without)


def test_no_fix_comes_during_an_outage() -> None:
    run = Run(disturbance={"position": {"outage": 1.0}})
    run.step(5)
    assert all(one.fix_mm is None for probe in run.probes for one in probe.readings)


def test_an_ideal_gyro_is_the_true_yaw_rate_to_the_bit() -> None:
    run = Run(always=np.array([0.2, 0.3]))
    for _ in range(15):
        run.step()
        rates = [probe.readings[-1].gyro_rad_s for probe in run.probes]
        np.testing.assert_array_equal(rates, run.formation.named("motion").w)
    assert np.abs(rates).max() > 1e-3


def test_a_gyro_has_its_bias_and_scale() -> None:
    run = Run(always=np.array([0.2, 0.3]), disturbance={"gyro": {"bias_rad_s": 0.2, "scale": 0.9}})
    run.step(10)
    rates = [probe.readings[-1].gyro_rad_s for probe in run.probes]
    np.testing.assert_allclose(rates, 0.9 * run.formation.named("motion").w + 0.2, rtol=1e-12)


@pytest.mark.parametrize("plant", ["pymunk", "chipmunk"])
def test_torques_and_commands_are_those_of_the_infos(plant: str) -> None:
    run = Run(plant=plant)
    run.step(8)
    info, wanted = run.formation.info(), run.formation.named("wanted")
    for robot, probe in enumerate(run.probes):
        torques = probe.column("torques_Nmm")[-20:]
        np.testing.assert_allclose(
            torques.mean(axis=0),
            [info.torque_l_Nmm[robot], info.torque_r_Nmm[robot]],
            rtol=1e-9,
        )
        assert np.abs(torques).max() <= 15.0 + 1e-12
        assert torques.any()
        commands = probe.column("wanted_rad_s")[-20:]
        np.testing.assert_array_equal(
            commands, np.tile([wanted.left[robot], wanted.right[robot]], (20, 1))
        )


def test_commanded_torques_are_those_before_losses() -> None:
    run = Run(disturbance={"actuator": {"torque_gain_l": 0.5, "torque_gain_r": 0.5}})
    run.step(4)
    info = run.formation.info()
    for robot, probe in enumerate(run.probes):
        mean = probe.column("torques_Nmm")[-20:].mean(axis=0)
        delivered = np.array([info.torque_l_Nmm[robot], info.torque_r_Nmm[robot]])
        np.testing.assert_allclose(0.5 * mean, delivered, rtol=1e-9)


def test_the_last_command_holds_while_the_next_is_computed() -> None:
    run = Run(disturbance={"actuator": {"computing_delay_s": 0.006}})
    run.step(6)
    before, now = (run.formation.named(name) for name in ("wanted_before", "wanted"))
    for robot, probe in enumerate(run.probes):
        commands = probe.column("wanted_rad_s")[-20:]
        for row, rows in ((before, commands[:6]), (now, commands[6:])):
            np.testing.assert_array_equal(
                rows, np.tile([row.left[robot], row.right[robot]], (len(rows), 1))
            )
        assert (commands[5] != commands[6]).any()


def test_torque_actions_command_no_wheel_speeds() -> None:
    run = Run(always=np.array([0.3, 5.0]), action="torque")
    run.step(2)
    for probe in run.probes:
        np.testing.assert_array_equal(probe.column("wanted_rad_s"), 0.0)
        torques = probe.column("torques_Nmm")
        np.testing.assert_allclose(torques, np.tile(torques[0], (40, 1)))
        assert torques[0, 1] == pytest.approx(15.0)
        assert 0.0 < torques[0, 0] < 15.0


def test_a_wheel_loop_of_ones_own_changes_neither_commands_nor_their_meaning() -> None:
    class Weak:
        def __init__(self, robot: RobotParameters, period_s: float) -> None:
            pass

        def reset(self) -> None:
            pass

        def torque(self, wanted_rad_s: np.ndarray, measured_rad_s: np.ndarray) -> np.ndarray:
            return np.array([1.5, -2.5])

    run = Run(wheel_loop=Weak)
    run.step(3)
    wanted = run.formation.named("wanted")
    for robot, probe in enumerate(run.probes):
        np.testing.assert_allclose(
            probe.column("torques_Nmm"), np.tile([1.5, -2.5], (60, 1)), rtol=1e-12
        )
        last = probe.readings[-1].wanted_rad_s
        np.testing.assert_array_equal(last, [wanted.left[robot], wanted.right[robot]])


def test_the_kinematic_plant_has_commands_and_no_torques() -> None:
    run = Run(plant="kinematic")
    run.step(5)
    for probe in run.probes:
        np.testing.assert_array_equal(probe.column("torques_Nmm"), 0.0)
        np.testing.assert_allclose(
            probe.column("steps_rad"), probe.column("wanted_rad_s") * 0.001, rtol=1e-9, atol=1e-15
        )


REAL_SENSORS = {
    "position": {"period_s": 0.01, "delay_s": 0.03, "outage": 0.2},
    "calibration": {"radius_left": 1.02, "radius_right": 0.97, "track": 1.05},
    "encoder": {"quantum_rad": 0.002},
}


def test_with_real_sensors_too_the_papers_filter_is_the_built_in_one() -> None:
    """Late and missing fixes, coarse encoders, and wheels that are not what the robot believes."""
    rows = []
    for estimator in ("ekf", PaperEkf):
        run = tlf_env.parallel_env(
            "flower", estimator=estimator, disturbance=REAL_SENSORS, dtype="float64", end_on=()
        )
        seen, _ = run.reset(seed=2)
        for _ in range(60):
            actions = ReferencePolicy().predict(np.stack(list(seen.values())))[0]
            seen, *_ = run.step(dict(zip(run.agents, actions, strict=True)))
        rows.append(np.array(run.formation.named("estimate")[:3]))
    np.testing.assert_allclose(rows[1], rows[0], rtol=1e-9, atol=1e-9)


def test_parts_receive_the_robot_that_its_computer_believes_in() -> None:
    run = Run(disturbance={"calibration": {"track": 1.05}})
    assert [probe.robot.axle_width_mm for probe in run.probes] == pytest.approx([1.05 * 156.0] * 3)
    assert [probe.robot.axle_width_mm for probe in Run().probes] == [156.0] * 3


def test_readings_may_be_kept_and_changed() -> None:
    class Careless(WholeEkf):
        def update(self, readings: Readings) -> Any:
            result = super().update(readings)
            for array in (readings.steps_rad, readings.wanted_rad_s, readings.torques_Nmm):
                array[:] = np.nan
            return result

    ends = []
    for part in (WholeEkf, Careless):
        env = tlf_env.parallel_env("infinity", estimator=part, end_on=())
        seen, _ = env.reset(seed=0)
        for _ in range(5):
            actions = ReferencePolicy().predict(np.stack(list(seen.values())))[0]
            seen, *_ = env.step(dict(zip(env.agents, actions, strict=True)))
        ends.append(env.formation.state().copy())
    np.testing.assert_array_equal(*ends)


# What goes wrong is named


GOOD = np.diag([1.0, 1.0, 0.01])
BAD = [
    ({"twist": (1.0,)}, "a twist of 2 finite numbers, got (1.0,)"),
    ({"twist": (np.nan, 0.0)}, "a twist of 2 finite numbers, got (nan, 0.0)"),
    ({"slip": np.zeros((2, 1))}, "a slip of 2 finite numbers, got array"),
    ({"slip": "none"}, "a slip of 2 finite numbers, got 'none'"),
    ({"covariance": np.zeros(3)}, "a covariance of 3 × 3 finite numbers, got array"),
    ({"covariance": np.full((3, 3), np.inf)}, "a covariance of 3 × 3 finite numbers, got array"),
    ({"covariance": -GOOD}, "a covariance without negative variances, got array"),
    ({"covariance": GOOD + 0.1 * np.eye(3, k=1)}, "a symmetric covariance, got array"),
]


@pytest.mark.parametrize(("more", "message"), BAD, ids=[message for _, message in BAD])
def test_an_impossible_estimate_is_named_with_robot_part_and_quantity(
    more: dict[str, Any], message: str
) -> None:
    run = Run(lambda _: more)
    with pytest.raises(ValueError, match="robot_0: the estimator's update") as error:
        run.step()
    assert str(error.value).startswith(f"robot_0: the estimator's update() must return {message}")
    assert "\n" not in str(error.value)


def test_rounding_makes_no_covariance_asymmetric() -> None:
    P = GOOD + 1e-9 * np.eye(3, k=1)
    run = Run(lambda _: {"covariance": P})
    run.step()
    assert run.formation.named("estimate").p_xx == pytest.approx([1.0] * 3)


def test_the_former_signature_is_refused_with_the_present_one() -> None:
    class Former:
        def __init__(self, robot: RobotParameters, period_s: float) -> None:
            pass

        def reset(self, pose: np.ndarray) -> None:
            pass

        def update(self, steps_rad: np.ndarray, fix_mm: np.ndarray) -> np.ndarray:
            return np.zeros(3)

    env = tlf_env.parallel_env("infinity", estimator=Former)
    with pytest.raises(
        ValueError,
        match=r"cannot be called as update\(readings\): [^\n]*; readings is a tlf_env.Readings$",
    ):
        env.reset(seed=0)
