"""Signals over time that drive a disturbance's channels. Times in s, values in the channel's unit."""

from __future__ import annotations

import math
from typing import Annotated, Literal, NamedTuple, Self

from pydantic import Field, model_validator

from tlf_env.common.models import Frozen, NonNegative, Number, Positive, Switch
from tlf_env.numerics.compiled import law
from tlf_env.numerics.philox import normal_pair, unit, words

CONSTANT, STEP, IMPULSE, SINE, UNIFORM, GAUSSIAN, ORNSTEIN_UHLENBECK, BAND_LIMITED = range(8)
RANDOM_WALK, PULSES = 8, 9
# Of a cubic B-spline with independent coefficients of unit variance: the standard deviation, and the lag at
# which its autocorrelation (a B-spline of degree 7) is 1/e, in distances between coefficients.
SPLINE_STD = math.sqrt(151.0 / 315.0)
SPLINE_CORRELATION = 1.1847
TAILS = 4.0  # standard deviations that count as reachable when a range is checked


class SignalRow(NamedTuple):
    """A signal as the compiled law takes it; what the numbers mean depends on the kind."""

    kind: float
    a: float
    b: float
    c: float
    every: float  # ticks between draws; 0: one draw per episode
    d: float = 0.0


def _or(value: float | None, nominal: float) -> float:
    return nominal if value is None else value


class _Signal(Frozen):
    def row(self, dt_s: float, period_s: float, nominal: float = 0.0) -> SignalRow:
        """The compiled form for a tick of ``dt_s`` s, if evaluated once per ``period_s`` s.

        ``nominal`` is the channel's value without a disturbance, where a field is None.
        """
        raise NotImplementedError

    def reach(self, nominal: float = 0.0) -> tuple[float, float]:
        """Smallest and largest value; four standard deviations where there is no bound."""
        raise NotImplementedError

    def is_bounded(self) -> bool:
        """Whether :meth:`reach` holds for every value; otherwise the channel's range alone does."""
        return True

    def is_steady(self) -> bool:
        """Whether the value stays for a whole episode."""
        return False


class Constant(_Signal):
    """The same value always."""

    type: Literal["constant"] = "constant"
    value: Number

    def row(self, dt_s: float, period_s: float, nominal: float = 0.0) -> SignalRow:
        """See :class:`SignalRow`."""
        return SignalRow(CONSTANT, self.value, 0.0, 0.0, 0.0)

    def reach(self, nominal: float = 0.0) -> tuple[float, float]:
        """The value."""
        return self.value, self.value

    def is_steady(self) -> bool:
        """Always."""
        return True


class Step(_Signal):
    """``before`` until ``at_s``, then ``value``."""

    type: Literal["step"] = "step"
    value: Number
    at_s: NonNegative
    before: Number | None = None  # None: the channel's nominal value

    def row(self, dt_s: float, period_s: float, nominal: float = 0.0) -> SignalRow:
        """See :class:`SignalRow`."""
        return SignalRow(STEP, self.value, self.at_s, _or(self.before, nominal), 0.0)

    def reach(self, nominal: float = 0.0) -> tuple[float, float]:
        """The two values."""
        before = _or(self.before, nominal)
        return min(self.value, before), max(self.value, before)


class Impulse(_Signal):
    """``value`` from ``at_s`` on for ``duration_s``, ``rest`` otherwise."""

    type: Literal["impulse"] = "impulse"
    value: Number
    at_s: NonNegative
    duration_s: Positive
    rest: Number | None = None  # None: the channel's nominal value

    def row(self, dt_s: float, period_s: float, nominal: float = 0.0) -> SignalRow:
        """See :class:`SignalRow`; the duration travels in ``every`` as seconds."""
        return SignalRow(IMPULSE, self.value, self.at_s, _or(self.rest, nominal), self.duration_s)

    def reach(self, nominal: float = 0.0) -> tuple[float, float]:
        """The two values."""
        rest = _or(self.rest, nominal)
        return min(self.value, rest), max(self.value, rest)


