"""The wheel loop excited by a pseudo-random binary reference, and the estimate of L from its data.

The digital wheel loop acts on the plant of the project; speeds are read from the plant, as in a co-simulation.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.signal import get_window, max_len_seq

from tlf_env.onboard.wheel_loop import WheelLoopParameters, digital_wheel_loop, wheel_torque
from tlf_env.physics.openloop import OpenLoopStart, advance_open_loop, initial_rows
from tlf_env.physics.units import MILLINEWTON_PER_NEWTON
from tlf_env.physics.vehicle import Motion, RobotParameters, body_array

PLANT_PERIOD_S = 0.001
LIMIT_NMM = 15.0  # footnote 4
REGISTER = 16  # bits of the shift register: a period of 65 535 samples
SEGMENT = 1024  # samples of a segment, with a Hann window and half overlap
FIRST_BIN = 6  # below, the window's leakage from the slow part dominates
OVERLAP_VARIANCE = (
    1.056  # of a mean of Hann segments that overlap by half, over that of separate ones
)
CONFIDENCE = 0.95


class Trial(NamedTuple):
    """One experiment."""

    period_s: float = 0.001  # of the digital K(s)
    delay: int = 0  # samples from a speed to the torque that it causes
    amplitude_rad_s: float = 0.02  # of the reference about its mean
    mean_rad_s: float = 6.0  # 300 mm/s
    joint_friction: bool = True
    noise_rad_s: float = 1e-3  # standard deviation of the speed's noise
    duration_s: float = 60.0
    settle_s: float = 4.0


class Data(NamedTuple):
    """Signals of an experiment, one value per sample of K(s)."""

    reference: np.ndarray  # ω*, rad/s
    output: np.ndarray  # measured ω, rad/s
    torque: np.ndarray  # N·mm, within the limit
    saturated: float  # share of the samples with the torque at its limit


class LoopEstimate(NamedTuple):
    """The loop by frequency, with its confidence region: circles in the plane of L."""

    omega: np.ndarray  # rad/s
    L: np.ndarray
    radius: np.ndarray  # of the region that has the value with 95 %
    coherence: np.ndarray  # of reference and output
    margin: float  # smallest |1 + L|
    margin_radius: float  # the region's radius there


def run_trial(trial: Trial, seed: int = 0) -> Data:
    """Excite both wheels of a robot that goes straight on; the output is the left wheel's speed."""
    robot = RobotParameters(joint_friction=trial.joint_friction)
    speed = trial.mean_rad_s * robot.wheel_radius_mm
    start = OpenLoopStart(
        forward_mm_s=speed,
        omega_l_rad_s=trial.mean_rad_s,
        omega_r_rad_s=trial.mean_rad_s,
        castor_spin_rad_s=speed / robot.castor_radius_mm,
    )
    bodies, push = body_array([robot]), np.zeros(3)
    motions, contacts = initial_rows(start, robot.com_offset_mm)
    places = [Motion._fields.index(name) for name in ("omega_l", "omega_r")]
    substeps = round(trial.period_s / PLANT_PERIOD_S)
    torques = np.zeros((substeps, 2))
    loop = digital_wheel_loop(WheelLoopParameters(), trial.period_s)
    limit = LIMIT_NMM * MILLINEWTON_PER_NEWTON

    settle = round(trial.settle_s / trial.period_s)
    count = settle + round(trial.duration_s / trial.period_s)
    bits = np.resize(max_len_seq(REGISTER)[0], count)
    reference = trial.mean_rad_s + trial.amplitude_rad_s * (2.0 * bits - 1.0)
    noise = trial.noise_rad_s * np.random.default_rng(seed).standard_normal((count, 2))
    output, torque = np.empty(count), np.empty(count)
    memory = [(0.0, 0.0), (0.0, 0.0)]  # integrator and lag of each wheel
    waiting = [np.zeros(2) for _ in range(trial.delay)]
    for k in range(count):
        wanted = np.empty(2)
        for wheel, place in enumerate(places):
            measured = motions[place, 0, 0] + noise[k, wheel]
            wanted[wheel], *states = wheel_torque(
                reference[k] - measured, *memory[wheel], loop, limit
            )
            memory[wheel] = (states[0], states[1])
            if wheel == 0:
                output[k], torque[k] = measured, wanted[0]
        waiting.append(wanted)
        torques[:] = waiting.pop(0)
        advance_open_loop(bodies, motions, contacts, torques, push, PLANT_PERIOD_S)
    torque /= MILLINEWTON_PER_NEWTON
    return Data(
        reference[settle:],
        output[settle:],
        torque[settle:],
        float(np.mean(np.abs(torque[settle:]) >= LIMIT_NMM)),
    )


