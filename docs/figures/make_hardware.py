"""What real sensors and motors do to the entries of the board, and a picture of their presets.

Writes the table of ``docs/hardware.md`` and ``docs/images/hardware.png``. ``python
docs/figures/make_hardware.py`` drives 16 seeds of each cell for 60 s on the batch plant; it takes some minutes
and needs the extra ``figures``. ``--seeds N`` drives fewer, 0 none.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from make_board import DOCS
from make_limits import ENTRIES, SMOOTH, arguments, renew
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from baselines.policies.registry import fit_policy
from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from baselines.runs.style import GREY, METADATA, hex_colour, tidy
from tlf_env.common.files import atomic
from tlf_env.disturbances.channels import nominal_effects
from tlf_env.engine.formation import Formation
from tlf_env.engine.layout import Sample
from tlf_env.engine.substeps import motor_torque
from tlf_env.physics.parameters import RobotParameters
from tlf_env.task.scenario import load_scenario

PICTURE = DOCS / "images" / "hardware.png"
DPI = 110

# The motor of the preset `motor`, and its driver: docs/hardware.md.
NO_LOAD_RAD_S, STALL_Nmm = 450 * 2 * math.pi / 60, 2.9 * 9.80665
LIMIT_Nmm = RobotParameters().torque_limit_Nmm
FIXES = {
    "fixes-100hz": 7.0,
    "fixes-camera": 55.0,
    "fixes-uwb": 550.0,
}  # and where to write its name


def observed(bandwidth_rad_s: float) -> dict[str, Any]:
    """A velocity observer in the wheel loop."""
    return {"wheel_loop": {"speed_observer_rad_s": bandwidth_rad_s}}


ROWS: dict[str, dict[str, Any]] = {
    "`nominal`": {"disturbance": "nominal"},
    "`nominal`, observer of 80 rad/s": {"disturbance": "nominal"} | observed(80.0),
    "`motor`": {"disturbance": "motor"},
    "`encoders-4096`, observer of 80 rad/s": {"disturbance": "encoders-4096"} | observed(80.0),
    "`encoders-1024`, observer of 80 rad/s": {"disturbance": "encoders-1024"} | observed(80.0),
    "`fixes-100hz`": {"disturbance": "fixes-100hz"},
    "`fixes-camera`": {"disturbance": "fixes-camera"},
    "`fixes-outage`": {"disturbance": "fixes-outage"},
    "`fixes-uwb`": {"disturbance": "fixes-uwb"},
    "`calibration`": {"disturbance": "calibration"},
    "`hardware`, observer of 80 rad/s": {"disturbance": "hardware"} | observed(80.0),
}


def draw_motor(axes: Axes) -> None:
    """Torque against speed: the data sheet, and the preset, with the driver's limit."""
    signal = load_scenario(disturbance="motor").disturbance.signal
    effects = nominal_effects()._replace(
        actuator_back_emf_s_rad=signal("actuator.back_emf_s_rad").value,
        actuator_dead_band_Nmm=signal("actuator.dead_band_Nmm").value,
        actuator_stall_torque=signal("actuator.stall_torque").value,
    )
    omega = np.linspace(0.0, NO_LOAD_RAD_S, 200)
    sheet = STALL_Nmm * (1 - omega / NO_LOAD_RAD_S)
    preset = [motor_torque(1e3 * LIMIT_Nmm, one, 1e3 * LIMIT_Nmm, effects) / 1e3 for one in omega]
    axes.plot(omega, sheet, "--", color=GREY, lw=1.0, label="data sheet, 6 V")
    axes.plot(omega, preset, color=hex_colour(0, 3), lw=1.6, label="preset motor")
    axes.axvspan(0.0, 11.2, color=GREY, alpha=0.12, lw=0.0)
    axes.text(0.6, 1.0, "the ∞", color=GREY)
    axes.set(xlabel="wheel speed, rad/s", ylabel="largest torque, N·mm", xlim=(0, 50), ylim=(0, 30))
    axes.legend(frameon=False)