class Sine(_Signal):
    """``mean`` + ``amplitude`` · sin(2π ``frequency_hz`` t + ``phase_rad``).

    With ``random_phase`` a phase is drawn for each robot and episode, and added.
    """

    type: Literal["sine"] = "sine"
    amplitude: Number
    frequency_hz: Positive
    phase_rad: Number = 0.0
    random_phase: Switch = False
    mean: Number | None = None  # None: the channel's nominal value

    def row(self, dt_s: float, period_s: float, nominal: float = 0.0) -> SignalRow:
        """See :class:`SignalRow`; the mean travels in ``every``, and ``d`` is 1 for a random phase."""
        rate = 2 * math.pi * self.frequency_hz
        mean = _or(self.mean, nominal)
        return SignalRow(SINE, self.amplitude, rate, self.phase_rad, mean, float(self.random_phase))

    def reach(self, nominal: float = 0.0) -> tuple[float, float]:
        """Mean ± amplitude."""
        mean = _or(self.mean, nominal)
        return mean - abs(self.amplitude), mean + abs(self.amplitude)


class _Drawn(_Signal):
    every_s: Positive | None = None  # None: one draw for the whole episode
    ramp_s: NonNegative = (
        0.0  # the value gets evenly to a new draw in this time; first from nominal
    )

    @model_validator(mode="after")
    def _check_ramp(self) -> Self:
        if self.every_s is not None and self.ramp_s > self.every_s:
            raise ValueError(f"ramp_s {self.ramp_s} must be at most every_s {self.every_s}")
        return self

    def is_steady(self) -> bool:
        """If there is one draw per episode, without a ramp."""
        return self.every_s is None and self.ramp_s == 0.0

    def ticks(self, dt_s: float) -> float:
        """Ticks between draws, 0 for one draw per episode, at least 1."""
        return 0.0 if self.every_s is None else float(max(1, round(self.every_s / dt_s)))

    def with_ramp(self, low: float, high: float, nominal: float) -> tuple[float, float]:
        """The range of draws, with the nominal value if a ramp begins there."""
        return (min(low, nominal), max(high, nominal)) if self.ramp_s else (low, high)


class Uniform(_Drawn):
    """Drawn evenly between ``low`` and ``high``, anew ``every_s``, or once per episode."""

    type: Literal["uniform"] = "uniform"
    low: Number
    high: Number

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.low > self.high:
            raise ValueError(f"low {self.low} is above high {self.high}")
        return self

    def row(self, dt_s: float, period_s: float, nominal: float = 0.0) -> SignalRow:
        """See :class:`SignalRow`."""
        width, ramp = self.high - self.low, self.ramp_s / dt_s
        return SignalRow(UNIFORM, self.low, width, ramp, self.ticks(dt_s), nominal)

    def reach(self, nominal: float = 0.0) -> tuple[float, float]:
        """The two ends; and the nominal value, from which the first ramp begins."""
        return self.with_ramp(self.low, self.high, nominal)


class Gaussian(_Drawn):
    """Drawn from a normal distribution, anew ``every_s``, or once per episode."""

    type: Literal["gaussian"] = "gaussian"
    std: NonNegative
    mean: Number | None = None  # None: the channel's nominal value

    def row(self, dt_s: float, period_s: float, nominal: float = 0.0) -> SignalRow:
        """See :class:`SignalRow`."""
        mean, ramp = _or(self.mean, nominal), self.ramp_s / dt_s
        return SignalRow(GAUSSIAN, mean, self.std, ramp, self.ticks(dt_s), nominal)

    def reach(self, nominal: float = 0.0) -> tuple[float, float]:
        """Mean ± 4 standard deviations; and the nominal value, from which the first ramp begins."""
        mean = _or(self.mean, nominal)
        return self.with_ramp(mean - TAILS * self.std, mean + TAILS * self.std, nominal)

    def is_bounded(self) -> bool:
        """Without noise."""
        return self.std == 0.0


