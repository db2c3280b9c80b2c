"""Signals over time that drive a disturbance's channels. Times in s, values in the channel's unit."""

from __future__ import annotations

import math
from typing import Annotated, Literal, NamedTuple, Self

from pydantic import Field, model_validator

from tlf_env.common.models import Frozen, NonNegative, Number, Positive
from tlf_env.numerics.compiled import law
from tlf_env.numerics.philox import normal_pair, unit, words

CONSTANT, STEP, IMPULSE, SINE, UNIFORM, GAUSSIAN, ORNSTEIN_UHLENBECK = range(7)
TAILS = 4.0  # standard deviations that count as reachable when a range is checked


class SignalRow(NamedTuple):
    """A signal as the compiled law takes it; what a to d mean depends on the kind."""

    kind: float
    a: float
    b: float
    c: float
    every: float  # ticks between draws; 0: one draw per episode


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
    """``mean`` + ``amplitude`` · sin(2π ``frequency_hz`` t + ``phase_rad``)."""

    type: Literal["sine"] = "sine"
    amplitude: Number
    frequency_hz: Positive
    phase_rad: Number = 0.0
    mean: Number | None = None  # None: the channel's nominal value

    def row(self, dt_s: float, period_s: float, nominal: float = 0.0) -> SignalRow:
        """See :class:`SignalRow`; the mean travels in ``every``."""
        rate = 2 * math.pi * self.frequency_hz
        return SignalRow(SINE, self.amplitude, rate, self.phase_rad, _or(self.mean, nominal))

    def reach(self, nominal: float = 0.0) -> tuple[float, float]:
        """Mean ± amplitude."""
        mean = _or(self.mean, nominal)
        return mean - abs(self.amplitude), mean + abs(self.amplitude)


class _Drawn(_Signal):
    every_s: Positive | None = None  # None: one draw for the whole episode

    def is_steady(self) -> bool:
        """If there is one draw per episode."""
        return self.every_s is None

    def ticks(self, dt_s: float) -> float:
        """Ticks between draws, 0 for one draw per episode, at least 1."""
        return 0.0 if self.every_s is None else float(max(1, round(self.every_s / dt_s)))


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
        return SignalRow(UNIFORM, self.low, self.high - self.low, 0.0, self.ticks(dt_s))

    def reach(self, nominal: float = 0.0) -> tuple[float, float]:
        """The two ends."""
        return self.low, self.high


class Gaussian(_Drawn):
    """Drawn from a normal distribution, anew ``every_s``, or once per episode."""

    type: Literal["gaussian"] = "gaussian"
    std: NonNegative
    mean: Number | None = None  # None: the channel's nominal value

    def row(self, dt_s: float, period_s: float, nominal: float = 0.0) -> SignalRow:
        """See :class:`SignalRow`."""
        return SignalRow(GAUSSIAN, _or(self.mean, nominal), self.std, 0.0, self.ticks(dt_s))

    def reach(self, nominal: float = 0.0) -> tuple[float, float]:
        """Mean ± 4 standard deviations."""
        mean = _or(self.mean, nominal)
        return mean - TAILS * self.std, mean + TAILS * self.std


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


Signal = Annotated[
    Constant | Step | Impulse | Sine | Uniform | Gaussian | OrnsteinUhlenbeck,
    Field(discriminator="type"),
]


@law
def is_due(kind: float, every: float, tick: int, ticks: int) -> bool:
    """Whether a signal may have another value than it had ``ticks`` before."""
    if kind != UNIFORM and kind != GAUSSIAN:
        return kind != CONSTANT
    between = int(every)
    return between > 0 and tick // between != (tick - ticks) // between


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
    """A signal's value at a tick, and what an Ornstein–Uhlenbeck process remembers (unit variance)."""
    kind = int(row.kind)
    if kind == CONSTANT:
        return row.a, memory
    time = tick * dt
    if kind == STEP:
        return (row.a if time >= row.b else row.c), memory
    if kind == IMPULSE:
        return (row.a if row.b <= time < row.b + row.every else row.c), memory
    if kind == SINE:
        return row.every + row.a * math.sin(row.b * time + row.c), memory
    if kind == ORNSTEIN_UHLENBECK:
        drawn, _ = normal_pair(seed, channel, robot, episode, tick)
        if tick == 0:
            memory = drawn
        else:
            memory = row.c * memory + math.sqrt(1.0 - row.c * row.c) * drawn
        return row.a + row.b * memory, memory
    index = tick // int(row.every) if row.every > 0.0 else 0
    if kind == UNIFORM:
        word, _, _, _ = words(seed, channel, robot, episode, index)
        return row.a + row.b * unit(word), memory
    drawn, _ = normal_pair(seed, channel, robot, episode, index)
    return row.a + row.b * drawn, memory
