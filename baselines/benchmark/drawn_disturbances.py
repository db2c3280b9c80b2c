"""Random composite disturbances of the test set: many knobs at once, in shapes that no preset has."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from baselines.benchmark.draws import Draws, rounded

Channels = dict[str, dict[str, Any]]
RARE, FREQUENT = 0.12, 0.5  # probability of a knob in the easiest and in the hardest case
EASIEST, HARDEST = 0.15, 1.0  # level of a knob
LOW_GRIP = 0.42  # share of the friction, of a floor and of patches
LARGEST_JERKS = (110.0, 1.0)  # of a sine of slip: mm/s², rad/s²


class Level(NamedTuple):
    """How hard a case is, 0 to 1, and the draws of its knobs."""

    severity: float
    draws: Draws

    def on(self) -> bool:
        """Whether a knob is on."""
        return self.draws.chance(RARE + (FREQUENT - RARE) * self.severity)

    def of(self, easy: float, hard: float) -> float:
        """A knob's value between an easy and a hard one."""
        return rounded(easy + (hard - easy) * self._share())

    def log(self, easy: float, hard: float) -> float:
        """A knob's value, uniform in the logarithm."""
        return rounded(easy * (hard / easy) ** self._share())

    def _share(self) -> float:
        top = EASIEST + (HARDEST - EASIEST) * self.severity
        return top * math.sqrt(self.draws.unit())


def sine(draws: Draws, amplitude: float, most_rate: float) -> dict[str, Any]:
    """A sine of 0.05 to 1 Hz whose rate of change is bounded."""
    frequency = draws.log(0.05, 1.0)
    return {
        "type": "sine",
        "amplitude": rounded(min(amplitude, most_rate / (2 * math.pi * frequency))),
        "frequency_hz": frequency,
        "random_phase": True,
        "mean": rounded(amplitude * draws.pick((0.0, 0.0, 0.3, -0.3))),
    }


def wander(draws: Draws, amplitude: float, most_rate: float) -> dict[str, Any]:
    """An Ornstein–Uhlenbeck process."""
    return {
        "type": "ornstein_uhlenbeck",
        "std": rounded(amplitude / 2.2),
        "time_constant_s": draws.log(0.8, 12),
    }


def smooth(draws: Draws, amplitude: float, most_rate: float) -> dict[str, Any]:
    """Smooth noise whose rate of change is bounded."""
    time = draws.log(0.3, 6)
    return {
        "type": "band_limited",
        "std": rounded(min(amplitude / 2, most_rate * time / 2)),
        "correlation_s": time,
    }


def ramps(draws: Draws, amplitude: float, most_rate: float) -> dict[str, Any]:
    """Uniform draws at drawn times apart, each reached by a ramp of drawn length."""
    every = draws.log(1.2, 12)
    return {
        "type": "uniform",
        "low": -amplitude,
        "high": amplitude,
        "every_s": every,
        "ramp_s": rounded(every * draws.uniform(0.05, 1.0)),
    }


def pulses(draws: Draws, amplitude: float, most_rate: float) -> dict[str, Any]:
    """A pulse of drawn length at a random time within drawn intervals."""
    every = draws.log(4, 20)
    return {
        "type": "pulses",
        "value": rounded(amplitude * draws.pick((-0.8, 0.8))),
        "every_s": every,
        "duration_s": rounded(every * draws.uniform(0.05, 0.5)),
    }


def gaussian_steps(draws: Draws, amplitude: float, most_rate: float) -> dict[str, Any]:
    """Normal draws at drawn times apart, half of them with a ramp."""
    every = draws.log(1.2, 12)
    ramp = draws.uniform(0.02, 0.5)
    return {
        "type": "gaussian",
        "std": rounded(amplitude / 2.5),
        "every_s": every,
        "ramp_s": rounded(every * ramp) if draws.chance(0.5) else 0.0,
    }


Shape = Callable[[Draws, float, float], dict[str, Any]]
SLIP_SHAPES: Sequence[Shape] = (sine, wander, smooth, ramps, pulses, gaussian_steps)
PUSH_SHAPES: Sequence[Shape] = (wander, smooth, pulses)


def drawn_disturbance(draws: Draws, severity: float) -> Channels:
    """The channels of a composite disturbance, without patches.

    Parameters
    ----------
    severity
        0 to 1: how many knobs are on, and how far.
    """
    level = Level(severity, draws)
    channels: Channels = {}
    for part in (_slip, _floor, _position, _wheels_and_gyro, _motors, _rest):
        part(level, channels)
    return channels


