"""The hash of a scenario: over the fields in which it differs from neutral values that never change.

A field with its neutral value does not count. So a new field changes no hash, if its neutral value
means "as before". The neutral values are written out here. They are not the defaults of the models,
because a default may change; then the hash of a scenario that omits the field must change, too.

Rules for :data:`NEUTRAL`: every field of every model in a scenario has an entry, a value or
:data:`ALWAYS`. An entry is added together with its field and never changed afterwards. Two kinds need no
entry: the channels of a disturbance, whose neutral value is the nominal constant in
``disturbances/channels.py``, and new reward terms, which are neutral at weight 0.
"""

from __future__ import annotations

import enum
import hashlib
import json
from collections.abc import Mapping
from typing import Any, Final

from pydantic import BaseModel

from tlf_env.disturbances.channels import CHANNELS
from tlf_env.task.scenario import Scenario


class Mark(enum.Enum):
    """Marks that take the place of a value."""

    ALWAYS = enum.auto()  # a field that always counts
    ABSENT = enum.auto()  # a value that is neutral


ALWAYS: Final = Mark.ALWAYS

# Fields of a nested model that are not named here have the neutral values of the model's own entry.
NEUTRAL: dict[str, dict[str, Any]] = {
    "Scenario": {
        "name": ALWAYS,
        "trajectory": ALWAYS,
        "robots": 3,
        "robot": {},
        "time_gap_s": 5.0,
        "start_spacing_mm": 300.0,
        "start_ramp_s": 0.0,
        "physics_period_s": 0.001,
        "control_period_s": 0.02,
        "horizon_s": 100.0,
        "plant": "pymunk",
        "world": {},
        "wheel_loop": {},
        "estimator": "ekf",
        "ekf": {},
        "ekf_slip": {},
        "ekf_gyro": {},
        "broadcast_smoothing_s": 0.0,
        "observer": {},
        "disturbance": {},
        "adversary": False,
        "action": "twist",
        "action_range": None,
        "tracking_fade_mm": None,
        "limiter": None,
        "residual_base": "consistent",
        "residual_fade_mm": 0.0,
        "residual_reach_mm": None,
        "observation": "tracking",
        "rays": None,
        "neighbour": None,
        "dtype": "float32",
        "preview_s": [0.5, 1.0],
        "reward": {
            "far": 0.0,
            "coarse": 0.5,
            "medium": 0.5,
            "fine": 0.5,
            "action_change": -0.02,
            "action_size": -0.005,
            "slip": -0.05,
            "lost": -20.0,
            "touched": -20.0,
        },
        "cooperative": False,
        "end_on": ["lost", "touched"],
        "lost_beyond_mm": 1200.0,
    },
    "FrictionCurve": {
        "mu_static": ALWAYS,
        "mu_dynamic": ALWAYS,
        "stiction_speed_mm_s": ALWAYS,
        "dynamic_speed_mm_s": ALWAYS,
    },
    "JointFriction": {
        "friction_arm_mm": ALWAYS,
        "pin_radius_mm": ALWAYS,
        "bending_arm_mm": ALWAYS,
        "preload_Nmm": 0.0,
        "bending": True,
    },
    "RobotParameters": {
        "mass_kg": 1.245,
        "wheel_radius_mm": 50.0,
        "axle_width_mm": 156.0,
        "wheel_inertia_kg_mm2": 52.91,
        "gravity_mm_s2": 9807.0,
        "drive_load_share": 0.4,
        "castor_load_share": 0.2,
        "body_inertia_kg_mm2": 6197.0,
        "com_offset_mm": 20.0,
        "castor_pivot_mm": 85.0,
        "castor_trail_mm": 15.0,
        "castor_radius_mm": 20.0,
        "castor_inertia_kg_mm2": 4.0,
        "fork_inertia_kg_mm2": 20.0,
        "outline_radius_mm": 110.0,
        "outline_offset_mm": 30.0,
        "outline_polygon_mm": None,
        "outline_restitution": 0.0,
        "outline_friction": 0.0,
        "torque_limit_Nmm": 15.0,
        "tyre": {
            "mu_static": 0.073,
            "mu_dynamic": 0.055,
            "stiction_speed_mm_s": 2.0,
            "dynamic_speed_mm_s": 3.0,
        },
        "drive_joint": {
            "mu_static": 0.15,
            "mu_dynamic": 0.1,
            "stiction_speed_mm_s": 1.0,
            "dynamic_speed_mm_s": 1.5,
            "friction_arm_mm": 12.0,
            "pin_radius_mm": 8.0,
            "bending_arm_mm": 36.0,
        },
        "castor_joint": {
            "mu_static": 0.15,
            "mu_dynamic": 0.1,
            "stiction_speed_mm_s": 1.0,
            "dynamic_speed_mm_s": 1.5,
            "friction_arm_mm": 6.2,
            "pin_radius_mm": 3.025,
            "bending_arm_mm": 30.0,
        },
        "steering_joint": {
            "mu_static": 0.05,
            "mu_dynamic": 0.033,
            "stiction_speed_mm_s": 1.0,
            "dynamic_speed_mm_s": 1.5,
            "friction_arm_mm": 2.5,
            "pin_radius_mm": 2.5,
            "bending_arm_mm": 3.0,
        },
        "joint_friction": True,
    },
    "WheelLoopParameters": {
        "gain_Nmm_s": 150.0,
        "zeros_1": 3.0,
        "zeros_0": 0.3025,
        "pole_rad_s": 2.0,
        "speed_observer_rad_s": None,
    },
    "EkfParameters": {
        "alpha_1": 2e-3,
        "alpha_2": 1e-2,
        "alpha_3": 1e-2,
        "alpha_4": 1e-3,
        "fix_variance_mm2": 0.2,
    },
    "GyroEkfParameters": {
        "forward_noise_mm2_s": 1.0,
        "sideways_noise_mm2_s": 0.05,
        "heading_noise_rad2_s": 1.0e-6,
        "gyro_walk_rad2_s3": 1.0e-5,
        "gyro_error_bound_rad_s": 0.2,
        "gyro_scale_std": 0.03,
        "gyro_scale_bound": 0.1,
        "torque_time_s": 1.0,
        "speed_walk_mm2_s3": 1000.0,
        "speed_error_bound_mm_s": 200.0,
        "fix_variance_mm2": 0.2,
        "fix_variance_time_s": 0.5,
        "least_fix_variance_mm2": 0.05,
        "fix_variance_factor": 4.0,
        "outlier_threshold": 30.0,
        "slip_time_s": 0.02,
        "delta_1_bound_mm_s": 60.0,
        "delta_2_bound_rad_s": 0.415,
        "floor_slip_acceleration_mm_s2": 100.0,
        "floor_slip_mm_s": 10.0,
        "floor_slip_rad_s": 0.08,
        "floor_slip_rise_s": 0.3,
        "floor_slip_decay_s": 20.0,
    },
    "SlipEkfParameters": {
        "forward_noise_mm2_s": 35.0,
        "sideways_noise_mm2_s": 0.09,
        "heading_noise_rad2_s": 9.0e-6,
        "delta_1_walk_mm2_s3": 440.0,
        "delta_2_walk_rad2_s3": 0.0185,
        "fix_variance_mm2": 0.2,
        "fix_variance_time_s": 0.5,
        "least_fix_variance_mm2": 0.05,
        "fix_variance_factor": 18.0,
        "delta_1_bound_mm_s": 60.0,
        "delta_2_bound_rad_s": 0.415,
        "surprise_time_s": 0.05,
        "surprise_threshold": 6.2,
        "most_surprise": 5.0,
        "surprise_speed_mm_s": 300.0,
        "heading_surprise_rad2_s": 3.4e-4,
        "delta_1_surprise_mm2_s3": 8000.0,
        "delta_2_surprise_rad2_s3": 0.18,
        "most_acceleration_mm_s2": 650.0,
        "most_yaw_acceleration_rad_s2": 4.4,
        "grip_mm_s2": 850.0,
        "yaw_grip_rad_s2": 5.0,
        "jump_uncertainty": 0.1,
    },
    "ObserverParameters": {"gain_per_s": 3.0, "smoothing_s": 5.0},
    "Disturbance": {
        "name": ALWAYS,
        "level": 1.0,
        "slip": {},
        "tyre": {},
        "floor": {},
        "push": {},
        "position": {},
        "encoder": {},
        "gyro": {},
        "calibration": {},
        "actuator": {},
        "radio": {},
        "payload": {},
        "start": {},
    },
    "TyreChannels": {"patches": []},
    "Patch": {"x_mm": ALWAYS, "y_mm": ALWAYS, "radius_mm": ALWAYS, "friction_scale": ALWAYS},
    "World": {"walls": [], "obstacles": [], "pushables": [], "moving": [], "patches": []},
    "Surface": {"restitution": 1.0, "friction": 1.0},
    "CircleShape": {"type": ALWAYS, "radius_mm": ALWAYS},
    "BoxShape": {"type": ALWAYS, "width_mm": ALWAYS, "length_mm": ALWAYS},
    "PolygonShape": {"type": ALWAYS, "points_mm": ALWAYS},
    "Wall": {"points_mm": ALWAYS, "thickness_mm": 20.0, "closed": False},
    "Obstacle": {"shape": ALWAYS, "x_mm": ALWAYS, "y_mm": ALWAYS, "angle_rad": 0.0},
    "Pushable": {
        "shape": ALWAYS,
        "x_mm": ALWAYS,
        "y_mm": ALWAYS,
        "angle_rad": 0.0,
        "mass_kg": ALWAYS,
        "inertia_kg_mm2": None,
        "restitution": 0.0,
        "floor_friction": 0.3,
        "damping_per_s": 0.0,
    },
    "MovingObstacle": {
        "shape": ALWAYS,
        "points_mm": ALWAYS,
        "speed_mm_s": ALWAYS,
        "closed": False,
        "pause_s": 0.0,
        "start_s": 0.0,
        "random_start": False,
        "angle_rad": 0.0,
    },
    "Rays": {
        "count": ALWAYS,
        "range_mm": 1000.0,
        "noise_std_mm": 0.0,
        "period_s": None,
        "first_angle_rad": 0.0,
    },
    "Neighbour": {"range_mm": ALWAYS},
    "Limiter": {"limits": {}, "spacing": None, "supervisor": None, "lead_s": 0.0},
    "TwistLimits": {
        "forward_error_mm": None,
        "lateral_error_mm": None,
        "braking_error_mm": None,
        "acceleration_mm_s2": None,
        "yaw_acceleration_rad_s2": None,
        "yaw_rate_rad_s": None,
        "lateral_acceleration_mm_s2": None,
        "turning_acceleration_mm_s2": None,
        "free_speed_mm_s": 0.0,
        "free_reach_mm": 30.0,
        "reverse_mm_s": None,
        "closing_deceleration_mm_s2": None,
        "closing_speed_mm_s": 20.0,
        "cancel_slip": False,
    },
    "Spacing": {
        "distance_mm": ALWAYS,
        "gain_per_s": ALWAYS,
        "braking_mm_s2": ALWAYS,
        "outline_offset_mm": ALWAYS,
    },
    "Supervisor": {
        "distance_mm": ALWAYS,
        "braking_mm_s2": ALWAYS,
        "horizon_s": ALWAYS,
        "clearing_mm_s": ALWAYS,
        "outline_offset_mm": ALWAYS,
    },
    "Constant": {"type": ALWAYS, "value": ALWAYS},
    "Step": {"type": ALWAYS, "value": ALWAYS, "at_s": ALWAYS, "before": None},
    "Impulse": {
        "type": ALWAYS,
        "value": ALWAYS,
        "at_s": ALWAYS,
        "duration_s": ALWAYS,
        "rest": None,
    },
    "Sine": {
        "type": ALWAYS,
        "amplitude": ALWAYS,
        "frequency_hz": ALWAYS,
        "phase_rad": 0.0,
        "random_phase": False,
        "mean": None,
    },
    "Uniform": {"type": ALWAYS, "low": ALWAYS, "high": ALWAYS, "every_s": None, "ramp_s": 0.0},
    "Gaussian": {"type": ALWAYS, "std": ALWAYS, "every_s": None, "ramp_s": 0.0, "mean": None},
    "BandLimited": {"type": ALWAYS, "std": ALWAYS, "correlation_s": ALWAYS, "mean": None},
    "Pulses": {
        "type": ALWAYS,
        "value": ALWAYS,
        "every_s": ALWAYS,
        "duration_s": ALWAYS,
        "rest": None,
    },
    "RandomWalk": {"type": ALWAYS, "per_sqrt_s": ALWAYS, "start": None},
    "OrnsteinUhlenbeck": {
        "type": ALWAYS,
        "std": ALWAYS,
        "time_constant_s": ALWAYS,
        "mean": None,
    },
    "Lissajous": {
        "type": ALWAYS,
        "centre_x_mm": 0.0,
        "centre_y_mm": 0.0,
        "amplitude_x_mm": ALWAYS,
        "amplitude_y_mm": ALWAYS,
        "rate_x_rad_s": ALWAYS,
        "rate_y_rad_s": ALWAYS,
        "phase_x_rad": 0.0,
        "phase_y_rad": 0.0,
    },
    "Rose": {
        "type": ALWAYS,
        "centre_x_mm": 0.0,
        "centre_y_mm": 0.0,
        "amplitude_x_mm": ALWAYS,
        "amplitude_y_mm": ALWAYS,
        "petals_k": ALWAYS,
        "period_s": ALWAYS,
    },
    "Circle": {
        "type": ALWAYS,
        "centre_x_mm": 0.0,
        "centre_y_mm": 0.0,
        "radius_mm": ALWAYS,
        "period_s": None,
        "speed_mm_s": None,
        "direction": "counterclockwise",
        "phase_rad": 0.0,
    },
    "Waypoints": {"type": ALWAYS, "file": None, "points": ALWAYS},
    "StopAndGo": {
        "type": ALWAYS,
        "path": ALWAYS,
        "drive_s": ALWAYS,
        "stop_s": ALWAYS,
        "ramp_s": ALWAYS,
    },
}


