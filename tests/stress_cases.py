"""Random scenarios of the stress campaign: robots, floors, disturbances, interfaces and actions.

A case follows from its number alone, so any finding can be run again.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from tlf_env.disturbances.channels import CHANNELS, Channel
from tlf_env.physics.parameters import RobotParameters

# How far each parameter of a robot may be from its default, as a factor either way.
SPREADS = {"default": 1.0, "near": 2.0, "wide": 10.0, "extreme": 1000.0}
SHARES = (0.25, 0.35, 0.3, 0.1)
MILD_SHARES = (0.5, 0.45, 0.05, 0.0)
MILD = 0.7  # of the cases: usual robots, never thrown about, under disturbances of usual sizes
MILD_DECADES = (-4.0, -1.5)  # of the sizes of disturbances, as shares of what is allowed
DECADES = (-4.0, 0.0)
DEFAULT = RobotParameters()
SCALED = (
    "mass_kg",
    "wheel_radius_mm",
    "axle_width_mm",
    "wheel_inertia_kg_mm2",
    "gravity_mm_s2",
    "body_inertia_kg_mm2",
    "castor_pivot_mm",
    "castor_trail_mm",
    "castor_radius_mm",
    "castor_inertia_kg_mm2",
    "fork_inertia_kg_mm2",
    "torque_limit_Nmm",
)
JOINTS = ("drive_joint", "castor_joint", "steering_joint")
PRELOAD_NMM = 2.0  # its scale; the default is 0
GRAVITY = 10.0  # gravity and the tyres' friction are not spread by more than this

OFTEN = {  # channels of the plant: of the floor, the pushes and the motors
    "slip": 0.3,
    "tyre": 0.3,
    "floor": 0.3,
    "push": 0.3,
    "actuator": 0.2,
    "payload": 0.3,
}
SELDOM = 0.1
JITTER_STEPS = 20  # longest jitter in control steps: a ring of messages is as long
STARTS_MM, STARTS_RAD = (
    20.0,
    1.0,
)  # largest scatter of the starts that leaves room between the robots
SIGNALS = (
    "constant",
    "step",
    "impulse",
    "sine",
    "uniform",
    "gaussian",
    "ornstein_uhlenbeck",
    "band_limited",
    "random_walk",
    "pulses",
)
ACTIONS = ("twist", "wheel_speed", "torque", "residual", "tracking_twist")
ESTIMATORS = ("ekf", "ekf-slip", "ekf-gyro", "truth")
PERIODS_S = (0.0005, 0.001, 0.001, 0.002, 0.004)
SUBSTEPS = (1, 2, 5, 10, 20, 20, 20, 20)


class Case(NamedTuple):
    """What a batch of formations runs: scenarios that may be side by side, and of which class each is."""

    number: int
    scenarios: list[dict[str, Any]]
    spreads: list[str]
    thrown: bool  # whether robots are thrown about, now and then
    steps: int


def rng_of(number: int) -> np.random.Generator:
    """The random numbers of a case."""
    return np.random.default_rng([20_261_130, number])


def factor(rng: np.random.Generator, spread: float) -> float:
    """A factor, evenly in its logarithm between 1/spread and spread."""
    return float(spread ** rng.uniform(-1, 1))


def draw_curve(rng: np.random.Generator, spread: float, base: Any) -> dict[str, float]:
    """A friction curve: now and then without friction, or with the same coefficient always."""
    stiction = base.stiction_speed_mm_s * factor(rng, spread)
    static = base.mu_static * factor(rng, min(spread, GRAVITY)) * float(rng.random() > 0.05)
    return {
        "mu_static": static,
        "mu_dynamic": static * float(rng.choice([0.0, 1.0, rng.random(), 0.75])),
        "stiction_speed_mm_s": stiction,
        "dynamic_speed_mm_s": stiction * float(rng.choice([1.001, 1.5, 1.0 + factor(rng, 10.0)])),
    }


def draw_robot(rng: np.random.Generator, spread: float) -> dict[str, Any]:
    """Parameters of a robot."""
    if spread == 1.0:
        return {}
    robot: dict[str, Any] = {}
    for name in SCALED:
        most = min(spread, GRAVITY) if name == "gravity_mm_s2" else spread
        robot[name] = getattr(DEFAULT, name) * factor(rng, most)
    share = float(rng.choice([0.0, 0.2, rng.uniform(0, 0.95)], p=[0.1, 0.4, 0.5]))
    base_mm = robot["castor_pivot_mm"] + robot["castor_trail_mm"]
    robot |= {
        "castor_load_share": share,
        "drive_load_share": (1.0 - share) / 2,
        "com_offset_mm": share * base_mm,
        "tyre": draw_curve(rng, spread, DEFAULT.tyre),
        "joint_friction": bool(rng.random() < 0.8),
    }
    for name in JOINTS:
        joint = getattr(DEFAULT, name)
        robot[name] = draw_curve(rng, spread, joint) | {
            arm: getattr(joint, arm) * factor(rng, min(spread, GRAVITY))
            for arm in ("friction_arm_mm", "pin_radius_mm", "bending_arm_mm")
        }
        robot[name]["preload_Nmm"] = PRELOAD_NMM * factor(rng, spread) * float(rng.random() < 0.2)
        robot[name]["bending"] = bool(rng.random() < 0.7)
    return robot


def draw_signal(rng: np.random.Generator, channel: Channel, low: float, high: float) -> Any:
    """A signal of any kind between two values."""
    first, second = sorted(rng.uniform(low, high, 2).tolist())
    middle, half = 0.5 * (first + second), 0.5 * (second - first)
    std = half / 4
    kind = str(rng.choice(SIGNALS))
    every_s = float(10.0 ** rng.uniform(-3, 0))
    given: dict[str, Any] = {"type": kind}
    if kind == "constant":
        return first
    if kind == "step":
        given |= {"value": second, "before": first, "at_s": float(rng.uniform(0, 0.3))}
    elif kind == "impulse":
        given |= {"value": second, "rest": first, "at_s": float(rng.uniform(0, 0.3))}
        given["duration_s"] = every_s
    elif kind == "sine":
        given |= {"amplitude": half, "mean": middle, "frequency_hz": 1 / every_s}
        given["random_phase"] = bool(rng.random() < 0.5)
    elif kind == "uniform":
        given |= {"low": first, "high": second}
    elif kind == "gaussian":
        given |= {"std": std, "mean": middle}
    elif kind == "ornstein_uhlenbeck":
        given |= {"std": std, "mean": middle, "time_constant_s": every_s}
    elif kind == "band_limited":
        given |= {"std": std, "mean": middle, "correlation_s": every_s}
    elif kind == "random_walk":
        given |= {"per_sqrt_s": std, "start": middle}
    else:
        given |= {"value": second, "rest": first, "every_s": every_s, "duration_s": every_s / 3}
    if kind in ("uniform", "gaussian") and rng.random() < 0.7 and channel.rate != "episode":
        given["every_s"] = every_s
        if rng.random() < 0.3:
            given["ramp_s"] = every_s / 2
    return given


def draw_channel(
    rng: np.random.Generator, channel: Channel, base_mm: float, control_s: float, mild: bool
) -> Any:
    """A signal of a channel, small or, unless it is mild, as large as the channel allows."""
    low, high = channel.low, channel.high
    if channel.path == "payload.behind_mm":  # between axle and castor, or the robot tips over
        return draw_signal(rng, channel, 0.0, min(base_mm, high))
    if channel.path == "start.position_std_mm":
        return float(rng.uniform(0, STARTS_MM))
    if channel.path == "start.heading_std_rad":
        return float(rng.uniform(0, STARTS_RAD))
    if channel.path == "actuator.computing_delay_s":
        high = control_s
    if channel.path == "radio.jitter_s":
        high = JITTER_STEPS * control_s
    size = 10.0 ** rng.uniform(*(MILD_DECADES if mild else DECADES))
    if rng.random() < 0.1 and not mild:
        size = 1.0
    nominal = min(max(channel.nominal, low), high)
    return draw_signal(
        rng, channel, nominal + size * (low - nominal), nominal + size * (high - nominal)
    )


def draw_disturbance(
    rng: np.random.Generator, base_mm: float, control_s: float, mild: bool, *, creeps: bool = True
) -> dict[str, Any]:
    """Any of the channels, in any of their signals, and patches."""
    tree: dict[str, Any] = {}
    if rng.random() < 0.1:
        return tree
    for channel in CHANNELS:
        group, name = channel.path.split(".")
        share = 0.25 * SELDOM if mild and name == "creep" else OFTEN.get(group, SELDOM)
        if rng.random() > share or (name == "creep" and not creeps):
            continue
        tree.setdefault(group, {})[name] = draw_channel(rng, channel, base_mm, control_s, mild)
    if rng.random() < 0.4:
        tree.setdefault("tyre", {})["patches"] = [
            draw_patch(rng) for _ in range(rng.integers(1, 6))
        ]
    return tree


def draw_patch(rng: np.random.Generator) -> dict[str, float]:
    """A patch near the start."""
    x, y = rng.uniform(-1500, 1500, 2).tolist()
    return {
        "x_mm": x,
        "y_mm": y,
        "radius_mm": float(rng.uniform(50, 800)),
        "friction_scale": float(rng.choice([0.0, rng.random(), rng.uniform(1, 10)])),
    }


def draw_scenario(rng: np.random.Generator, steps: int) -> dict[str, Any]:
    """What the scenarios of a batch have in common."""
    dt_s, substeps = float(rng.choice(PERIODS_S)), int(rng.choice(SUBSTEPS))
    control_s = dt_s * substeps
    gap = int(rng.integers(4, 30))
    action = str(rng.choice(ACTIONS))
    half = control_s * (gap // 2)
    return {
        "scenario": str(rng.choice(["infinity", "flower", "circle"])),
        "plant": "batch",
        "robots": int(rng.integers(1, 5)),
        "physics_period_s": dt_s,
        "control_period_s": control_s,
        "time_gap_s": control_s * gap,
        "preview_s": (half, control_s * gap),
        "horizon_s": control_s * (steps + 1),
        "broadcast_smoothing_s": 0.0 if rng.random() < 0.5 else None,
        "action": action,
        "estimator": str(rng.choice(ESTIMATORS)),
        "observation": str(rng.choice(["tracking", "sensor"])),
        "cooperative": bool(rng.random() < 0.2),
        "rays": {"count": int(rng.integers(1, 9))} if rng.random() < 0.2 else None,
        "start_ramp_s": float(rng.choice([0.0, 0.5])),
        "world": {"patches": [draw_patch(rng)]} if rng.random() < 0.2 else {},
        "end_on": (),
    }


def draw_loop(rng: np.random.Generator, spread: float) -> dict[str, Any]:
    """Parameters of the wheel loop."""
    loop: dict[str, Any] = {"gain_Nmm_s": 150.0 * factor(rng, spread)}
    if rng.random() < 0.3:
        loop["speed_observer_rad_s"] = 80.0 * factor(rng, 5.0)
    return loop


def draw_case(number: int, variants: int, substeps: int, *, creeps: bool = True) -> Case:
    """The case of a number: scenarios that run side by side, each for so many substeps."""
    rng = rng_of(number)
    mild = bool(rng.random() < MILD)
    steps = substeps
    common = draw_scenario(rng, steps)
    per_step = round(common["control_period_s"] / common["physics_period_s"])
    steps = max(substeps // per_step, 2)
    common["horizon_s"] = common["control_period_s"] * (steps + 1)
    spreads = rng.choice(list(SPREADS), variants, p=MILD_SHARES if mild else SHARES).tolist()
    scenarios = []
    for spread in spreads:
        robots = [draw_robot(rng, SPREADS[spread]) for _ in range(common["robots"])]
        base_mm = min(
            robot.get("castor_pivot_mm", DEFAULT.castor_pivot_mm)
            + robot.get("castor_trail_mm", DEFAULT.castor_trail_mm)
            for robot in robots
        )
        scenarios.append(
            {
                **common,
                "robots": robots,
                "wheel_loop": draw_loop(rng, min(SPREADS[spread], 10.0)),
                "disturbance": draw_disturbance(
                    rng, base_mm, common["control_period_s"], mild, creeps=creeps
                ),
            }
        )
    return Case(number, scenarios, spreads, bool(rng.random() < 0.6) and not mild, steps)


def draw_actions(rng: np.random.Generator, shape: tuple[int, ...], last: np.ndarray) -> np.ndarray:
    """Actions of every kind: held, anywhere in the range, at its ends, far beyond it, and tiny."""
    new = rng.uniform(-1, 1, shape)
    kind = rng.random(shape[:2])[:, :, None]
    ends = np.sign(new)
    far = ends * 10.0 ** rng.uniform(0, 308, shape)
    tiny = new * 10.0 ** rng.uniform(-320, -3, shape)
    new = np.where(kind < 0.3, ends, new)
    new = np.where((kind >= 0.3) & (kind < 0.35), far, new)
    new = np.where((kind >= 0.35) & (kind < 0.4), tiny, new)
    new = np.where((kind >= 0.4) & (kind < 0.5), 0.0, new)
    holds = rng.random(shape[:2])[:, :, None] < 0.97
    return np.where(holds, last, new)


SPEEDS = np.array(
    [300.0, 300.0, 2.0, 5.0, 10.0, 10.0, 20.0]
)  # of a fast robot: v, w, s and the spins


def throw(rng: np.random.Generator, motion: np.ndarray, share: float) -> None:
    """Give a share of the robots, (field, robot, lane), velocities and angles at random; in place."""
    who = rng.random(motion.shape[1:]) < share
    scale = 10.0 ** rng.uniform(-4, 0.7, motion.shape[1:])
    speeds = SPEEDS[:, None, None] * rng.normal(size=(7, *motion.shape[1:])) * scale
    stuck = rng.random(motion.shape[1:]) < 0.3
    speeds[3] = np.where(stuck, speeds[2], speeds[3])
    speeds[4:] *= rng.random((3, *motion.shape[1:])) < 0.8
    motion[4:11] = np.where(who, speeds, motion[4:11])
    motion[2:4] += np.where(who, rng.uniform(-4, 4, (2, *motion.shape[1:])), 0.0)