def _slip(level: Level, channels: Channels) -> None:
    """Forward and yaw slip, of one shape each, and a second one under each wheel: a sum of two."""
    draws, slip = level.draws, channels.setdefault("slip", {})
    most_forward, most_yaw = LARGEST_JERKS
    if level.on():
        slip["delta_1_mm_s"] = draws.pick(SLIP_SHAPES)(draws, level.of(4, 80), most_forward)
    if level.on():
        slip["delta_2_rad_s"] = draws.pick(SLIP_SHAPES)(draws, level.of(0.02, 0.5), most_yaw)
    if level.on():
        for side in ("left_mm_s", "right_mm_s"):
            slip[side] = draws.pick(SLIP_SHAPES)(draws, level.of(2, 28), most_forward / 2)


def _floor(level: Level, channels: Channels) -> None:
    draws, floor, tyre = level.draws, {}, {}
    if level.on():
        tyre["friction_scale"] = level.of(0.95, LOW_GRIP)
    if level.on():
        tyre[draws.pick(("friction_left", "friction_right"))] = level.of(0.95, 0.6)
    if level.on():
        tyre["creep"] = level.of(0.02, 0.3)
    if level.on():
        floor["rolling_resistance"] = level.of(0.0005, 0.006)
    if level.on():
        floor["slope_rad"] = level.of(0.0005, 0.008)
        floor["uphill_rad"] = draws.angle()
    channels |= {"tyre": tyre, "floor": floor}


def _position(level: Level, channels: Channels) -> None:
    draws = level.draws
    position: dict[str, Any] = {}
    if level.on():
        position["noise_std_mm"] = level.log(0.5, 5)
    if level.on():
        position["period_s"] = level.log(0.004, 0.2)
    if level.on():
        position["delay_s"] = level.log(0.003, 0.15)
    if level.on():
        every = draws.log(5, 25)
        position["outage"] = {
            "type": "pulses",
            "value": 1.0,
            "every_s": every,
            "duration_s": rounded(min(level.log(0.1, 3), every / 2)),
        }
    elif level.on():
        position["outage"] = level.log(0.01, 0.5)
    if level.on():
        position["outlier_share"] = level.log(0.001, 0.05)
        position["outlier_std_mm"] = level.log(5, 100)
    if level.on():
        time = draws.log(1, 20)
        for axis in ("bias_x_mm", "bias_y_mm"):
            position[axis] = {
                "type": "ornstein_uhlenbeck",
                "std": level.log(0.3, 5),
                "time_constant_s": time,
            }
    channels["position"] = position


def _wheels_and_gyro(level: Level, channels: Channels) -> None:
    draws = level.draws
    encoder: dict[str, Any] = {}
    gyro: dict[str, Any] = {}
    calibration: dict[str, Any] = {}
    if level.on():
        encoder["quantum_rad"] = level.log(2 * math.pi / 16_384, 2 * math.pi / 1000)
    if level.on():
        encoder["noise_std_rad"] = level.log(2e-5, 5e-4)
    if draws.chance(0.7):  # without it the gyro is exact
        gyro = {
            "noise_rad_s_sqrt_hz": level.log(2e-5, 1e-3),
            "bias_rad_s": {
                "type": "random_walk",
                "per_sqrt_s": level.log(1e-6, 1e-3),
                "start": rounded(level.of(0.0, 0.01) * draws.pick((-1, 1))),
            },
            "scale": _around(1.0, level.of(0.002, 0.04)),
        }
    if level.on():
        radius, track = level.log(0.0005, 0.007), level.log(0.002, 0.02)
        calibration = {
            "radius_left": _around(1.0, radius),
            "radius_right": _around(1.0, radius),
            "track": _around(1.0, track),
        }
    channels |= {"encoder": encoder, "gyro": gyro, "calibration": calibration}


def _motors(level: Level, channels: Channels) -> None:
    actuator: dict[str, Any] = {}
    if level.on():
        spread = level.of(0.01, 0.12)
        for side in ("torque_gain_l", "torque_gain_r"):
            actuator[side] = _around(1.0, spread)
    if level.on():
        actuator["dead_time_s"] = level.of(0.001, 0.006)
    if level.on():
        actuator["computing_delay_s"] = level.of(0.001, 0.018)
    if level.on():
        actuator["back_emf_s_rad"] = level.of(0.002, 0.03)
        actuator["stall_torque"] = level.of(2.2, 1.5)
    if level.on():
        actuator["dead_band_Nmm"] = level.of(0.1, 2.0)
    if level.on():
        actuator["current_limit"] = level.of(1.0, 0.8)
    channels["actuator"] = actuator