def scenario_hash(scenario: Scenario) -> str:
    """Twelve hexadecimal digits over :func:`difference`: everything about an episode but seed and code."""
    text = json.dumps(difference(scenario), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def difference(scenario: Scenario) -> dict[str, Any]:
    """The fields in which a scenario differs from the neutral values, nested, as JSON values.

    A sequence that differs is given whole; the models in it are given by their differences.
    """
    found: dict[str, Any] = _counted(scenario, ALWAYS)
    return found


def neutral_values(model: type[BaseModel]) -> dict[str, Any]:
    """Neutral value of every field of a model; :data:`ALWAYS` for a field without an entry."""
    names = [base.__name__ for base in reversed(model.__mro__)]
    known: dict[str, Any] = {}
    for name in names:
        known |= NEUTRAL.get(name, {})
    if "Disturbance" in names:
        for channel in CHANNELS:
            group, field = channel.path.split(".")
            constant = {"type": "constant", "value": channel.nominal}
            known[group] = known.get(group, {}) | {field: constant}
    return {field: known.get(field, ALWAYS) for field in model.model_fields}


def _counted(value: Any, neutral: Any) -> Any:
    """The part of a value that counts, as a JSON value; ``Mark.ABSENT`` if the whole value is neutral."""
    if isinstance(value, BaseModel):
        known = neutral_values(type(value))
        in_union = "type" in known  # such a model is neutral as a whole or not at all
        if isinstance(neutral, Mapping) and not in_union:
            known |= neutral
        part = _counted_items({name: getattr(value, name) for name in known}, known)
        unchanged = part == (neutral if in_union else {})
        return Mark.ABSENT if isinstance(neutral, Mapping) and unchanged else part
    if isinstance(value, Mapping) and isinstance(neutral, Mapping):
        weights = dict.fromkeys(value, 0.0)  # of reward terms that have no entry
        return _counted_items(value, weights | dict(neutral)) or Mark.ABSENT
    plain = _plain(value)
    same = plain == neutral and isinstance(plain, bool) == isinstance(neutral, bool)
    return Mark.ABSENT if same else plain


def _counted_items(values: Mapping[str, Any], neutrals: Mapping[str, Any]) -> dict[str, Any]:
    parts = {name: _counted(value, neutrals.get(name, ALWAYS)) for name, value in values.items()}
    return {name: part for name, part in parts.items() if part is not Mark.ABSENT}


def _plain(value: Any) -> Any:
    """A value as a JSON value; the models in a sequence by their differences."""
    if isinstance(value, BaseModel):
        return _counted(value, ALWAYS)
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    return dict(value) if isinstance(value, Mapping) else value
