"""The disturbance of a scenario: a signal per channel, friction patches, and one level.

The level multiplies each channel's deviation from nominal; at 0 a run is the nominal run, bit for bit.
Nominal is the paper's: noise of the position fixes of 0.2 mm² variance and nothing else.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, NamedTuple, Self

import numpy as np
from pydantic import BaseModel, BeforeValidator, model_validator
from pydantic_core import PydanticCustomError

from tlf_env.common.models import Frozen, NonNegative, is_number
from tlf_env.disturbances.channels import CHANNELS, PATHS, SUBSTEP, number, numbers
from tlf_env.disturbances.signals import Constant, Signal
from tlf_env.numerics.compiled import law
from tlf_env.physics.vehicle import Body, Motion
from tlf_env.physics.world import Patch


def _plain_number(value: Any) -> Any:
    if is_number(value):
        return {"type": "constant", "value": value}
    if not isinstance(value, Mapping | BaseModel):
        raise PydanticCustomError("signal_type", "Input should be a number or a signal, a mapping")
    return value


ChannelSignal = Annotated[Signal, BeforeValidator(_plain_number)]


def _nominal(path: str) -> Constant:
    return Constant(value=CHANNELS[number(path)].nominal)


class SlipChannels(Frozen):
    """Slip of eq. (14), injected under the drive wheels."""

    delta_1_mm_s: ChannelSignal = _nominal("slip.delta_1_mm_s")
    delta_2_rad_s: ChannelSignal = _nominal("slip.delta_2_rad_s")
    left_mm_s: ChannelSignal = _nominal("slip.left_mm_s")
    right_mm_s: ChannelSignal = _nominal("slip.right_mm_s")


class TyreChannels(Frozen):
    """Friction of the tyres, everywhere and on patches of the floor."""

    friction_scale: ChannelSignal = _nominal("tyre.friction_scale")
    friction_left: ChannelSignal = _nominal("tyre.friction_left")
    friction_right: ChannelSignal = _nominal("tyre.friction_right")
    creep: ChannelSignal = _nominal("tyre.creep")
    patches: tuple[Patch, ...] = ()


class FloorChannels(Frozen):
    """The floor: its slope, and the resistance to rolling on it."""

    rolling_resistance: ChannelSignal = _nominal("floor.rolling_resistance")
    slope_rad: ChannelSignal = _nominal("floor.slope_rad")
    uphill_rad: ChannelSignal = _nominal("floor.uphill_rad")


class PushChannels(Frozen):
    """Forces from outside, in world axes."""

    x_N: ChannelSignal = _nominal("push.x_N")
    y_N: ChannelSignal = _nominal("push.y_N")
    torque_Nmm: ChannelSignal = _nominal("push.torque_Nmm")


class PositionChannels(Frozen):
    """Position fixes."""

    bias_x_mm: ChannelSignal = _nominal("position.bias_x_mm")
    bias_y_mm: ChannelSignal = _nominal("position.bias_y_mm")
    noise_std_mm: ChannelSignal = _nominal("position.noise_std_mm")
    period_s: ChannelSignal = _nominal("position.period_s")
    delay_s: ChannelSignal = _nominal("position.delay_s")
    outage: ChannelSignal = _nominal("position.outage")
    outlier_share: ChannelSignal = _nominal("position.outlier_share")
    outlier_std_mm: ChannelSignal = _nominal("position.outlier_std_mm")


class EncoderChannels(Frozen):
    """Wheel encoders."""

    noise_std_rad: ChannelSignal = _nominal("encoder.noise_std_rad")
    quantum_rad: ChannelSignal = _nominal("encoder.quantum_rad")


class GyroChannels(Frozen):
    """A gyro that measures the yaw rate."""

    bias_rad_s: ChannelSignal = _nominal("gyro.bias_rad_s")
    scale: ChannelSignal = _nominal("gyro.scale")
    noise_rad_s_sqrt_hz: ChannelSignal = _nominal("gyro.noise_rad_s_sqrt_hz")


class CalibrationChannels(Frozen):
    """What a robot's computer believes of its wheels, over the truth."""

    radius_left: ChannelSignal = _nominal("calibration.radius_left")
    radius_right: ChannelSignal = _nominal("calibration.radius_right")
    track: ChannelSignal = _nominal("calibration.track")


class ActuatorChannels(Frozen):
    """Motors and the computer that drives them."""

    torque_gain_l: ChannelSignal = _nominal("actuator.torque_gain_l")
    torque_gain_r: ChannelSignal = _nominal("actuator.torque_gain_r")
    dead_time_s: ChannelSignal = _nominal("actuator.dead_time_s")
    computing_delay_s: ChannelSignal = _nominal("actuator.computing_delay_s")
    back_emf_s_rad: ChannelSignal = _nominal("actuator.back_emf_s_rad")
    dead_band_Nmm: ChannelSignal = _nominal("actuator.dead_band_Nmm")
    current_limit: ChannelSignal = _nominal("actuator.current_limit")
    stall_torque: ChannelSignal = _nominal("actuator.stall_torque")


class RadioChannels(Frozen):
    """Messages from a predecessor."""

    jitter_s: ChannelSignal = _nominal("radio.jitter_s")
    dropout: ChannelSignal = _nominal("radio.dropout")


class PayloadChannels(Frozen):
    """A load on the chassis, which the controllers do not take into account."""

    mass_kg: ChannelSignal = _nominal("payload.mass_kg")
    behind_mm: ChannelSignal = _nominal("payload.behind_mm")
    inertia_kg_mm2: ChannelSignal = _nominal("payload.inertia_kg_mm2")