def _rest(level: Level, channels: Channels) -> None:
    """Radio, payload, pushes and start."""
    draws = level.draws
    radio: dict[str, Any] = {}
    if level.on():
        radio["dropout"] = level.log(0.01, 0.5)
    if level.on():
        radio["jitter_s"] = level.log(0.01, 0.25)
    payload: dict[str, Any] = {}
    if level.on():
        heavy = level.of(0.02, 0.28)
        payload = {
            "mass_kg": {"type": "uniform", "low": rounded(0.6 * heavy), "high": heavy},
            "behind_mm": {"type": "uniform", "low": -10.0, "high": 40.0},
            "inertia_kg_mm2": rounded(1200 * heavy),
        }
    push: dict[str, Any] = {}
    if level.on():
        for axis in ("x_N", "y_N"):
            push[axis] = draws.pick(PUSH_SHAPES)(draws, level.of(0.005, 0.1), math.inf)
        push["torque_Nmm"] = draws.pick(PUSH_SHAPES)(draws, level.of(0.3, 5.0), math.inf)
    start: dict[str, Any] = {}
    if level.on():
        start = {"position_std_mm": level.of(5, 100), "heading_std_rad": level.of(0.02, 0.4)}
    channels |= {"radio": radio, "payload": payload, "push": push, "start": start}


def _around(middle: float, spread: float) -> dict[str, Any]:
    """Drawn per robot and episode, uniform around a value."""
    return {
        "type": "uniform",
        "low": rounded(middle - spread, 6),
        "high": rounded(middle + spread, 6),
    }


def with_patches(
    draws: Draws, severity: float, path: np.ndarray, use: np.ndarray
) -> list[dict[str, float]]:
    """Slippery patches on a path, none in most cases.

    Parameters
    ----------
    path
        Places on it, ``(place, 2)``, mm.
    use
        Share of the grip that the motion needs at each place; a patch leaves enough grip for it.
    """
    level = Level(severity, draws)
    if not level.on():
        return []
    patches = []
    for _ in range(draws.whole(1, 3)):
        k, radius = draws.whole(0, len(path) - 1), draws.uniform(90, 300)
        near = np.hypot(*(path - path[k]).T) < radius + 150
        needed = float(use[near].max())
        patches.append(
            {
                "x_mm": round(float(path[k, 0]), 1),
                "y_mm": round(float(path[k, 1]), 1),
                "radius_mm": radius,
                "friction_scale": rounded(min(max(level.of(0.9, 0.25), needed), 1.0)),
            }
        )
    return patches


def load_of(channels: Channels) -> dict[str, float]:
    """What a disturbance takes from the motors, at its worst as far as it is known.

    Returns
    -------
    dict
        ``mass_kg``, ``inertia_kg_mm2`` and ``behind_mm`` of the payload; ``force_N`` along and
        ``torque_Nmm`` about the robot; ``acceleration_mm_s2`` and ``yaw_acceleration_rad_s2`` of slip to be
        made up for; ``weight``, the force of floor and slope over the robot's weight; and of the motors
        ``motors`` (share of the torque that is delivered), ``dead_band_Nmm``, ``back_emf_s_rad`` and
        ``stall_torque``.
    """
    actuator, payload, floor = (channels[name] for name in ("actuator", "payload", "floor"))
    gains = [
        actuator[name]["low"] if name in actuator else 1.0
        for name in ("torque_gain_l", "torque_gain_r")
    ]
    push, slip = channels["push"], channels["slip"]
    sides = [_rate(slip[name]) for name in ("left_mm_s", "right_mm_s") if name in slip]
    return {
        "mass_kg": payload["mass_kg"]["high"] if payload else 0.0,
        "inertia_kg_mm2": payload.get("inertia_kg_mm2", 0.0),
        "behind_mm": payload["behind_mm"]["high"] if payload else 0.0,
        "force_N": max((_size(push[name]) for name in ("x_N", "y_N") if name in push), default=0.0),
        "torque_Nmm": _size(push["torque_Nmm"]) if push else 0.0,
        "acceleration_mm_s2": _rate(slip.get("delta_1_mm_s")) + max(sides, default=0.0),
        "yaw_acceleration_rad_s2": _rate(slip.get("delta_2_rad_s")),
        "weight": floor.get("rolling_resistance", 0.0) + floor.get("slope_rad", 0.0),
        "motors": min(gains) * actuator.get("current_limit", 1.0),
        "dead_band_Nmm": actuator.get("dead_band_Nmm", 0.0),
        "back_emf_s_rad": actuator.get("back_emf_s_rad", 0.0),
        "stall_torque": actuator.get("stall_torque", 1.0),
    }


def _size(signal: dict[str, Any]) -> float:
    """About the largest usual value: two standard deviations of noise."""
    kind = signal["type"]
    return abs(signal["value"]) if kind == "pulses" else 2 * signal["std"]


def _rate(signal: dict[str, Any] | None) -> float:
    """About the usual rate of change of a lasting motion; 0 for single steps, which pass."""
    if signal is None:
        return 0.0
    if signal["type"] == "sine":
        return 2 * math.pi * signal["amplitude"] * signal["frequency_hz"]
    if signal["type"] == "band_limited":
        return 1.5 * signal["std"] / signal["correlation_s"]
    return 0.0
