"""Pictures of the robots themselves: motors, sensors, bodies, radio. Laws are dashed, the rest simulated."""

from __future__ import annotations

import math

import numpy as np
from family_runs import (
    FREE,
    LAW,
    ROBOT,
    SEED,
    STYLES,
    Torques,
    drawn,
    legend,
    open_loop,
    panels,
    sampled,
    times,
)
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

from baselines.runs.bodies import body_polygons
from baselines.runs.run import run_policy
from baselines.runs.style import MARKERS
from tlf_env import BatchPlant
from tlf_env.engine.layout import Sample
from tlf_env.engine.radio import lateness
from tlf_env.engine.settings import make_settings
from tlf_env.task.info import Info
from tlf_env.task.scenario import load_scenario
from tlf_env.task.warn import without_warnings

# --- motors --------------------------------------------------------------------------------------


def lifted_speeds(actuator: dict[str, float], share: float, seconds: float) -> np.ndarray:
    """Speed of a lifted left wheel in every substep after a torque is commanded, rad/s."""
    disturbance = {"tyre": {"friction_scale": 0.0}, "actuator": actuator}
    t_s, (steps,) = sampled(
        seconds, (share, share), "step_l", action="torque", robot=FREE, disturbance=disturbance
    )
    return steps / t_s[0]


def draw_motors(figure: Figure) -> None:
    """Torque gains, dead band, limits, torque-speed curve, delays."""
    names = (
        "Delivered against commanded torque",
        "Torque–speed curve at full command, 0.025 s/rad",
        "Delays: speed of a lifted wheel, torque commanded at 0",
        "Torque gains (actuator), 40 episodes of three robots",
    )
    gain, curve, delay, gains = panels(figure, names)
    limit = ROBOT.torque_limit_Nmm
    cases = {
        "nominal": {},
        "torque_gain_l 0.8": {"torque_gain_l": 0.8},
        "dead_band_Nmm 3": {"dead_band_Nmm": 3.0},
        "current_limit 0.7": {"current_limit": 0.7},
    }
    for style, (label, fields) in zip(STYLES, cases.items(), strict=True):
        record = open_loop(
            lambda t_s: (0.1 * t_s - 1.0, 0.0), 20.0, disturbance={"actuator": fields}
        )
        commanded = limit * (0.1 * (record.t_s[1:] - 0.02) - 1.0)
        gain.plot(commanded, record["torque_l_Nmm"][1:, 0], label=label, **style)
    gain.set(xlabel="commanded torque (N·mm)", ylabel="delivered torque (N·mm)")
    legend(gain, loc="upper left")

    shapes = ((0.025, 1.0, 1.0), (0.025, 1.0, 0.7), (0.025, 2.0, 1.0))
    for style, (k, stall, share) in zip(STYLES, shapes, strict=False):
        fields = {"back_emf_s_rad": k, "stall_torque": stall, "current_limit": share}
        speeds, torques = torque_speed(fields)
        curve.plot(
            speeds, torques, label=f"stall torque {stall:g}, current limit {share:g}", **style
        )
        curve.plot([0, 1 / k], [stall * limit, 0], **LAW)
    curve.set(xlabel="wheel speed (rad/s)", ylabel="delivered torque (N·mm)", ylim=(0, 31))
    legend(curve, loc="upper right")

    cases = {
        "none": {},
        "dead_time_s 0.005": {"dead_time_s": 0.005},
        "computing_delay_s 0.02": {"computing_delay_s": 0.02},
        "both": {"dead_time_s": 0.005, "computing_delay_s": 0.02},
    }
    for style, (label, fields) in zip(STYLES, cases.items(), strict=True):
        speeds = lifted_speeds(fields, 0.5, 0.06)
        delay.plot(1 + np.arange(len(speeds)), speeds, label=label, **style)
    delay.set(xlabel="time (ms)", ylabel="wheel speed (rad/s)")
    legend(delay, loc="upper left")

    left, right = (drawn("actuator", f"actuator.torque_gain_{side}", 40) for side in "lr")
    gains.plot(left.ravel(), right.ravel(), "o", ms=4, mfc="none", color=STYLES[0]["color"])
    gains.set(xlabel="gain, left", ylabel="gain, right", xlim=(0.88, 1.12), ylim=(0.88, 1.12))
    gains.set_aspect("equal")


