"""Signals that drive the channels: statistics, times, and what is refused."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from tlf_env.common.errors import one_line
from tlf_env.disturbances.signals import Signal, SignalRow, is_due, signal_value

ADAPTER: TypeAdapter[Signal] = TypeAdapter(Signal)
DT_S = 0.001
PERIOD_S = 0.02
CHANNEL = 100
FINITE = st.floats(-1e3, 1e3)


def signal(**fields):
    return ADAPTER.validate_python(fields)


def values(fields, ticks, *, seed=0, channel=CHANNEL, robot=0, episode=0, period_s=DT_S):
    """The signal's values at ``ticks``, of one robot in one episode."""
    row = signal(**fields).row(DT_S, period_s)
    memory, out = 0.0, []
    for tick in ticks:
        value, memory = signal_value(row, tick, DT_S, seed, channel, robot, episode, memory)
        out.append(value)
    return np.array(out)


def redrawn(fields, count):
    """The first ``count`` draws of a signal that is redrawn at every tick."""
    return values({**fields, "every_s": DT_S}, range(count))


def refusal(**fields):
    with pytest.raises(ValidationError) as caught:
        signal(**fields)
    line = one_line(caught.value, Signal)
    assert "\n" not in line
    return line


@pytest.mark.parametrize("ticks", [1, 3, 20])
@pytest.mark.parametrize("every_s", [DT_S, 0.007, 0.02, 0.1])
def test_a_drawn_signal_is_due_whenever_it_was_drawn_anew(every_s, ticks):
    fields = {"type": "uniform", "low": 0.0, "high": 1.0, "every_s": every_s}
    row, found = signal(**fields).row(DT_S, PERIOD_S), values(fields, range(300))
    for tick in range(ticks, 300):
        assert is_due(row, tick, ticks) == (found[tick] != found[tick - ticks])
    assert is_due(row, 0, ticks)


def test_constant_is_constant():
    assert (values({"type": "constant", "value": 3.5}, range(0, 5000, 100)) == 3.5).all()


def test_step_changes_at_its_time_and_stays():
    fields = {"type": "step", "value": 7.0, "at_s": 0.25, "before": -2.0}
    assert values(fields, [0, 249]).tolist() == [-2.0, -2.0]
    assert values(fields, [250, 251, 100_000]).tolist() == [7.0] * 3


def test_impulse_lasts_from_its_time_for_its_duration():
    fields = {"type": "impulse", "value": 7.0, "at_s": 0.25, "duration_s": 0.125, "rest": 1.0}
    out = values(fields, range(1000))
    assert np.flatnonzero(out == 7.0).tolist() == list(range(250, 375))
    assert (out[:250] == 1.0).all()
    assert (out[375:] == 1.0).all()


@given(
    amplitude=FINITE,
    frequency_hz=st.floats(0.01, 100),
    phase_rad=st.floats(-10, 10),
    mean=FINITE,
    tick=st.integers(0, 100_000),
)
def test_sine_has_its_frequency_phase_amplitude_and_mean(
    amplitude, frequency_hz, phase_rad, mean, tick
):
    fields = {
        "type": "sine",
        "amplitude": amplitude,
        "frequency_hz": frequency_hz,
        "phase_rad": phase_rad,
        "mean": mean,
    }
    angle = 2 * math.pi * frequency_hz * (tick * DT_S) + phase_rad
    expected = mean + amplitude * math.sin(angle)
    assert values(fields, [tick])[0] == pytest.approx(expected, abs=1e-8 * (1 + abs(amplitude)))