def estimate(data: Data, period_s: float) -> LoopEstimate:
    """L = Φ_yr/Φ_er by averages over segments; r is the reference, e the error and y the output.

    The reference as an instrument keeps the estimate free of bias from the noise in e and y. The scatter of
    the segments about the estimate gives the radius of the confidence region of the complex value.
    """
    window = get_window("hann", SEGMENT)
    starts = range(0, len(data.output) - SEGMENT + 1, SEGMENT // 2)
    error = data.reference - data.output

    def spectra(signal: np.ndarray) -> np.ndarray:
        centred = signal - signal.mean()
        rows = np.stack([centred[k : k + SEGMENT] * window for k in starts])
        return np.asarray(np.fft.rfft(rows, axis=1)[:, FIRST_BIN:])

    R, E, Y = spectra(data.reference), spectra(error), spectra(data.output)
    cross_y, cross_e = (Y * R.conj()).sum(axis=0), (E * R.conj()).sum(axis=0)
    L = cross_y / cross_e
    scatter = (np.abs(Y - L * E) ** 2 * np.abs(R) ** 2).sum(axis=0)
    n = len(R)
    variance = OVERLAP_VARIANCE * n / (n - 1) * scatter / np.abs(cross_e) ** 2
    radius = np.sqrt(-math.log(1 - CONFIDENCE) * variance)
    coherence = np.abs(cross_y) ** 2 / ((np.abs(Y) ** 2).sum(axis=0) * (np.abs(R) ** 2).sum(axis=0))
    omega = 2 * np.pi * np.arange(FIRST_BIN, SEGMENT // 2 + 1) / (SEGMENT * period_s)
    k = int(np.argmin(np.abs(1 + L)))
    return LoopEstimate(omega, L, radius, coherence, float(np.abs(1 + L[k])), float(radius[k]))


def predicted_loop(period_s: float, delay: int, kappa: float, omega: np.ndarray) -> np.ndarray:
    """L(e^jωT) of K(z) and a torque that is held on κ/s: κT/(z − 1); ``kappa`` in rad/s² per N·mm."""
    loop = digital_wheel_loop(WheelLoopParameters(), period_s)
    z = np.exp(1j * omega * period_s)
    K = loop.gain + loop.integral_step * z / (z - 1) + loop.lag_step * z / (z - loop.lag_decay)
    return K / MILLINEWTON_PER_NEWTON * kappa * period_s / (z - 1) * z**-delay


def predicted_margin(period_s: float, delay: int, kappa: float) -> float:
    """Smallest |1 + L| up to the Nyquist frequency; NaN if the closed loop is unstable."""
    if not is_stable(period_s, delay, kappa):
        return math.nan
    omega = np.linspace(1e-4, np.pi, 40_001) / period_s
    return float(np.abs(1 + predicted_loop(period_s, delay, kappa, omega)).min())


def is_stable(period_s: float, delay: int, kappa: float) -> bool:
    """Whether all poles of the closed loop of :func:`predicted_loop` lie within the unit circle."""
    loop = digital_wheel_loop(WheelLoopParameters(), period_s)
    decay = loop.lag_decay
    numerator = (
        loop.gain * np.poly([1, decay])
        + loop.integral_step * np.poly([0, decay])
        + loop.lag_step * np.poly([0, 1])
    )
    denominator = np.poly([1, 1, decay] + [0] * delay)
    whole = np.polyadd(numerator * kappa * period_s / MILLINEWTON_PER_NEWTON, denominator)
    return bool(np.abs(np.roots(whole)).max() < 1)