def draw_fixes(axes: Axes) -> None:
    """Distance of the newest fix from the place where the robot is now, on the ∞."""
    fields = {"estimator": "truth", "robots": 1, "horizon_s": 20.0, **SMOOTH}
    places = [Sample._fields.index(name) for name in ("fix_x", "fix_y")]
    for i, (name, above_mm) in enumerate(FIXES.items()):
        scenario = load_scenario("infinity", disturbance=name, end_on=(), **fields)
        fitted = fit_policy("reference:tuned", scenario)
        formation = Formation(load_scenario(fitted.scenario, estimator="truth"))
        formation.reset(0)
        a, apart = formation.arrays, []
        for _ in range(round(20.0 / scenario.control_period_s)):
            a.actions[0] = fitted.policy.predict(a.observations[0])[0]
            formation.step()
            apart.append(np.hypot(*(a.samples[-1, places, 0, 0] - formation.state()[0, :2])))
        t_s = scenario.control_period_s * np.arange(1, len(apart) + 1)
        shown = t_s >= 10.0
        axes.semilogy(t_s[shown], np.array(apart)[shown], color=hex_colour(i, 3), lw=0.9)
        axes.text(13.0, above_mm, name, color=hex_colour(i, 3))
    axes.set(xlabel="time, s", ylabel="newest fix from the robot, mm", ylim=(0.3, 2000))


def allan_deviation(rates: np.ndarray, period_s: float, steps: np.ndarray) -> np.ndarray:
    """Overlapping Allan deviation of columns of rates, for averages over so many steps."""
    angles = np.concatenate([np.zeros((1, rates.shape[1])), np.cumsum(rates, axis=0)]) * period_s
    variances = []
    for n in steps:
        second = angles[2 * n :] - 2 * angles[n:-n] + angles[: -2 * n]
        variances.append((second**2).mean(axis=0) / (2 * (n * period_s) ** 2))
    return np.sqrt(variances)


def draw_gyro(axes: Axes, duration_s: float = 1200.0) -> None:
    """Allan deviation of three gyros at rest, beside its two parts and the data sheet's minimum."""
    scenario = load_scenario("infinity", disturbance="gyro", end_on=(), horizon_s=duration_s)
    formation = Formation(scenario)
    formation.reset(0)
    a, place = formation.arrays, Sample._fields.index("gyro")
    a.actions[:] = 0.0
    rates = np.empty((round(duration_s / scenario.control_period_s), 3))
    for k in range(len(rates)):
        formation.step()
        rates[k] = a.samples[:, place, :, 0].mean(axis=0)
    signal = scenario.disturbance.signal
    white, walk = signal("gyro.noise_rad_s_sqrt_hz").value, signal("gyro.bias_rad_s").per_sqrt_s
    steps = np.unique(np.logspace(0, math.log10(len(rates) / 6), 40).astype(int))
    tau_s = steps * scenario.control_period_s
    found = allan_deviation(rates, scenario.control_period_s, steps)
    for i in range(3):
        label = "gyros of three robots" if i == 0 else None
        axes.loglog(tau_s, found[:, i], color=hex_colour(0, 3), lw=0.9, alpha=0.7, label=label)
    axes.loglog(tau_s, white / np.sqrt(tau_s), "--", color=GREY, lw=1.0, label="white noise")
    axes.loglog(tau_s, walk * np.sqrt(tau_s / 3), ":", color=GREY, lw=1.2, label="walk of the bias")
    axes.axhline(math.radians(4.6) / 3600, color=hex_colour(1, 3), lw=1.2, label="4.6 °/h")
    axes.set(xlabel="averaging time, s", ylabel="Allan deviation, rad/s")
    axes.legend(frameon=False)


def picture() -> Figure:
    """The torque–speed curve, fixes on the ∞, and the Allan deviation of the gyro."""
    figure = Figure(figsize=(11.5, 3.6), layout="constrained", facecolor="white")
    left, middle, right = figure.subplots(1, 3)
    draw_motor(left)
    draw_fixes(middle)
    draw_gyro(right)
    tidy(left, middle, right)
    return figure


def main() -> None:
    """Drive and write the table, and draw."""
    options = arguments(__doc__).parse_args()
    if options.seeds:
        seeds = range(FIRST_TABLE_SEED, FIRST_TABLE_SEED + options.seeds)
        rows = {name: SMOOTH | fields for name, fields in ROWS.items()}
        renew(DOCS / "hardware.md", "presets", rows, seeds, options.entry or ENTRIES)
    with atomic(PICTURE, "wb") as file:
        picture().savefig(file, format="png", dpi=DPI, metadata=METADATA.get("png"))


if __name__ == "__main__":
    main()