class OrnsteinUhlenbeck(_Signal):
    """Stationary Gaussian noise with the autocorrelation exp(−|Δt| / ``time_constant_s``)."""

    type: Literal["ornstein_uhlenbeck"] = "ornstein_uhlenbeck"
    std: NonNegative
    time_constant_s: Positive
    mean: Number | None = None  # None: the channel's nominal value

    def row(self, dt_s: float, period_s: float, nominal: float = 0.0) -> SignalRow:
        """See :class:`SignalRow`."""
        return SignalRow(
            ORNSTEIN_UHLENBECK,
            _or(self.mean, nominal),
            self.std,
            math.exp(-period_s / self.time_constant_s),
            0.0,
        )

    def reach(self, nominal: float = 0.0) -> tuple[float, float]:
        """Mean ± 4 standard deviations."""
        mean = _or(self.mean, nominal)
        return mean - TAILS * self.std, mean + TAILS * self.std

    def is_bounded(self) -> bool:
        """Without noise."""
        return self.std == 0.0


class BandLimited(_Signal):
    """Smooth Gaussian noise: its autocorrelation falls to 1/e after ``correlation_s``.

    A cubic B-spline whose coefficients are drawn at equal distances, so it has continuous derivatives up to
    the second. Half of the power density at 0 Hz is left at 0.27/``correlation_s``, 1 % at
    0.66/``correlation_s``.
    """

    type: Literal["band_limited"] = "band_limited"
    std: NonNegative
    correlation_s: Positive
    mean: Number | None = None  # None: the channel's nominal value

    def row(self, dt_s: float, period_s: float, nominal: float = 0.0) -> SignalRow:
        """See :class:`SignalRow`; ``every`` are the ticks between two coefficients, no whole number."""
        ticks = self.correlation_s / (SPLINE_CORRELATION * dt_s)
        return SignalRow(
            BAND_LIMITED, _or(self.mean, nominal), self.std / SPLINE_STD, 0.0, max(ticks, 1.0)
        )

    def reach(self, nominal: float = 0.0) -> tuple[float, float]:
        """Mean ± 4 standard deviations."""
        mean = _or(self.mean, nominal)
        return mean - TAILS * self.std, mean + TAILS * self.std

    def is_bounded(self) -> bool:
        """Without noise."""
        return self.std == 0.0


class Pulses(_Signal):
    """``value`` for ``duration_s`` at a time drawn anew within every ``every_s``, ``rest`` otherwise."""

    type: Literal["pulses"] = "pulses"
    value: Number
    every_s: Positive
    duration_s: Positive
    rest: Number | None = None  # None: the channel's nominal value

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.duration_s > self.every_s:
            raise ValueError(f"duration_s {self.duration_s} must be at most every_s {self.every_s}")
        return self

    def row(self, dt_s: float, period_s: float, nominal: float = 0.0) -> SignalRow:
        """See :class:`SignalRow`; ``c`` are the ticks of a pulse."""
        every = max(1, round(self.every_s / dt_s))
        ticks = min(max(1, round(self.duration_s / dt_s)), every)
        return SignalRow(PULSES, self.value, _or(self.rest, nominal), float(ticks), float(every))

    def reach(self, nominal: float = 0.0) -> tuple[float, float]:
        """The two values."""
        rest = _or(self.rest, nominal)
        return min(self.value, rest), max(self.value, rest)


class RandomWalk(_Signal):
    """Sum of independent Gaussian steps: its standard deviation is ``per_sqrt_s`` · √t after t s.

    It has no bound, so it is clamped at the ends of the channel's range.
    """

    type: Literal["random_walk"] = "random_walk"
    per_sqrt_s: NonNegative
    start: Number | None = None  # None: the channel's nominal value

    def row(self, dt_s: float, period_s: float, nominal: float = 0.0) -> SignalRow:
        """See :class:`SignalRow`."""
        step = self.per_sqrt_s * math.sqrt(period_s)
        return SignalRow(RANDOM_WALK, _or(self.start, nominal), step, 0.0, 0.0)

    def reach(self, nominal: float = 0.0) -> tuple[float, float]:
        """Its start."""
        start = _or(self.start, nominal)
        return start, start

    def is_bounded(self) -> bool:
        """Without noise."""
        return self.per_sqrt_s == 0.0