def test_sine_starts_rising_from_its_mean_and_repeats_after_its_period():
    fields = {"type": "sine", "amplitude": 2.0, "frequency_hz": 4.0, "mean": 1.0}
    start, top, again = values(fields, [0, 1000 // 16, 250])
    assert start == 1.0
    assert top == pytest.approx(1.0 + 2.0 * math.sin(2 * math.pi * 4.0 * 0.062))
    assert again == pytest.approx(1.0, abs=1e-12)


def test_uniform_covers_its_range_evenly():
    draws = redrawn({"type": "uniform", "low": -3.0, "high": 5.0}, 40_000)
    assert draws.min() >= -3.0
    assert draws.max() < 5.0
    assert draws.min() == pytest.approx(-3.0, abs=0.002)
    assert draws.max() == pytest.approx(5.0, abs=0.002)
    assert draws.mean() == pytest.approx(1.0, abs=4 * 8 / math.sqrt(12 * 40_000))
    assert draws.std() == pytest.approx(8 / math.sqrt(12), rel=0.01)
    counts, _ = np.histogram(draws, bins=20, range=(-3.0, 5.0))
    assert ((counts - 2000) ** 2 / 2000).sum() < 43.8  # χ², 19 degrees of freedom, 0.1 %


def test_uniform_of_no_width_is_its_value():
    assert (redrawn({"type": "uniform", "low": 2.0, "high": 2.0}, 100) == 2.0).all()


def test_gaussian_has_its_mean_variance_and_tails():
    draws = redrawn({"type": "gaussian", "mean": 4.0, "std": 3.0}, 40_000)
    z = (draws - 4.0) / 3.0
    assert z.mean() == pytest.approx(0.0, abs=4 / math.sqrt(40_000))
    assert z.std() == pytest.approx(1.0, abs=4 / math.sqrt(2 * 40_000))
    assert (z**3).mean() == pytest.approx(0.0, abs=4 * math.sqrt(15 / 40_000))
    assert (z**4).mean() == pytest.approx(3.0, abs=4 * math.sqrt(96 / 40_000))
    assert (np.abs(z) > 2).mean() == pytest.approx(0.0455, abs=0.005)


@pytest.mark.parametrize(
    "fields", [{"type": "uniform", "low": -1, "high": 1}, {"type": "gaussian", "std": 1}]
)
def test_redrawn_signals_hold_within_and_are_independent_between(fields):
    out = values({**fields, "every_s": 0.05}, range(50 * 2000)).reshape(2000, 50)
    assert (out == out[:, :1]).all()
    draws = out[:, 0]
    assert len(np.unique(draws)) == len(draws)
    for lag in (1, 2, 5):
        assert abs(np.corrcoef(draws[:-lag], draws[lag:])[0, 1]) < 4 / math.sqrt(2000)


def test_a_period_shorter_than_a_tick_redraws_at_every_tick():
    fields = {"type": "gaussian", "std": 1.0, "every_s": 1e-5}
    assert len(np.unique(values(fields, range(100)))) == 100


@pytest.mark.parametrize(
    "fields", [{"type": "uniform", "low": -1, "high": 1}, {"type": "gaussian", "std": 1}]
)
def test_without_a_period_one_draw_holds_for_the_episode(fields):
    assert signal(**fields).is_steady()
    assert not signal(**fields, every_s=1.0).is_steady()
    first = values(fields, range(0, 100_000, 1000))
    assert (first == first[0]).all()
    others = [
        values(fields, [0], episode=1)[0],
        values(fields, [0], robot=1)[0],
        values(fields, [0], seed=1)[0],
        values(fields, [0], channel=CHANNEL + 1)[0],
    ]
    assert len({first[0], *others}) == 5


def test_draws_per_episode_are_independent_between_episodes_and_robots():
    fields = {"type": "gaussian", "std": 1.0}
    table = np.array(
        [[values(fields, [0], robot=r, episode=e)[0] for r in range(40)] for e in range(40)]
    )
    assert table.mean() == pytest.approx(0, abs=4 / 40)
    assert table.std() == pytest.approx(1, abs=4 / math.sqrt(2 * 1600))
    for a, b in ((table[1:], table[:-1]), (table[:, 1:], table[:, :-1])):
        assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 4 / 40


@pytest.mark.parametrize(("time_constant_s", "period_s"), [(0.05, DT_S), (0.5, PERIOD_S)])
def test_ornstein_uhlenbeck_is_stationary_with_an_exponential_autocorrelation(
    time_constant_s, period_s
):
    fields = {
        "type": "ornstein_uhlenbeck",
        "std": 3.0,
        "mean": 10.0,
        "time_constant_s": time_constant_s,
    }
    each = round(period_s / DT_S)
    length = round(4 * time_constant_s / period_s)
    runs = np.array(
        [
            values(fields, range(0, each * (length + 1), each), seed=k, period_s=period_s)
            for k in range(4000)
        ]
    )
    z = (runs - 10.0) / 3.0
    for k in (0, length // 2, length):  # across runs, so already at the first tick
        assert z[:, k].mean() == pytest.approx(0, abs=4 / math.sqrt(4000))
        assert z[:, k].std() == pytest.approx(1, abs=4 / math.sqrt(8000))
    for lag in (1, length // 8, length // 4, length // 2):
        expected = math.exp(-lag * period_s / time_constant_s)
        found = (z[:, :-lag] * z[:, lag:]).mean()
        assert found == pytest.approx(expected, abs=0.03)


def test_ornstein_uhlenbeck_differs_between_robots_and_repeats():
    fields = {"type": "ornstein_uhlenbeck", "std": 1.0, "time_constant_s": 0.1}
    again = values(fields, range(100))
    assert (values(fields, range(100)) == again).all()
    for other in ({"robot": 1}, {"episode": 1}, {"seed": 1}, {"channel": CHANNEL + 1}):
        assert (values(fields, range(100), **other) != again).all()


@pytest.mark.parametrize(
    ("fields", "reach"),
    [
        ({"type": "constant", "value": 3}, (3, 3)),
        ({"type": "step", "value": -3, "at_s": 1, "before": 2}, (-3, 2)),
        ({"type": "impulse", "value": 4, "at_s": 1, "duration_s": 1, "rest": 1}, (1, 4)),
        ({"type": "sine", "amplitude": -2, "frequency_hz": 1, "mean": 1}, (-1, 3)),
        ({"type": "uniform", "low": -2, "high": 7}, (-2, 7)),
        ({"type": "gaussian", "std": 2, "mean": 1}, (-7, 9)),
        ({"type": "ornstein_uhlenbeck", "std": 2, "mean": 1, "time_constant_s": 1}, (-7, 9)),
    ],
)
def test_reach_is_the_range_of_values(fields, reach):
    assert signal(**fields).reach() == pytest.approx(reach)
    low, high = signal(**fields).reach()
    out = values(fields, range(0, 2000, 7))
    assert out.min() >= low - 1e-12
    assert out.max() <= high + 1e-12


def test_rows_are_six_numbers():
    assert len(SignalRow._fields) == 6
    assert all(isinstance(x, int | float) for x in signal(type="gaussian", std=1).row(DT_S, DT_S))


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"type": "triangle", "value": 1}, ["triangle", "constant", "ornstein_uhlenbeck"]),
        ({"value": 1}, ["type"]),
        ({"type": "constant"}, ["value"]),
        ({"type": "constant", "value": math.nan}, ["value", "nan"]),
        ({"type": "constant", "value": math.inf}, ["value", "inf"]),
        ({"type": "constant", "value": "much"}, ["value", "much"]),
        ({"type": "constant", "value": 1, "std": 1}, ["std", "unknown key"]),
        ({"type": "step", "value": 1, "at_s": -1}, ["at_s", "-1"]),
        ({"type": "impulse", "value": 1, "at_s": 1, "duration_s": 0}, ["duration_s", "0"]),
        ({"type": "sine", "amplitude": 1, "frequency_hz": 0}, ["frequency_hz", "0"]),
        ({"type": "uniform", "low": 2, "high": 1}, ["low 2", "high 1"]),
        ({"type": "uniform", "low": 0, "high": 1, "every_s": 0}, ["every_s", "0"]),
        ({"type": "gaussian", "std": -1}, ["std", "-1"]),
        ({"type": "ornstein_uhlenbeck", "std": 1, "time_constant_s": 0}, ["time_constant_s", "0"]),
    ],
)
def test_impossible_signals_are_refused_in_one_line(fields, words):
    line = refusal(**fields)
    for word in words:
        assert word in line


