"""Splits: which tasks and disturbances may train and tune, which may also choose, and which only test.

The seeds are split in the same way (:mod:`baselines.runs.seed_ranges`).
"""

from __future__ import annotations

from tlf_env.task.scenario import Scenario

TEST_SET = "test-set"  # the names of the test set's cases begin so

# A family is a group of presets with the same cause. Presets that are not named here, and files of a
# user's own, may train.
TRAINING_FAMILIES = {
    "without": ("none", "nominal"),
    "slip": ("slip", "slip-ramps", "slip-noise"),
    "grip": ("ice", "split-ice", "split-ice-right", "patches"),
    "floor": ("slope",),
    "fixes": ("noise", "fixes-100hz", "fixes-camera", "fixes-uwb"),
    "wheels and gyro": ("encoders-1024", "encoders-4096", "gyro", "calibration"),
    "motors": ("actuator", "motor"),
    "robots": ("payload",),
    "radio": ("radio",),
    "start": ("start",),
    "together": ("combined-easy", "combined-medium", "combined-hard", "hardware"),
}
CHOOSING_DISTURBANCES = ("slip-sines", "creep", "rolling", "fixes-outage", "pushes")
TEST_DISTURBANCES = ("swell",)
TEST_TASKS = ("stop_and_go",)


def check_training(scenario: Scenario) -> None:
    """Check that a scenario may be trained and tuned on.

    Raises
    ------
    ValueError
        naming the task or the disturbance that may not, or code that the scenario names: the policies that are
        found are numbers, which must not depend on code.
    """
    for role, path in scenario.code.items():
        raise ValueError(f"{role} {path!r} is code, which a training or a search must not name")
    check_training_names(scenario.name, scenario.disturbance.name)


def check_training_names(task: str, disturbance: str) -> None:
    """As :func:`check_training`, by the names of the task and the disturbance."""
    check_choosing_names(task, disturbance)
    if disturbance in CHOOSING_DISTURBANCES:
        raise ValueError(
            f"disturbance {disturbance!r} chooses between trained policies; it must not train or tune"
        )


def check_choosing(scenario: Scenario) -> None:
    """Check that a scenario may choose: decide which of some policies is kept.

    Raises
    ------
    ValueError
        naming the task or the disturbance that is for tests only.
    """
    check_choosing_names(scenario.name, scenario.disturbance.name)


def check_choosing_names(task: str, disturbance: str) -> None:
    """As :func:`check_choosing`, by the names of the task and the disturbance."""
    for what, name, reserved in (
        ("task", task, TEST_TASKS),
        ("disturbance", disturbance, TEST_DISTURBANCES),
    ):
        if name in reserved or name.startswith(TEST_SET):
            raise ValueError(
                f"{what} {name!r} is for tests only; it must not train, tune or choose"
            )
