"""What the channels do to sensors, actuators and the radio."""

import math

import numpy as np
import pytest
from disturbance_helpers import ANGLES, SHOWS, SLIPPING, Run, constant, make, run, tree

from tlf_env.disturbances.channels import DEAD_TIME, NOMINAL_NOISE_MM
from tlf_env.engine.arrays import longest
from tlf_env.engine.radio import delayed_message
from tlf_env.engine.settings import make_settings
from tlf_env.onboard.parts import part_name
from tlf_env.physics.state import Motion
from tlf_env.task.observation import SENSOR_TAIL_ENTRIES
from tlf_env.task.scenario import load_scenario

# --- sensors ---------------------------------------------------------------------------------------


def test_fixes_have_the_noise_and_the_bias_asked_for():
    found = run(
        {
            "position.noise_std_mm": 3.0,
            "position.bias_x_mm": 40.0,
            "position.bias_y_mm": -20.0,
        },
        seconds=10.0,
        plant="kinematic",
        actions=constant([0.1, 0.1]),
    )
    z = found.fix - [40.0, -20.0]
    count = z[..., 0].size
    assert z.mean(axis=(0, 1)) == pytest.approx(0, abs=4 * 3 / math.sqrt(count))
    assert z.std(axis=(0, 1)) == pytest.approx(3, rel=4 / math.sqrt(2 * count))
    assert abs(np.corrcoef(z[..., 0].ravel(), z[..., 1].ravel())[0, 1]) < 4 / math.sqrt(count)
    assert abs((z[1:] * z[:-1]).mean() / 9) < 4 / math.sqrt(2 * count)


def test_nominal_fixes_have_a_variance_of_0_2_mm2():
    found = run(seconds=10.0, plant="kinematic", actions=constant([0.1, 0.1]))
    assert found.fix.var() == pytest.approx(0.2, rel=4 * math.sqrt(2 / found.fix.size))
    assert pytest.approx(math.sqrt(0.2)) == NOMINAL_NOISE_MM


def test_encoders_read_the_angle_rounded_down_to_the_quantum():
    quantum = 2 * math.pi / 512
    found = run({"encoder.quantum_rad": quantum})
    read = found.turned.cumsum(axis=0)
    exact = quantum * np.floor(found.motion[:, :, ANGLES] / quantum)
    assert read == pytest.approx(exact, abs=1e-9)


def test_encoder_noise_is_white_with_its_standard_deviation():
    found = run(
        {"encoder.noise_std_rad": 0.01},
        seconds=10.0,
        plant="kinematic",
        actions=constant([0.1, 0.1]),
    )
    noise = (found.turned.cumsum(axis=0) - found.motion[:, :, ANGLES]) / 0.01
    assert noise.mean() == pytest.approx(0, abs=4 / math.sqrt(noise.size))
    assert noise.std() == pytest.approx(1, rel=4 / math.sqrt(2 * noise.size))
    assert abs((noise[1:] * noise[:-1]).mean()) < 4 / math.sqrt(noise.size)


# --- actuators -------------------------------------------------------------------------------------


def torques(asked, channels, period_s=0.001, **overrides):
    """Torques delivered (N·mm) for torques asked for ``(step, robot, wheel)``."""
    found = run(
        channels,
        seconds=len(asked) * period_s,
        action="torque",
        control_period_s=period_s,
        horizon_s=2.0,
        actions=lambda k: asked[k] / 15.0,
        **overrides,
    )
    return np.stack([found.of_info("torque_l_Nmm"), found.of_info("torque_r_Nmm")], axis=-1)


def asked_at_random(steps):
    return np.random.default_rng(0).uniform(-5, 5, (steps, 3, 2))


def test_torque_gains_scale_the_torque_of_each_wheel():
    asked = asked_at_random(50)
    given = torques(asked, {"actuator.torque_gain_l": 0.9, "actuator.torque_gain_r": 1.2})
    assert given == pytest.approx(asked * [0.9, 1.2], abs=1e-9)