@pytest.mark.parametrize(
    "fields",
    [
        {"type": "uniform", "low": -60.0, "high": 60.0, "every_s": 0.5},
        {"type": "gaussian", "std": 20.0, "every_s": 0.5},
        {"type": "uniform", "low": 5.0, "high": 9.0},
    ],
)
def test_a_ramp_leads_to_the_same_draws_without_a_jump(fields):
    ticks = range(3000)
    steps, ramps = values(fields, ticks), values({**fields, "ramp_s": 0.2}, ticks)
    assert ramps[0] == 0.0  # nominal
    since = np.arange(3000) % 500 if "every_s" in fields else np.arange(3000)
    assert (ramps[since >= 200] == steps[since >= 200]).all()
    most = np.abs(np.diff(steps, prepend=0.0)).max()
    assert np.abs(np.diff(ramps)).max() <= most / 200 * (1 + 1e-9)
    assert (values({**fields, "ramp_s": 0.0}, ticks) == steps).all()
    low, high = signal(**fields, ramp_s=0.2).reach(0.0)
    assert low <= 0.0 <= high


def test_a_ramp_is_not_longer_than_the_time_between_draws():
    why = refusal(type="uniform", low=0, high=1, every_s=0.1, ramp_s=0.2)
    assert "ramp_s 0.2 must be at most every_s 0.1" in why