Signal = Annotated[
    Constant
    | Step
    | Impulse
    | Sine
    | Uniform
    | Gaussian
    | OrnsteinUhlenbeck
    | BandLimited
    | RandomWalk
    | Pulses,
    Field(discriminator="type"),
]


@law
def is_due(row: SignalRow, tick: int, ticks: int) -> bool:
    """Whether a signal may have another value than it had ``ticks`` before."""
    if row.kind != UNIFORM and row.kind != GAUSSIAN:
        return row.kind != CONSTANT
    between = int(row.every)
    since = tick % between if between > 0 else tick
    if row.c > 0.0 and since < row.c + ticks:
        return True
    return between > 0 and since < ticks


@law
def random_draw(
    row: SignalRow, index: int, seed: int, channel: int, robot: int, episode: int
) -> float:
    """The draw number ``index`` of a uniform or Gaussian signal."""
    if row.kind == UNIFORM:
        word, _, _, _ = words(seed, channel, robot, episode, index)
        return row.a + row.b * unit(word)
    drawn, _ = normal_pair(seed, channel, robot, episode, index)
    return row.a + row.b * drawn


@law
def spline_noise(position: float, seed: int, channel: int, robot: int, episode: int) -> float:
    """Cubic B-spline with standard normal coefficients, at a position in distances between them."""
    first = int(position)
    u = position - first
    v = 1.0 - u
    c_0, _ = normal_pair(seed, channel, robot, episode, first)
    c_1, _ = normal_pair(seed, channel, robot, episode, first + 1)
    c_2, _ = normal_pair(seed, channel, robot, episode, first + 2)
    c_3, _ = normal_pair(seed, channel, robot, episode, first + 3)
    w_1 = 4.0 - 3.0 * u * u * (2.0 - u)
    w_2 = 4.0 - 3.0 * v * v * (2.0 - v)
    return (v * v * v * c_0 + w_1 * c_1 + w_2 * c_2 + u * u * u * c_3) / 6.0


@law
def signal_value(
    row: SignalRow,
    tick: int,
    dt: float,
    seed: int,
    channel: int,
    robot: int,
    episode: int,
    memory: float,
) -> tuple[float, float]:
    """A signal's value at a tick, and the memory of a random process.

    An Ornstein–Uhlenbeck process has unit variance there, a random walk unit steps.
    """
    kind = int(row.kind)
    if kind == CONSTANT:
        return row.a, memory
    time = tick * dt
    if kind == STEP:
        return (row.a if time >= row.b else row.c), memory
    if kind == IMPULSE:
        return (row.a if row.b <= time < row.b + row.every else row.c), memory
    if kind == SINE:
        phase = row.c
        if row.d > 0.0:
            word, _, _, _ = words(seed, channel, robot, episode, 0)
            phase += 2.0 * math.pi * unit(word)
        return row.every + row.a * math.sin(row.b * time + phase), memory
    if kind == BAND_LIMITED:
        noise = spline_noise(tick / row.every, seed, channel, robot, episode)
        return row.a + row.b * noise, memory
    if kind == ORNSTEIN_UHLENBECK:
        drawn, _ = normal_pair(seed, channel, robot, episode, tick)
        if tick == 0:
            memory = drawn
        else:
            memory = row.c * memory + math.sqrt(1.0 - row.c * row.c) * drawn
        return row.a + row.b * memory, memory
    if kind == PULSES:
        index = tick // int(row.every)
        word, _, _, _ = words(seed, channel, robot, episode, index)
        first = int(unit(word) * (row.every - row.c + 1.0))
        since = tick - index * int(row.every) - first
        return (row.a if 0 <= since < row.c else row.b), memory
    if kind == RANDOM_WALK:
        drawn, _ = normal_pair(seed, channel, robot, episode, tick)
        if tick > 0:
            memory += drawn
        return row.a + row.b * memory, memory
    index = tick // int(row.every) if row.every > 0.0 else 0
    value = random_draw(row, index, seed, channel, robot, episode)
    since = tick - index * int(row.every)
    if since < row.c:
        before = row.d
        if index > 0:
            before = random_draw(row, index - 1, seed, channel, robot, episode)
        value = before + since / row.c * (value - before)
    return value, memory