@pytest.mark.parametrize("milliseconds", [0, 1, 7, 100])
def test_dead_time_delays_the_torque_by_exactly_so_many_milliseconds(milliseconds):
    asked = asked_at_random(200)
    given = torques(asked, {"actuator.dead_time_s": milliseconds / 1000})
    assert given[:milliseconds] == pytest.approx(0.0)
    assert given[milliseconds:] == pytest.approx(asked[: 200 - milliseconds], abs=1e-9)


def test_a_dead_time_that_walks_away_from_its_start_delays_by_what_it_is():
    """It has no bound but the channel's range, so the memory of torques must be as long as that."""
    walk = {"type": "random_walk", "start": 0.03, "per_sqrt_s": 0.2}
    asked = asked_at_random(400)
    found = run(
        {"actuator.dead_time_s": walk},
        seconds=0.4,
        action="torque",
        control_period_s=0.001,
        horizon_s=2.0,
        actions=lambda k: asked[k] / 15.0,
    )
    dead = np.rint(found.applied[:, :, DEAD_TIME] * 1000).astype(int)
    assert dead.max() > 60
    assert dead.min() < 10
    given = np.stack([found.of_info("torque_l_Nmm"), found.of_info("torque_r_Nmm")], axis=-1)
    then = np.arange(400)[:, None] - dead
    wanted = np.where((then >= 0)[:, :, None], asked[then.clip(0), np.arange(3)], 0.0)
    assert given == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize(
    ("signal", "most"),
    [
        (0.03, 0.03),
        ({"type": "uniform", "low": 0.01, "high": 0.04}, 0.04),
        ({"type": "sine", "amplitude": 0.01, "mean": 0.02, "frequency_hz": 1.0}, 0.03),
        ({"type": "gaussian", "mean": 0.03, "std": 0.0}, 0.03),
        ({"type": "gaussian", "mean": 0.03, "std": 0.001}, 0.1),
        ({"type": "ornstein_uhlenbeck", "mean": 0.03, "std": 1e-3, "time_constant_s": 1.0}, 0.1),
        ({"type": "band_limited", "mean": 0.03, "std": 1e-3, "correlation_s": 1.0}, 0.1),
        ({"type": "random_walk", "start": 0.03, "per_sqrt_s": 1e-6}, 0.1),
        ({"type": "random_walk", "start": 0.03, "per_sqrt_s": 0.0}, 0.03),
    ],
)
def test_a_memory_is_as_long_as_a_signal_without_bounds_may_need(signal, most):
    """That is the end of the channel's range, at any level but 0."""
    for level, wanted in ((0.0, 0.0), (0.5, most if most == 0.1 else most / 2), (1.0, most)):
        given = {**tree({"actuator.dead_time_s": signal}), "level": level}
        scenario = load_scenario("infinity", disturbance=given)
        assert longest(scenario, DEAD_TIME) == pytest.approx(wanted)


@pytest.mark.parametrize("milliseconds", [0, 1, 7, 20])
def test_computing_delay_holds_the_last_action_for_so_many_milliseconds(milliseconds):
    asked = asked_at_random(20)
    given = torques(asked, {"actuator.computing_delay_s": milliseconds / 1000}, 0.02)
    share = milliseconds / 20
    before = np.concatenate([np.zeros((1, 3, 2)), asked[:-1]])
    assert given == pytest.approx(share * before + (1 - share) * asked, abs=1e-9)


def test_dead_time_and_computing_delay_add_up():
    asked = asked_at_random(20)
    delays = {"actuator.computing_delay_s": 0.005, "actuator.dead_time_s": 0.003}
    one = torques(asked, {"actuator.computing_delay_s": 0.008}, 0.02)
    assert torques(asked, delays, 0.02) == pytest.approx(one, abs=1e-9)


def proportional_loop(robot, period_s):
    """A user's wheel loop."""

    class Loop:
        def reset(self):
            pass

        def torque(self, wanted, measured):
            return 10 * (np.asarray(wanted) - np.asarray(measured))

    return Loop()


def test_computing_delay_acts_on_a_users_wheel_loop_too():
    part = {"parts": {"wheel_loop": proportional_loop}, "wheel_loop": part_name(proportional_loop)}

    def moved(channels):
        found = Run(make(tree(channels), **part), 0.1, constant([0.1, 0.0]))
        return found.motion[0, :, 9]

    assert (moved({}) > 0).all()
    assert moved({"actuator.computing_delay_s": 0.02}) == pytest.approx(0.0, abs=1e-12)


