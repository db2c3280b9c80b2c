"""``tlf list``: what can be named on the command line, each with a line that says what it is."""

from __future__ import annotations

from collections.abc import Callable

from rich.table import Table

from baselines.console import screen
from tlf_env.common.errors import suggestion
from tlf_env.common.presets import preset_names, preset_summary

# Written out here, as the modules that define these names import Numba, and `tlf list` and the completion
# of names in a shell should be quick. Tests compare the names, and the lines of the laws.
LAW_LINES = {
    "pure_pursuit": "Steer along the circle through the robot's position and a later position of its "
    "reference.",
    "feedback_linearisation": "Input–output linearisation of a point ``ahead_mm`` in front of the axle.",
    "kanayama": "A stable tracking law whose correction of the heading grows with the reference's speed.",
    "lqr": "Time-varying linear-quadratic regulator of the errors about the reference's motion.",
    "sliding_mode": "Sliding mode on the surfaces of Mu, Yan, Spurgeon and Mao, with a boundary layer.",
    "adrc": "Feedback linearisation with a linear extended state observer on each robot.",
    "nmpc": "Nonlinear model predictive control by real-time iterations.",
}
LEARNED_LINES = {
    "from-nothing": "PPO, without a controller beneath: its action is added to the reference's twist.",
    "residual": "PPO: its action is added to the twist of the default controller.",
}
POLICY_FORMS = {
    "CONTROLLER+ESTIMATOR+LIMITER": "A reference or a law on another estimator, and behind a limiter.",
    "LAW:FILE.yaml": "A law with parameters of a file; reference:FILE.yaml likewise.",
    "FILE.safetensors": "A trained policy, with its card FILE.json beside it.",
    "module:factory": "A policy in Python, with SB3's predict; with --trust.",
    "FILE.zip": "A model saved by SB3 (PPO, SAC, TD3); with --trust.",
    "entry:FOLDER": "The entry to a competition; one that is a program with --trust.",
}
ESTIMATOR_LINES = {
    "ekf-gyro": "EKF that reads encoders, position fixes, gyro and motor torques: the default.",
    "ekf-slip": "EKF that estimates the slip from encoders and fixes, without a gyro.",
    "ekf": "The paper's EKF, which estimates no slip.",
    "truth": "The true pose and slip: what a perfect estimator would give. Privileged.",
    "ekf-slip-without-jumps": "ekf-slip without its search for sudden changes of wheel speed.",
    "ekf-gyro-without-torques": "ekf-gyro without the torques.",
    "ukf": "Unscented filter with the model of ekf-slip, in Python.",
    "moving-horizon": "Least squares over the last second, in Python: slow.",
    "ekf-smoothed": "ekf, with smoothed broadcasts.",
    "ekf-slip-smoothed": "ekf-slip, with smoothed broadcasts.",
    "ekf-gyro-smoothed": "ekf-gyro, with smoothed broadcasts: what the default controller has.",
}
ACTION_LINES = {
    "twist": "Forward speed and yaw rate; 1.0 is full speed. For controllers.",
    "tracking_twist": "Added to the twist of the reference: zero follows it. What learners have by default.",
    "residual": "Added to the twist of a controller, residual_base.",
    "wheel_speed": "Speeds of both wheels.",
    "torque": "Torques of both motors, without the wheel loop.",
}
PLANT_LINES = {
    "pymunk": "Multibody robots with contact in a pymunk space: the default.",
    "batch": "The same robots without contact, many formations side by side.",
    "kinematic": "Robots without inertia, which move as their wheels are commanded.",
    "chipmunk": "Robots made of pymunk's own bodies and constraints.",
}


def _presets(kind: str) -> Callable[[], dict[str, str]]:
    return lambda: {name: preset_summary(kind, name) for name in preset_names(kind)}


def controllers() -> dict[str, str]:
    """The controllers on board and the textbook laws."""
    found = {
        f"reference:{name}": preset_summary("controller", name)
        for name in preset_names("controller")
    }
    for law, line in LAW_LINES.items():
        found[law] = line
        for name in preset_names(law):
            found[f"{law}:{name}"] = preset_summary(law, name)
    return found


def policies() -> dict[str, str]:
    """What drives the robots of a run: controllers, learned policies, and what a user brings."""
    return controllers() | LEARNED_LINES | POLICY_FORMS


KINDS: dict[str, tuple[str, Callable[[], dict[str, str]]]] = {
    "tasks": ("tlf run TASK", _presets("scenario")),
    "disturbances": ("tlf run TASK --disturbance NAME", _presets("disturbance")),
    "policies": ("tlf run TASK --policy NAME", policies),
    "estimators": (
        "tlf run TASK --policy CONTROLLER+NAME",
        lambda: ESTIMATOR_LINES,
    ),
    "limiters": ("tlf run TASK --policy CONTROLLER+ESTIMATOR+NAME", _presets("limiter")),
    "actions": (
        "gymnasium.make(..., action=NAME)",
        lambda: ACTION_LINES,
    ),
    "plants": ("tlf run TASK --plant NAME", lambda: PLANT_LINES),
    "trainings": ("tlf train NAME", _presets("training")),
    "plans": ("tlf bench --plan NAME", _presets("plan")),
    "searches": ("tlf tune NAME", _presets("search")),
    "knobs": ("tlf bench --envelope --knobs NAME", _presets("knob")),
    "worlds": ("tlf run TASK --set world=NAME", _presets("world")),
}  # kind: how to use a name, and the names with a line each


def catalogue(kind: str | None = None) -> dict[str, dict[str, str]]:
    """The names of a kind with a line each, or of all kinds.

    Raises
    ------
    ValueError
        for an unknown kind.
    """
    if kind is not None and kind not in KINDS:
        raise ValueError(f"{kind!r} is not one of {', '.join(KINDS)}{suggestion(kind, KINDS)}")
    return {one: KINDS[one][1]() for one in ([kind] if kind else KINDS)}


def print_catalogue(found: dict[str, dict[str, str]]) -> None:
    """Print the names and their lines, the kinds one after another."""
    for kind, lines in found.items():
        table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 2, 0, 0))
        table.add_column(no_wrap=True)
        table.add_column(overflow="fold")
        for name, line in lines.items():
            table.add_row(f"  {name}", line)
        screen.print(f"{kind}: {KINDS[kind][0]}")
        screen.print(table)
        screen.print()