@pytest.mark.parametrize("correlation_s", [0.02, 0.1, 1.0])
def test_band_limited_noise_has_its_spread_and_correlation(correlation_s):
    lag = round(correlation_s / DT_S)
    ticks = range(0, 3000 * lag, max(1, lag // 10))
    fields = {"type": "band_limited", "std": 2.0, "correlation_s": correlation_s, "mean": 7.0}
    out = values(fields, ticks) - 7.0
    assert out.std() == pytest.approx(2.0, rel=0.05)
    assert out.mean() == pytest.approx(0.0, abs=0.15)
    shift = lag // max(1, lag // 10)
    assert np.mean(out[:-shift] * out[shift:]) / np.var(out) == pytest.approx(1 / math.e, abs=0.04)


def test_band_limited_noise_is_smooth_and_has_no_power_beyond_its_band():
    fields = {"type": "band_limited", "std": 1.0, "correlation_s": 0.2}
    out = values(fields, range(60_000))
    jerk = np.abs(np.diff(out, n=3)).max() / DT_S**3
    assert jerk < 60.0 / (0.2 / 1.1847) ** 3  # sums of coefficients; a jump would give 1e9
    power = np.abs(np.fft.rfft(out * np.hanning(len(out)))) ** 2
    frequency = np.fft.rfftfreq(len(out), DT_S)
    assert power[frequency > 2 * 0.66 / 0.2].sum() < 1e-3 * power.sum()


def test_a_random_phase_is_drawn_once_for_each_robot_and_episode():
    fields = {"type": "sine", "amplitude": 1.0, "frequency_hz": 1.0, "random_phase": True}
    ticks = range(1000)
    one = values(fields, ticks)
    assert (values(fields, ticks) == one).all()
    phases = []
    for robot, episode in ((0, 1), (1, 0), (2, 0)):
        other = values(fields, ticks, robot=robot, episode=episode)
        assert np.abs(other - one).max() > 0.01
        assert np.ptp(other) == pytest.approx(2.0, abs=1e-3)
    for robot in range(400):
        start, quarter = values(fields, (0, 250), robot=robot)
        phases.append(math.atan2(start, quarter))
    assert np.abs(np.mean(np.exp(1j * np.array(phases)))) < 0.15  # evenly around the circle


def test_a_pulse_comes_once_in_every_window_at_a_time_of_its_own():
    fields = {"type": "pulses", "value": 3.0, "every_s": 0.1, "duration_s": 0.03, "rest": 1.0}
    windows = values(fields, range(200_000)).reshape(2000, 100)
    on = windows == 3.0
    assert (windows[~on] == 1.0).all()
    assert (on.sum(axis=1) == 30).all()
    assert (
        np.abs(np.diff(np.pad(on, ((0, 0), (1, 1))).astype(int), axis=1)).sum(axis=1) == 2
    ).all()
    first = on.argmax(axis=1)
    assert (first.min(), first.max()) == (0, 70)
    assert first.mean() == pytest.approx(35.0, abs=4 * 20.5 / math.sqrt(2000))
    whole = {**fields, "duration_s": 0.1}
    assert (values(whole, range(1000)) == 3.0).all()


def test_a_pulse_is_no_longer_than_its_window():
    why = refusal(type="pulses", value=1, every_s=0.1, duration_s=0.2)
    assert "duration_s 0.2 must be at most every_s 0.1" in why