def test_a_computing_delay_beyond_the_control_period_is_refused():
    with pytest.raises(ValueError, match=r"computing_delay_s.*0\.03.*0\.02"):
        make(tree({"actuator.computing_delay_s": 0.03}))


# --- radio -----------------------------------------------------------------------------------------


def ages(found, robot=1, count=2000):
    """How many control steps beyond the gap each message is late, in steps 100 to 100 + ``count``."""
    formation = found.formation
    a, s = formation.arrays, make_settings(formation.scenario)
    slots = a.messages.shape[1]
    a.messages[:] = 0.0
    out = []
    for step in range(100, 100 + count):
        a.clock[0, 1] = step
        for sent in range(step - slots + 1, step + 1):  # at rest, so that dead reckoning leaves x
            a.messages[0, sent % slots, robot - 1, 0] = sent
        out.append(step - s.gap - delayed_message(a, 0, robot, step, s).x)
    return np.array(out, dtype=int)


def test_the_dropout_is_the_share_of_messages_that_never_arrive():
    dropped = run({"radio.dropout": 0.3}, seconds=20.0).dropped
    assert dropped.mean() == pytest.approx(0.3, abs=4 * math.sqrt(0.21 / dropped.size))
    pairs = dropped[1:] & dropped[:-1]
    assert pairs.mean() == pytest.approx(0.09, abs=0.02)  # one after the other independently


def rounded(theta, distance, turn):
    """Way in world axes on the arc of a length and a turn, by the closed form of eq. (1)."""
    if abs(turn) < 1e-9:
        return np.array([-math.sin(theta), math.cos(theta)]) * distance
    end = theta + turn
    return (
        distance
        / turn
        * np.array([math.cos(end) - math.cos(theta), math.sin(end) - math.sin(theta)])
    )


@pytest.mark.parametrize("dropout", [0.3, 0.95, 0.999])
def test_a_follower_goes_on_from_the_last_message_that_arrived(dropout):
    found = run(
        {"radio.dropout": dropout},
        seconds=12.0,
        observation="sensor",
        dtype="float64",
        time_gap_s=1.0,
        preview_s=(),
        broadcast_smoothing_s=0.0,
    )
    first = [*SENSOR_TAIL_ENTRIES].index("message_x") - len(SENSOR_TAIL_ENTRIES)
    scale = found.formation.arrays.sensor_scales[[first, first + 1]]
    heard = found.seen[:, 1, [first, first + 1]] * scale + found.starts[1, :2]  # by robot_1
    sent = np.concatenate([[[*found.starts[0], 0.0, 0.0]], found.message[:, 0]])
    arrived = np.concatenate([[True], ~found.dropped[:, 0]])
    expected = []
    for step in range(1, len(heard) + 1):
        newest = max(step - 50, 0)
        k = newest
        while not arrived[k]:
            k -= 1
        ago = (newest - k) * 0.02
        x, y, theta, u_1, u_2 = sent[k]
        expected.append(np.array([x, y]) + rounded(theta, u_1 * ago, u_2 * ago))
    assert heard == pytest.approx(np.array(expected), abs=1e-6)


def steady(channels):
    """From rest at once to one constant twist: the kinematic plant."""
    return run(
        channels,
        seconds=6.0,
        actions=constant([0.3, 0.0]),
        plant="kinematic",
        estimator="truth",
        observation="sensor",
        dtype="float64",
        time_gap_s=1.0,
        preview_s=(),
    )


@pytest.mark.parametrize(
    "channels", [{"radio.dropout": 0.3}, {"radio.jitter_s": 0.3}, SLIPPING | {"radio.dropout": 0.3}]
)
def test_lost_and_late_messages_change_nothing_while_the_sender_keeps_its_twist(channels):
    """On a line, and on a circle; from the first message on that tells the speed."""
    perfect = {path: value for path, value in channels.items() if not path.startswith("radio")}
    heard, expected = steady(channels).seen[:, 1], steady(perfect).seen[:, 1]
    np.testing.assert_allclose(heard[80:], expected[80:], rtol=0, atol=1e-9)
    assert np.abs(expected[80:]).max() > 0.1