def torque_speed(actuator: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Speed of a lifted left wheel (rad/s) and its torque (N·mm) as it speeds up at full command."""
    speeds = lifted_speeds(actuator, 1.0, 1.2)
    inertia = ROBOT.wheel_inertia_kg_mm2
    step_s = 0.001
    before = np.concatenate([[0.0], speeds[:-1]])
    return before, inertia * (speeds - before) / step_s / 1000


# --- sensors -------------------------------------------------------------------------------------

GYRO_NOISE, GYRO_WALK = 1e-4, 1e-5  # rad/s/√Hz, rad/s per √s


def speeds_of_encoders(counts: int, observer_rad_s: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Left wheel held at 5 rad/s: measured speed in every substep from 1.5 s on, and the true one, rad/s."""
    quantum_rad = 2 * math.pi / counts
    with without_warnings():
        plant = BatchPlant(
            "infinity",
            1,
            robots=1,
            end_on=(),
            preview_s=(),
            action="wheel_speed",
            control_period_s=0.001,
            wheel_loop={"speed_observer_rad_s": observer_rad_s},
            disturbance={"encoder": {"quantum_rad": quantum_rad}},
        )
    plant.reset(seed=SEED)
    place, measured, true = Sample._fields.index("step_l"), [], []
    for _ in range(1600):
        plant.step(np.full((1, 1, 2), 0.2))
        step_rad = plant.arrays.samples[0, place, 0, 0]
        observed = plant.named("observed_speed").speed_l[0, 0]
        measured.append(step_rad / 0.001 if observer_rad_s is None else observed)
        true.append(plant.named("motion").omega_l[0, 0])
    return np.array(measured)[1500:], np.array(true)[1500:]


def allan_deviation(rates: np.ndarray, period_s: float, counts: np.ndarray) -> np.ndarray:
    """Overlapping Allan deviation of rates over windows of so many samples (IEEE Std 952)."""
    angles = np.concatenate([[0.0], np.cumsum(rates) * period_s])
    seconds = [angles[2 * m :] - 2 * angles[m:-m] + angles[: -2 * m] for m in counts]
    squares = np.array([(second**2).mean() for second in seconds])
    return np.sqrt(squares / 2) / (counts * period_s)


def draw_encoders(axes: Axes) -> None:
    """The speed of a wheel from two readings and by the observer, and what the loop makes of each."""
    rough, shaken = speeds_of_encoders(4096, None)
    smooth, steady = speeds_of_encoders(4096, 80.0)
    t_ms = 1 + np.arange(len(rough))
    axes.step(t_ms, rough, where="mid", lw=0.7, color="0.6", label="two readings")
    axes.plot(t_ms, shaken, lw=1.3, label="true, loop on two readings", **STYLES[0])
    axes.plot(t_ms, smooth, lw=1.0, label="observer, 80 rad/s", **STYLES[1])
    axes.plot(t_ms, steady, lw=1.3, label="true, loop on observer", **STYLES[3])
    axes.set(xlabel="time (ms)", ylabel="wheel speed (rad/s)", ylim=(4.2, 7.6))
    legend(axes, loc="upper right", ncols=2)


def draw_fixes(late: Axes, wrong: Axes) -> None:
    """Rate and delay of fixes of a robot that drives off, and the errors of one at rest."""
    drive = {"action": "torque", "robot": FREE}
    t_s, (true,) = sampled(0.6, (1.0, 1.0), "fix_y", disturbance="none", **drive)
    late.plot(1000 * t_s, true, label="true", **STYLES[0])
    cases = {"every 100 ms": {"period_s": 0.1}, "the same, 50 ms late": {"delay_s": 0.05}}
    for style, marker, (label, fields) in zip(STYLES[1:], "so", cases.items(), strict=False):
        position = {"noise_std_mm": 0.0, "period_s": 0.1} | fields
        t_s, (y, has) = sampled(
            0.6, (1.0, 1.0), "fix_y", "has_fix", disturbance={"position": position}, **drive
        )
        came = has > 0
        look = {"color": style["color"], "ls": "", "mfc": "none", "ms": 5}
        late.plot(1000 * t_s[came], y[came], marker, label=label, **look)
    late.set(xlabel="time of arrival (ms)", ylabel="place forward (mm)")
    legend(late, loc="upper left")

    gone = {"type": "impulse", "value": 1, "at_s": 8, "duration_s": 2}
    jumps = {"type": "uniform", "low": -10, "high": 10, "every_s": 5}
    cases = {
        "5 % outliers of 50 mm": {"outlier_share": 0.05, "outlier_std_mm": 50},
        "jumps every 5 s, outage at 8 s": {"bias_x_mm": jumps, "outage": gone},
    }
    for style, marker, (label, fields) in zip(STYLES, "os", cases.items(), strict=False):
        position = {"period_s": 0.05} | fields
        t_s, (x, has) = sampled(
            20.0, (0.0, 0.0), "fix_x", "has_fix", disturbance={"position": position}
        )
        came = has > 0
        wrong.plot(t_s[came], x[came], marker, ms=2, color=style["color"], label=label)
    wrong.set(xlabel="time (s)", ylabel="error of a fix, x (mm)", ylim=(-90, 140))
    legend(wrong, loc="upper left")


def draw_gyro(course_of: Axes, deviation: Axes) -> None:
    """Readings of a robot that turns, and the Allan deviation at rest."""
    bias = {"type": "ornstein_uhlenbeck", "std": 0.02, "time_constant_s": 5}
    turn = {"disturbance": "none", "plant": "kinematic"}
    t_s, (true,) = sampled(20.0, (0.1, 0.05), "gyro", **turn)
    rough = {"noise_rad_s_sqrt_hz": 1e-3, "bias_rad_s": bias, "scale": 1.05}
    _, (read,) = sampled(20.0, (0.1, 0.05), "gyro", **turn | {"disturbance": {"gyro": rough}})
    course_of.plot(t_s[::20], read[::20], lw=0.6, label="scale 1.05, bias, noise", **STYLES[0])
    course_of.plot(t_s[::20], true[::20], label="true", **STYLES[1])
    course_of.set(xlabel="time (s)", ylabel="yaw rate (rad/s)", ylim=(0.25, 0.65))
    legend(course_of, loc="upper right", ncols=2)

    walk = {"type": "random_walk", "per_sqrt_s": GYRO_WALK}
    gyro = {"noise_rad_s_sqrt_hz": GYRO_NOISE, "bias_rad_s": walk}
    t_s, (rates,) = sampled(
        1000.0, (0.0, 0.0), "gyro", plant="kinematic", disturbance={"gyro": gyro}
    )
    counts = np.unique(np.geomspace(10, len(rates) // 5, 25).round().astype(int))
    taus = counts * t_s[0]
    deviation.loglog(
        taus, allan_deviation(rates, t_s[0], counts), "o", ms=4, mfc="none", color="#0072B2"
    )
    law = np.sqrt(GYRO_NOISE**2 / taus + GYRO_WALK**2 * taus / 3)
    deviation.loglog(taus, law, **LAW)
    deviation.set(xlabel="window τ (s)", ylabel="Allan deviation (rad/s)")


def draw_calibration(axes: Axes) -> None:
    """Where a robot goes that is to drive a circle once, by what it believes of its wheels."""
    cases: dict[str, dict[str, float]] = {
        "true": {},
        "left radius × 1.02": {"radius_left": 1.02},
        "axle × 1.05": {"track": 1.05},
    }
    for style, (label, fields) in zip(STYLES, cases.items(), strict=False):
        _, (x, y) = sampled(
            31.4,
            (0.1, 0.025),
            "fix_x",
            "fix_y",
            plant="kinematic",
            disturbance={"calibration": fields, "position": {"noise_std_mm": 0}},
        )
        axes.plot(x[::50], y[::50], label=label, **style)
        axes.plot(x[-1], y[-1], "o", ms=5, color=style["color"])
    axes.set(xlabel="x (mm)", ylabel="y (mm)", aspect="equal", xlim=(-1200, 1500))
    legend(axes, loc="center right")


def draw_sensors(figure: Figure) -> None:
    """Encoders, fixes, gyro, calibration."""
    names = (
        "Encoders of 4096 counts: 5 rad/s commanded",
        "Rate and delay of the fixes",
        "Errors of the fixes, 20 Hz",
        "Calibration: one circle of 31.4 s",
        "Gyro over time",
        "Gyro at rest: noise and a bias that walks",
    )
    encoders, late, wrong, calibration, gyro, deviation = panels(figure, names)
    draw_encoders(encoders)
    draw_fixes(late, wrong)
    draw_calibration(calibration)
    draw_gyro(gyro, deviation)


# --- robots --------------------------------------------------------------------------------------


def message_ages(disturbance: str, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Times (s) and ages (s) beyond the time gap of the messages that robot 1 uses."""
    with without_warnings():
        plant = BatchPlant("infinity", 1, disturbance=disturbance, end_on=(), time_gap_s=1.0)
    plant.reset(seed=SEED)
    scenario, arrays = plant.scenario, plant.arrays
    rest, lost, late = np.zeros((1, scenario.robot_count, 2)), [False], [0]
    for step in range(1, 1 + round(seconds / scenario.control_period_s) + scenario.gap_steps):
        plant.step(rest)
        lost.append(bool(arrays.dropped[step % len(arrays.dropped), 0, 0]))
        late.append(lateness(arrays, 0, 1, step, make_settings(scenario))[0])
    ages = []
    for step in range(scenario.gap_steps, len(lost)):
        wanted = step - scenario.gap_steps
        newest = max(wanted - late[step], 0)
        while lost[newest]:
            newest -= 1
        ages.append((wanted - newest) * scenario.control_period_s)
    return times(np.array(ages), scenario.control_period_s), np.array(ages)


def start_poses(episodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Start poses (x, y, heading) of the preset ``start`` and of ``nominal``, (episode, robot, 3)."""
    found = []
    for name in ("start", "nominal"):
        with without_warnings():
            plant = BatchPlant("infinity", episodes, disturbance=name, end_on=())
        plant.reset(seed=SEED)
        places = [Info._fields.index(key) for key in ("x_mm", "y_mm", "theta_rad")]
        found.append(plant.infos[:, :, places].copy())
    return found[0], found[1]


def draw_robots(figure: Figure) -> None:
    """Payload, start scatter, radio, different robots."""
    names = (
        "Payload (payload), 20 episodes of three robots",
        "Start (start), 6 episodes of three robots",
        "Radio (radio), robot 1",
        "Different robots (mixed), at the start",
    )
    payload, start, radio, row = panels(figure, names)
    masses, places = (drawn("payload", f"payload.{key}", 20) for key in ("mass_kg", "behind_mm"))
    for i, style in enumerate(STYLES[:3]):
        look = {"color": style["color"], "marker": MARKERS[i], "ls": "", "mfc": "none", "ms": 4}
        payload.plot(places[:, i], masses[:, i], label=f"robot {i}", **look)
    payload.set(xlabel="behind the axle (mm)", ylabel="mass (kg)", ylim=(0.12, 0.2))
    legend(payload, ncols=3, loc="upper right")

    scattered, nominal = start_poses(6)
    for i, style in enumerate(STYLES[:3]):
        x, y, theta = scattered[:, i].T
        look = {"color": style["color"], "width": 0.006, "zorder": 3}
        start.quiver(x, y, -np.sin(theta), np.cos(theta), scale=22, **look)
        start.plot(x, y, MARKERS[i], ms=3, color=style["color"], label=f"robot {i}")
        start.plot(*nominal[0, i, :2], "+", ms=11, color="black", zorder=4)
    start.plot([], [], "+", ms=11, color="black", label="nominal")
    start.set(
        xlabel="x (mm)", ylabel="y (mm)", aspect="equal", xlim=(1700, 3600), ylim=(1700, 2750)
    )
    legend(start, loc="center right")

    t_s, ages = message_ages("radio", 2.0)
    radio.step(t_s, 1000 * ages, where="post", lw=0.9, color=STYLES[0]["color"])
    radio.set(xlabel="time (s)", ylabel="age beyond the gap (ms)")

    with without_warnings():
        scenario = load_scenario("mixed", plant="batch", horizon_s=5.0)
        record = run_policy(
            scenario,
            Torques(lambda t_s: (0.0, 0.0), 0.02),
            SEED,
            options={"poses": [[-300.0 * i, 0.0, -math.pi / 2] for i in range(3)]},
        )
    for i, (style, robot) in enumerate(zip(STYLES, record.scenario.robot_models, strict=False)):
        centre = (-300.0 * i - robot.outline_offset_mm, 0.0)
        row.add_patch(Circle(centre, robot.outline_radius_mm, fc="0.95", ec=style["color"]))
        for corners in body_polygons(record, 0, i):
            row.add_patch(Polygon(corners, fc=style["color"]))
        row.text(-300.0 * i, 125, f"robot {i}\n{robot.mass_kg:g} kg", ha="center", fontsize=8)
    row.set(xlabel="x (mm)", ylabel="y (mm)", aspect="equal", xlim=(-780, 150), ylim=(-160, 230))