class StartChannels(Frozen):
    """Scatter of the start poses; redrawn where outlines would overlap."""

    position_std_mm: ChannelSignal = _nominal("start.position_std_mm")
    heading_std_rad: ChannelSignal = _nominal("start.heading_std_rad")


class Disturbance(Frozen):
    """All channels; the defaults are nominal."""

    name: str = "custom"
    level: NonNegative = 1.0
    slip: SlipChannels = SlipChannels()
    tyre: TyreChannels = TyreChannels()
    floor: FloorChannels = FloorChannels()
    push: PushChannels = PushChannels()
    position: PositionChannels = PositionChannels()
    encoder: EncoderChannels = EncoderChannels()
    gyro: GyroChannels = GyroChannels()
    calibration: CalibrationChannels = CalibrationChannels()
    actuator: ActuatorChannels = ActuatorChannels()
    radio: RadioChannels = RadioChannels()
    payload: PayloadChannels = PayloadChannels()
    start: StartChannels = StartChannels()

    def signal(self, path: str) -> Signal:
        """The signal of a channel."""
        group, name = path.split(".")
        return getattr(getattr(self, group), name)

    def constant(self, path: str) -> float | None:
        """The value that a channel always has, the level in it; None where it varies or is drawn."""
        signal = self.signal(path)
        if not isinstance(signal, Constant):
            return None
        return leveled(CHANNELS[number(path)].nominal, signal.value, self.level)

    @model_validator(mode="after")
    def _check_ranges(self) -> Self:
        for channel in CHANNELS:
            for end in self.signal(channel.path).reach(channel.nominal):
                value = leveled(channel.nominal, end, self.level)
                if not channel.low <= value <= channel.high:
                    raise ValueError(
                        f"{channel.path} reaches {float(f'{value:.6g}')} at level {self.level}; "
                        f"allowed is {channel.low:g} to {channel.high:g}"
                    )
        for patch in self.tyre.patches:
            if leveled(1.0, patch.friction_scale, self.level) < 0:
                raise ValueError(
                    f"tyre.patches: friction_scale {patch.friction_scale:g} at level {self.level:g} "
                    "is below 0"
                )
        return self


class PatchRow(NamedTuple):
    """A patch as the compiled law takes it."""

    x: float
    y: float
    radius: float
    scale: float


def leveled(nominal: float, value: float, level: float) -> float:
    """A channel's value with the level on its deviation from nominal."""
    return nominal + level * (value - nominal)


def signal_rows(disturbance: Disturbance, dt_s: float, control_period_s: float) -> np.ndarray:
    """The compiled signals, (channel, :class:`~tlf_env.disturbances.signals.SignalRow`)."""
    return np.array(
        [
            disturbance.signal(channel.path).row(
                dt_s, dt_s if channel.rate == SUBSTEP else control_period_s, channel.nominal
            )
            for channel in CHANNELS
        ]
    )


def patch_rows(disturbance: Disturbance, floor: Sequence[Patch] = ()) -> np.ndarray:
    """The compiled patches, (patch, :class:`PatchRow`): the disturbance's, then those of the world's floor.

    The disturbance's level acts on its own patches only: on their deviation from 1.
    """
    rows = [
        PatchRow(p.x_mm, p.y_mm, p.radius_mm, leveled(1.0, p.friction_scale, level))
        for patches, level in ((disturbance.tyre.patches, disturbance.level), (floor, 1.0))
        for p in patches
    ]
    return np.array(rows, dtype=np.float64).reshape(-1, len(PatchRow._fields))


def changing_channels(disturbances: Sequence[Disturbance], all_of_them: bool) -> np.ndarray:
    """Places of the channels of every substep that vary while an episode runs, in some disturbance; or all."""
    return np.array(
        [
            i
            for i in numbers(SUBSTEP)
            if all_of_them or not all(one.signal(PATHS[i]).is_steady() for one in disturbances)
        ],
        dtype=np.int64,
    )


def changes_within_episode(disturbance: Disturbance) -> bool:
    """Whether a channel of every substep varies while an episode runs."""
    return len(changing_channels([disturbance], False)) > 0


@law
def patch_factor(patches: np.ndarray, x: float, y: float) -> float:
    """Product of the friction factors of the patches that a point (mm) lies on."""
    factor = 1.0
    for i in range(patches.shape[0]):
        d_x, d_y = x - patches[i, 0], y - patches[i, 1]
        if d_x * d_x + d_y * d_y <= patches[i, 2] * patches[i, 2]:
            factor *= patches[i, 3]
    return factor


@law
def wheel_factors(patches: np.ndarray, robot: Body, motion: Motion) -> tuple[float, float, float]:
    """Friction factors of the patches under the left, right and castor wheel."""
    sin, cos = math.sin(motion.theta), math.cos(motion.theta)
    c_x, c_y = motion.x - robot.d * sin, motion.y + robot.d * cos
    trail = robot.T
    pivot_x, pivot_y = motion.x + robot.q * sin, motion.y - robot.q * cos
    castor_x = pivot_x + trail * math.sin(motion.psi)
    castor_y = pivot_y - trail * math.cos(motion.psi)
    return (
        patch_factor(patches, c_x - robot.h * cos, c_y - robot.h * sin),
        patch_factor(patches, c_x + robot.h * cos, c_y + robot.h * sin),
        patch_factor(patches, castor_x, castor_y),
    )