@pytest.mark.parametrize("action", [(0.3, 0.0), (0.2, 0.05), (0.0, -0.1), (-0.2, 0.1)])
def test_truth_broadcasts_the_true_motion_whatever_the_encoders_say(action):
    found = run(
        SLIPPING | {"encoder.quantum_rad": 0.02, "encoder.noise_std_rad": 0.01},
        seconds=2.0,
        actions=constant(action),
        estimator="truth",
        plant="kinematic",
    )
    u_1 = 1000.0 * action[0] + SLIPPING["slip.delta_1_mm_s"]
    u_2 = 8.0 * action[1] + SLIPPING["slip.delta_2_rad_s"]
    assert found.message[:, :, 3] == pytest.approx(u_1, abs=1e-9)
    assert found.message[:, :, 4] == pytest.approx(u_2, abs=1e-9)
    one = found.formation.arrays.rows("slip")[:2, :, 0]
    assert one == pytest.approx(np.array([[v] * 3 for v in SLIPPING.values()]), abs=1e-9)


def test_truth_broadcasts_the_true_motion_of_a_robot_that_skids():
    found = run({"tyre.friction_scale": 0.2}, seconds=3.0, estimator="truth")
    theta, v_x, v_y, w = (
        found.motion[:, :, Motion._fields.index(name)] for name in ("theta", "v_x", "v_y", "w")
    )
    forward = v_y * np.cos(theta) - v_x * np.sin(theta)
    assert found.message[:, :, 3] == pytest.approx(forward, abs=1e-12)
    assert (found.message[:, :, 4] == w).all()


def test_with_the_slip_aware_filter_the_estimated_slip_goes_on_the_air():
    """Odometry does not see the conveyor; the message does, once the filter has found it."""
    channels = SLIPPING | {"position.noise_std_mm": 0.4472}
    odometry, both = (
        run(channels, seconds=8.0, actions=constant([0.3, 0.0]), estimator=estimator)
        for estimator in ("ekf", "ekf-slip")
    )
    assert (odometry.motion == both.motion).all()
    sent = (both.message - odometry.message)[-100:, :, 3:].mean(axis=0)
    assert sent[:, 0] == pytest.approx(SLIPPING["slip.delta_1_mm_s"], abs=0.5)
    assert sent[:, 1] == pytest.approx(SLIPPING["slip.delta_2_rad_s"], abs=0.02)


@pytest.mark.parametrize("steps", [1, 5, 50])
def test_jitter_makes_messages_older_evenly_up_to_its_value(steps):
    found = run({"radio.jitter_s": steps * 0.02}, seconds=0.02)
    late = ages(found)
    counts = np.bincount(late, minlength=steps + 1)
    assert len(counts) == steps + 1
    expected = len(late) / (steps + 1)
    chi_2 = ((counts - expected) ** 2 / expected).sum()
    assert chi_2 < steps + 4 * math.sqrt(2 * steps) + 6
    assert (ages(found, robot=2) != late).any()


@pytest.mark.parametrize("jitter_s", [0.005, 0.01, 0.03, 0.11])
def test_jitter_never_makes_a_message_older_than_its_value(jitter_s):
    found = run({"radio.jitter_s": jitter_s}, seconds=0.02)
    assert ages(found).max() * 0.02 <= jitter_s + 1e-12


def echo(robot, period_s):
    """A user's observer: the message is the reference."""

    class Observer:
        def reset(self, pose):
            pass

        def update(self, message, t_s):
            return tuple(message)

    return Observer()


@pytest.mark.parametrize("channel", ["radio.dropout", "radio.jitter_s"])
def test_a_users_observer_hears_through_the_same_radio(channel):
    part = {"parts": {"observer": echo}, "observer": part_name(echo)}

    def heard(channels):
        found = Run(make(tree(channels), **part))
        return found.of_info("reference_x_mm")[:, 1]

    assert (heard({channel: SHOWS[channel]}) != heard({})).any()
