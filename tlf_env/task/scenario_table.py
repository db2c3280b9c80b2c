"""The page on the fields of a scenario, made from the models.

``python -m tlf_env.task.scenario_table > docs/scenario.md`` writes it. A test compares it with the committed
page.
"""

from __future__ import annotations

import re
import types
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from tlf_env.disturbances.model import Disturbance
from tlf_env.disturbances.table import unit as unit_in
from tlf_env.onboard.estimator import EkfParameters
from tlf_env.onboard.gyro_estimator import GyroEkfParameters
from tlf_env.onboard.limiter import TwistLimits
from tlf_env.onboard.limiters import Limiter
from tlf_env.onboard.observer import ObserverParameters
from tlf_env.onboard.rays import Rays
from tlf_env.onboard.slip_estimator import SlipEkfParameters
from tlf_env.onboard.spacing import Spacing
from tlf_env.onboard.supervisor import Neighbour, Supervisor
from tlf_env.onboard.wheel_loop import WheelLoopParameters
from tlf_env.physics.vehicle import FrictionCurve, JointFriction, RobotParameters
from tlf_env.physics.world import World
from tlf_env.task.reward import DEFAULT_WEIGHTS, REWARD_MEANINGS
from tlf_env.task.scenario import PartPath, Scenario
from tlf_env.task.start import OPTIONS, PHASE_LIMIT_S, START_POSE_LIMIT_MM
from tlf_env.task.trajectories import Circle, Lissajous, Rose, StopAndGo, Waypoints

HEAD = ("field", "type and range", "unit", "default", "meaning", "where it acts")
NONE = "–"  # the unit of a text, a switch or a mapping
# Endings beside those of a channel's name, each before the endings that it contains.
UNITS = {
    "_mm2_s3": "mm²/s³",
    "_rad2_s3": "rad²/s³",
    "_mm2_s": "mm²/s",
    "_rad2_s": "rad²/s",
    "_mm_s2": "mm/s²",
    "_rad_s2": "rad/s²",
    "_Nmm_s": "N·mm/(rad/s)",
    "_kg_mm2": "kg·mm²",
    "_mm2": "mm²",
}
# Units that no ending says.
UNITS_OF_FIELDS = {
    ("Scenario", "action_range"): "mm/s, rad/s",
    ("WheelLoopParameters", "zeros_1"): "1/s",
    ("WheelLoopParameters", "zeros_0"): "1/s²",
    ("EkfParameters", "alpha_1"): "mm/mm",
    ("EkfParameters", "alpha_2"): "mm/rad",
    ("EkfParameters", "alpha_3"): "rad/mm",
    ("EkfParameters", "alpha_4"): "rad/rad",
    ("Waypoints", "points"): "s, mm, mm",
}
# Models with pages of their own.
PAGES: dict[type[BaseModel], str] = {
    World: "[world.md](world.md)",
    Disturbance: "[disturbances.md](disturbances.md)",
}
# Their defaults in a word.
DEFAULTS: dict[type[BaseModel], str] = {World: "empty", Disturbance: "nominal"}
# Fields that may also be the name of a preset or a file.
BY_NAME = ("trajectory", "world", "disturbance", "limiter")
GROUPS = {
    "Task": ("name", "trajectory", "start_ramp_s", "time_gap_s", "start_spacing_mm"),
    "Time": ("horizon_s", "control_period_s", "physics_period_s"),
    "Plant and robots": ("plant", "robots", "robot", "world"),
    "On board": (
        *("estimator", "ekf", "ekf_slip", "ekf_gyro", "wheel_loop", "observer"),
        "broadcast_smoothing_s",
    ),
    "Disturbance": ("disturbance", "adversary"),
    "Action": (
        *("action", "action_range", "tracking_fade_mm", "limiter", "residual_base"),
        *("residual_fade_mm", "residual_reach_mm"),
    ),
    "Observation": ("observation", "preview_s", "rays", "neighbour", "dtype"),
    "Reward": ("reward", "cooperative"),
    "End": ("end_on", "lost_beyond_mm"),
}
CENTRE = {
    "centre_x_mm": "x₀, added to every point of the path",
    "centre_y_mm": "y₀, added to every point of the path",
}
TYPE = "chooses this shape; has to be given"
CURVE = {
    "mu_static": "friction coefficient up to `stiction_speed_mm_s`",
    "mu_dynamic": "friction coefficient from `dynamic_speed_mm_s` on; at most `mu_static`",
    "stiction_speed_mm_s": "speed v_s up to which static friction applies",
    "dynamic_speed_mm_s": "speed v_d from which dynamic friction applies; above `stiction_speed_mm_s`",
}
BOUND = "; part of a controller's file: in a limiter it must be null"
FIXES = {
    "fix_variance_mm2": "variance of each coordinate of a position fix, at the start",
    "fix_variance_time_s": "averaging time of the adapted variance of the fixes; null: it stays constant",
    "least_fix_variance_mm2": "smallest variance that a fix counts with",
    "fix_variance_factor": "factor on the adapted variance, for errors outside the model",
}
# What each field means, by model, in the order of the page.
MEANINGS: dict[str, dict[str, str]] = {
    "Scenario": {
        "name": "name in Gymnasium's ids, in tables and in folders of runs; 1 to 100 letters, digits or "
        "`_ . + -`, the first a letter, a digit or `_`",
        "trajectory": "course of the leader's reference; a preset or a file is another scenario, whose "
        "trajectory it takes, or a CSV file of waypoints",
        "start_ramp_s": "time in which the leader's reference gets from rest to the speed of its trajectory; "
        "0: at once",
        "time_gap_s": "a follower should be where its predecessor was this time ago; a multiple of "
        "`control_period_s`",
        "start_spacing_mm": "distance between neighbours at the start, on the tangent behind the leader; at "
        "least 1 mm more than twice the largest outline radius",
        "horizon_s": "length of an episode, after which all robots are truncated; a multiple of "
        "`control_period_s`",
        "control_period_s": "time between two actions; a multiple of `physics_period_s`",
        "physics_period_s": "substep of plant, sensors, estimator and wheel loop",
        "plant": "what moves the robots: `pymunk` is the exact kernel, with contact in a pymunk space; `batch` "
        "the kernel alone; `kinematic` the wheels' commands; `chipmunk` pymunk's own bodies and constraints",
        "robots": "number of robots, or a mapping for each with what differs from `robot`",
        "robot": "parameters that the robots share",
        "world": "walls, obstacles, bodies to push, moving obstacles, patches of the floor",
        "estimator": "source of a robot's pose: `ekf` is the paper's filter, `ekf-slip` also estimates slip, "
        "`ekf-gyro` also uses gyro and torques, `truth` is the true state; or "
        "[a part in Python](parts.md#estimator)",
        "ekf": "parameters of the estimator `ekf`",
        "ekf_slip": "parameters of the estimator `ekf-slip`",
        "ekf_gyro": "parameters of the estimator `ekf-gyro`",
        "wheel_loop": "speed controller of each drive wheel, or [a part in Python](parts.md#wheel-loop); the "
        "action `torque` bypasses it",
        "observer": "makes a follower's reference from the delayed messages of its predecessor, eqs (42)–(51); "
        "or [a part in Python](parts.md#observer)",
        "broadcast_smoothing_s": "a robot sends, beside its pose now, that of this time ago, from the position "
        "fixes of this time before and after; 0: only its pose now; null: 0.1 s, or what the time gap leaves "
        "room for",
        "disturbance": "deviations of the disturbance channels from nominal, and their level",
        "adversary": "whether a caller may set disturbance channels at every step; not on the plant `batch`",
        "action": "meaning of an action, see [actions](environment.md#actions); learners of `gymnasium.make`, "
        "`make_vec` and `FormationVecEnv` have `tracking_twist` unless the scenario says otherwise",
        "action_range": "what 1.0 means in the actions `residual` and `tracking_twist`; null: 150 mm/s and "
        "1 rad/s, 100 mm/s and 1 rad/s",
        "tracking_fade_mm": "estimated position error at which `tracking_twist` has half its range; 0: all of "
        "it everywhere; null: 10 mm",
        "limiter": "law behind the actions `twist`, `wheel_speed` and `tracking_twist`, and behind a "
        "`residual` on a policy in Python; null: the preset `approach` for `tracking_twist`, no limits for "
        "the others",
        "residual_base": "what the action `residual` is added to: a controller's preset or file, or a policy "
        "in Python, `module:factory`",
        "residual_fade_mm": "estimated position error below which a residual's weight decreases, with half at "
        "this error; 0: it does not",
        "residual_reach_mm": "estimated position error above which a residual's weight decreases, with half at "
        "this error; null: it does not",
        "observation": "`tracking`: errors, reference and messages from the robot's own estimate; `sensor`: "
        "the sensors' readings of each substep; see [observations](environment.md#observations)",
        "preview_s": "times ahead at which `tracking` contains the reference; different multiples of "
        "`control_period_s`, at most `time_gap_s`",
        "rays": "range sensors of every robot, at the end of the observation; null: none",
        "neighbour": "reception of one more robot than the predecessor, in the observation `tracking`; null: "
        "only the predecessor",
        "dtype": "type of the numbers in observations and actions",
        "reward": "weights of the reward's terms; terms that are left out keep their default",
        "cooperative": "whether every robot receives the formation's mean reward",
        "end_on": "events that end the episode of the formation",
        "lost_beyond_mm": "true position error to its own reference beyond which a robot is lost",
    },
    "RobotParameters": {
        "mass_kg": "mass of the whole robot, without payload",
        "body_inertia_kg_mm2": "moment of inertia about the centre of mass",
        "com_offset_mm": "how far the centre of mass lies behind c, the midpoint of the axle; must be "
        "`castor_load_share` · (`castor_pivot_mm` + `castor_trail_mm`)",
        "gravity_mm_s2": "gravitational acceleration, from which the loads of the wheels follow",
        "drive_load_share": "share of the weight on each drive wheel; twice it and `castor_load_share` add up "
        "to 1",
        "castor_load_share": "share of the weight on the castor",
        "wheel_radius_mm": "radius of the drive wheels",
        "axle_width_mm": "distance between the drive wheels",
        "wheel_inertia_kg_mm2": "moment of inertia of a drive wheel about its axle",
        "torque_limit_Nmm": "largest torque of each motor, in both directions",
        "castor_pivot_mm": "how far the pivot of the castor's fork lies behind c",
        "castor_trail_mm": "distance from the castor's pivot to where it touches the floor",
        "castor_radius_mm": "radius of the castor's wheel",
        "castor_inertia_kg_mm2": "moment of inertia of the castor's wheel about its axle",
        "fork_inertia_kg_mm2": "moment of inertia of the castor's fork about its pivot",
        "outline_radius_mm": "radius of the outline, a circle; of the circle around a polygon",
        "outline_offset_mm": "how far the centre of that circle lies behind c",
        "outline_polygon_mm": "a convex polygon as outline: corners (right, forward) of c, in order; without "
        "radius and offset, those of a circle around it are taken",
        "outline_restitution": "share of the approach speed that a contact returns; a factor, see "
        "[contact](world.md#contact)",
        "outline_friction": "coefficient of Coulomb friction of a contact; a factor",
        "tyre": "friction of each tyre on the floor",
        "drive_joint": "friction of each drive wheel's axle",
        "castor_joint": "friction of the castor wheel's axle",
        "steering_joint": "friction of the castor's pivot",
        "joint_friction": "whether the joints have friction, eq. (5)",
    },
    "FrictionCurve": CURVE,
    "JointFriction": {
        **CURVE,
        "friction_arm_mm": "R_n, lever of the axial force",
        "pin_radius_mm": "R_p, lever of the radial force",
        "bending_arm_mm": "R_b: the bending moment counts with R_p/R_b",
        "preload_Nmm": "T_pre, which is multiplied by the friction coefficient, too",
        "bending": "whether the bending moment causes friction",
    },
    "WheelLoopParameters": {
        "gain_Nmm_s": "k, torque per speed error at high frequencies",
        "zeros_1": "a₁ of the numerator s² + a₁ s + a₀",
        "zeros_0": "a₀ of the numerator",
        "pole_rad_s": "p of the denominator s (s + p)",
        "speed_observer_rad_s": "bandwidth of the [observer](controller/wheel-speeds.md) that measures the "
        "wheel speeds; null: the difference of two encoder readings",
    },
    "EkfParameters": {
        "alpha_1": "standard deviation of the noise of the advance, per advance",
        "alpha_2": "standard deviation of the noise of the advance, per turn",
        "alpha_3": "standard deviation of the noise of the turn, per advance",
        "alpha_4": "standard deviation of the noise of the turn, per turn",
        "fix_variance_mm2": "variance of each coordinate of a position fix, σ_m² of eq. (37)",
    },
    "SlipEkfParameters": {
        "forward_noise_mm2_s": "process noise of the position along the heading",
        "sideways_noise_mm2_s": "process noise of the position across the heading",
        "heading_noise_rad2_s": "process noise of the heading",
        "delta_1_walk_mm2_s3": "random walk of the forward slip δ₁",
        "delta_2_walk_rad2_s3": "random walk of the yaw slip δ₂",
        **FIXES,
        "delta_1_bound_mm_s": "bound of the size of δ₁",
        "delta_2_bound_rad_s": "bound of the size of δ₂",
        "surprise_time_s": "averaging time of the innovations in the innovation test",
        "surprise_threshold": "squared mean innovation, divided by its variance from the fixes' noise alone, "
        "up to which surprise is 0; each further threshold adds 1; null: surprise is always 0",
        "most_surprise": "largest surprise",
        "surprise_speed_mm_s": "speed below which surprise decreases with the square of the speed",
        "heading_surprise_rad2_s": "process noise of the heading per surprise sideways",
        "delta_1_surprise_mm2_s3": "random walk of δ₁ per surprise along the heading",
        "delta_2_surprise_rad2_s3": "random walk of δ₂ per surprise sideways",
        "most_acceleration_mm_s2": "acceleration of the wheels' mean speed above which a change counts as slip "
        "of the floor or spin; null: it is not tested",
        "most_yaw_acceleration_rad_s2": "the same of the wheels' yaw rate; null: it is not tested",
        "grip_mm_s2": "acceleration with which the body follows wheels that spin",
        "yaw_grip_rad_s2": "the same in yaw",
        "jump_uncertainty": "standard deviation of a jump of slip that the wheel speeds show, relative to the "
        "jump",
    },
    "GyroEkfParameters": {
        "forward_noise_mm2_s": "process noise of the position along the heading",
        "sideways_noise_mm2_s": "process noise of the position across the heading",
        "heading_noise_rad2_s": "process noise of the heading, by the gyro's noise",
        "gyro_walk_rad2_s3": "random walk of the gyro's error, its bias",
        "gyro_error_bound_rad_s": "bound of the size of that error",
        "gyro_scale_std": "standard deviation of the error of the gyro's scale, at the start",
        "gyro_scale_bound": "bound of the size of that error",
        "torque_time_s": "time constant with which the speed from the torques returns to that of the encoders; "
        "null: the speed is that of the encoders",
        "speed_walk_mm2_s3": "random walk of the speed's error",
        "speed_error_bound_mm_s": "bound of the size of that error",
        **FIXES,
        "outlier_threshold": "normalised innovation squared above which the weight of a fix is reduced; null: "
        "never",
        "slip_time_s": "averaging time of δ₁ and δ₂, against the encoders' noise",
        "delta_1_bound_mm_s": "bound of the size of the reported forward slip δ₁",
        "delta_2_bound_rad_s": "bound of the size of the reported yaw slip δ₂",
        "floor_slip_acceleration_mm_s2": "acceleration above which a sample does not count in the average slip "
        "of the floor; below half of it, it counts fully; null: all slip is reported",
        "floor_slip_mm_s": "average of the size of δ₁ above which slip is reported; in full from twice that on",
        "floor_slip_rad_s": "the same of δ₂; one of both is enough",
        "floor_slip_rise_s": "averaging time of slip of the floor that grows",
        "floor_slip_decay_s": "averaging time of slip of the floor that shrinks",
    },
    "ObserverParameters": {
        "gain_per_s": "gain b = b₁ = b₂ = b₃ of the observer's pose errors, eq. (43)",
        "smoothing_s": "time from the start of the episode in which the observer's rates rise from 0 to full, "
        "eq. (51)",
    },
    "Limiter": {
        "limits": "limits of the twist",
        "spacing": "distance to the predecessor; null: none is kept",
        "supervisor": "slows down for the neighbour; needs the scenario's `neighbour`; null: none",
        "lead_s": "how far ahead in time the action `tracking_twist` takes the reference's twist, interpolated "
        "to the first preview, which must then be above 0",
    },
    "TwistLimits": {
        "acceleration_mm_s2": "largest change of the forward speed u₁; null: not limited",
        "turning_acceleration_mm_s2": "the same where |u₁ u₂| is at `lateral_acceleration_mm_s2`; between, "
        "it decreases with the square of |u₁ u₂|; null: as on a straight",
        "yaw_acceleration_rad_s2": "largest change of the yaw rate u₂; null: not limited",
        "yaw_rate_rad_s": "largest |u₂|; null: not limited",
        "lateral_acceleration_mm_s2": "largest |u₁ u₂|: speed above the reference's is reduced first, then the "
        "yaw rate; null: not limited",
        "free_speed_mm_s": "changes of u₁ within this of the reference's speed are not limited, while the "
        "position error is well below `free_reach_mm`",
        "free_reach_mm": "estimated position error at which that range is half as wide",
        "reverse_mm_s": "largest speed backward; null: not limited",
        "closing_deceleration_mm_s2": "a: u₁ exceeds the reference's speed at most by √(v² + 2 a e₁), e₁ the "
        "forward error, so that braking with a is enough; null: not limited",
        "closing_speed_mm_s": "v: by how much u₁ may exceed the reference's speed on arrival",
        "cancel_slip": "whether the estimated slip is subtracted from the wheels' twist",
        "forward_error_mm": "bound E of the forward error, e₁ becomes E·tanh(e₁/E)" + BOUND,
        "lateral_error_mm": "the same of the lateral error e₂" + BOUND,
        "braking_error_mm": "w: before that, e₁ beyond w becomes √(w(2e₁ − w))" + BOUND,
    },
    "Spacing": {
        "distance_mm": "distance of the outlines' centres that is kept",
        "gain_per_s": "largest approach speed per distance beyond that, near it",
        "braking_mm_s2": "farther away, deceleration that can stop the approach",
        "outline_offset_mm": "how far the outlines' centres lie behind c",
    },
    "Supervisor": {
        "distance_mm": "distance of the outlines' centres that is kept",
        "braking_mm_s2": "rate at which the robot is assumed to change its speed",
        "horizon_s": "time over which both motions are predicted",
        "clearing_mm_s": "largest speed with which the robot clears the way, straight ahead, where slowing "
        "down does not keep the distance; 0: it only slows down",
        "outline_offset_mm": "how far the outlines' centres lie behind c",
    },
    "Rays": {
        "count": "number of rays, at equal angles",
        "range_mm": "largest reading, from the centre of the outline",
        "noise_std_mm": "standard deviation of the white noise of each reading",
        "period_s": "time between two readings, of which the last holds; a multiple of `control_period_s`; "
        "null: one control period",
        "first_angle_rad": "angle of the first ray from forward; the others follow counter-clockwise",
    },
    "Neighbour": {
        "range_mm": "distance within which a robot hears the nearest robot with a smaller number, its "
        "predecessor left out",
    },
    "Lissajous": {
        "type": TYPE,
        "amplitude_x_mm": "A of x = A sin(a t + α) + x₀",
        "amplitude_y_mm": "B of y = B sin(b t + β) + y₀",
        "rate_x_rad_s": "angular frequency a of x",
        "rate_y_rad_s": "angular frequency b of y",
        "phase_x_rad": "phase α of x",
        "phase_y_rad": "phase β of y",
        **CENTRE,
    },
    "Rose": {
        "type": TYPE,
        "amplitude_x_mm": "A of x = A cos(k s) sin s + x₀",
        "amplitude_y_mm": "B of y = −B cos(k s) cos s + y₀",
        "petals_k": "k: an even integer gives 2k petals, an odd one k",
        "period_s": "time in which s = 2πt/period grows by 2π",
        **CENTRE,
    },
    "Circle": {
        "type": TYPE,
        "radius_mm": "radius of the path",
        "period_s": "time of one lap; either this or `speed_mm_s`",
        "speed_mm_s": "speed along the path; either this or `period_s`",
        "direction": "sense of the motion, seen from above",
        "phase_rad": "angle of the start as seen from the centre, from +x",
        **CENTRE,
    },
    "Waypoints": {
        "type": TYPE,
        "file": "CSV file with the header `t_s,x_mm,y_mm`, read into `points`; either this or `points`",
        "points": "2 to 100000 points (t, x, y), with increasing times; either this or `file`",
    },
    "StopAndGo": {
        "type": TYPE,
        "path": "the trajectory that is driven",
        "drive_s": "duration of a drive, with both ramps",
        "stop_s": "duration of a stop",
        "ramp_s": "time from rest to the speed of the path, and back; at most half of `drive_s`",
    },
}
# Where the fields of a model act, as rooms or files of tlf_env, and the fields that act elsewhere.
PLACES = {
    "RobotParameters": "physics",
    "FrictionCurve": "physics/friction.py",
    "JointFriction": "physics/friction_limits.py",
    "WheelLoopParameters": "onboard/wheel_loop.py",
    "EkfParameters": "onboard/estimator.py",
    "SlipEkfParameters": "onboard/slip_estimator.py",
    "GyroEkfParameters": "onboard/gyro_estimator.py",
    "ObserverParameters": "onboard/observer.py",
    "TwistLimits": "onboard/limiter.py",
    "Spacing": "onboard/spacing.py",
    "Supervisor": "onboard/supervisor.py",
    "Rays": "engine/rays.py",
    "Neighbour": "engine/radio.py",
    **dict.fromkeys(("Lissajous", "Rose", "Circle", "StopAndGo"), "task/trajectories.py"),
    "Waypoints": "task/waypoints.py",
}
PLACES_OF_FIELDS = {
    "Scenario": {
        "name": "envs",
        "trajectory": "task/trajectories.py",
        "start_ramp_s": "task/trajectories.py",
        "time_gap_s": "engine/radio.py",
        "start_spacing_mm": "engine/starting.py",
        "horizon_s": "engine",
        "control_period_s": "engine",
        "physics_period_s": "engine",
        "plant": "engine",
        "robots": "engine",
        "robot": "physics",
        "world": "physics/world.py",
        "estimator": "onboard",
        "ekf": "onboard/estimator.py",
        "ekf_slip": "onboard/slip_estimator.py",
        "ekf_gyro": "onboard/gyro_estimator.py",
        "wheel_loop": "onboard/wheel_loop.py",
        "observer": "onboard/observer.py",
        "broadcast_smoothing_s": "engine/smoothing.py",
        "disturbance": "disturbances",
        "adversary": "engine/effects.py",
        "action": "task/actions.py",
        "action_range": "engine/drivers.py",
        "tracking_fade_mm": "task/actions.py",
        "limiter": "onboard/limiters.py",
        "residual_base": "task/actions.py",
        "residual_fade_mm": "task/actions.py",
        "residual_reach_mm": "task/actions.py",
        "observation": "task/observation.py",
        "preview_s": "task/observation.py",
        "rays": "engine/rays.py",
        "neighbour": "engine/radio.py",
        "dtype": "engine/arrays.py",
        "reward": "task/reward.py",
        "cooperative": "engine/drivers.py",
        "end_on": "engine/judging.py",
        "lost_beyond_mm": "engine/judging.py",
    },
    "RobotParameters": {
        "torque_limit_Nmm": "engine/substeps.py",
        **dict.fromkeys(
            ("outline_radius_mm", "outline_offset_mm", "outline_polygon_mm"), "engine/outlines.py"
        ),
        **dict.fromkeys(("outline_restitution", "outline_friction"), "physics/pymunk_plant.py"),
        "tyre": "physics/friction.py",
        **dict.fromkeys(
            ("drive_joint", "castor_joint", "steering_joint", "joint_friction"),
            "physics/friction_limits.py",
        ),
    },
    "WheelLoopParameters": {"speed_observer_rad_s": "onboard/speed_observer.py"},
    "Limiter": {
        "limits": "onboard/limiter.py",
        "spacing": "onboard/spacing.py",
        "supervisor": "onboard/supervisor.py",
        "lead_s": "task/actions.py",
    },
    "TwistLimits": dict.fromkeys(
        ("forward_error_mm", "lateral_error_mm", "braking_error_mm"), "task/actions.py"
    ),
}


class Option(NamedTuple):
    """An option of ``reset``: the cells of its row."""

    allowed: str
    unit: str
    default: str
    meaning: str
    place: str


RESET_OPTIONS = {
    "poses": Option(
        f"a row of 3 numbers for each robot, each within ±{START_POSE_LIMIT_MM:.0e}".replace(
            "+", ""
        ),
        "mm, mm, rad",
        "none",
        "start poses (x, y, θ) of c, at rest; without it the leader stands on its reference and the others "
        "behind it, scattered by the disturbance",
        "engine/starting.py",
    ),
    "phase_s": Option(
        f"number within ±{PHASE_LIMIT_S:.0e}".replace("+0", ""),
        "s",
        "0",
        "time on its trajectory at which the leader's reference starts",
        "engine/formation.py",
    ),
}


class Section(NamedTuple):
    """A model's section: its title, where in a scenario the model is, and a text before the table."""

    title: str
    model: type[BaseModel]
    text: str
    # What the scenario has there by default, if that differs from the model's own defaults.
    given: tuple[BaseModel, ...] = ()


ROBOT = RobotParameters()
SECTIONS = (
    Section(
        "Robot",
        RobotParameters,
        "The fields of `robot`, and of each entry of a list `robots`. [physics.md](physics.md) has a drawing "
        "of the robot.",
    ),
    Section("Tyre", FrictionCurve, "The fields of `robot.tyre`.", (ROBOT.tyre,)),
    Section(
        "Joints",
        JointFriction,
        "The fields of `robot.drive_joint`, `robot.castor_joint` and `robot.steering_joint`, with their "
        "defaults in this\norder; one value holds for all three. The law is "
        "[eq. (5)](physics.md#friction-laws).",
        (ROBOT.drive_joint, ROBOT.castor_joint, ROBOT.steering_joint),
    ),
    Section(
        "Wheel loop",
        WheelLoopParameters,
        "The fields of `wheel_loop`: K(s) = k (s² + a₁ s + a₀) / (s (s + p)), eq. (13).",
    ),
    Section(
        "Filter ekf",
        EkfParameters,
        "The fields of `ekf`: noise of eqs (36) and (37). Advance and turn are those of one "
        "`physics_period_s`.",
    ),
    Section(
        "Filter ekf_slip",
        SlipEkfParameters,
        "The fields of `ekf_slip`, see [slip-aware estimator](controller/slip-estimator.md). Noise is variance "
        "per second.",
    ),
    Section(
        "Filter ekf_gyro",
        GyroEkfParameters,
        "The fields of `ekf_gyro`, see [estimator with gyro and torques](controller/gyro-estimator.md). "
        "Noise is variance per\nsecond.",
    ),
    Section("Observer", ObserverParameters, "The fields of `observer`."),
    Section(
        "Limiter",
        Limiter,
        "The fields of `limiter`. Without any of them it limits nothing. [Presets](systems.md#limiters) have "
        "other values.",
    ),
    Section(
        "Limits",
        TwistLimits,
        "The fields of `limiter.limits`, see [limits](controller/limits-and-spacing.md#limits). "
        "u₁ and u₂ are the forward speed\nand the yaw rate of the body.",
    ),
    Section(
        "Spacing",
        Spacing,
        "The fields of `limiter.spacing`, see "
        "[distance to the predecessor](controller/limits-and-spacing.md#distance-to-the-predecessor).",
    ),
    Section(
        "Supervisor",
        Supervisor,
        "The fields of `limiter.supervisor`, see [supervisor](controller/supervisor.md).",
    ),
    Section(
        "Rays", Rays, "The fields of `rays`, see [range sensors](environment.md#range-sensors)."
    ),
    Section(
        "Neighbour",
        Neighbour,
        "The fields of `neighbour`, see "
        "[hearing beyond the predecessor](environment.md#hearing-beyond-the-predecessor).",
    ),
    Section(
        "Lissajous",
        Lissajous,
        "The fields of `trajectory` with `type: lissajous`, see [lissajous](trajectories.md#lissajous).",
    ),
    Section(
        "Rose",
        Rose,
        "The fields of `trajectory` with `type: rose`, see [rose](trajectories.md#rose).",
    ),
    Section(
        "Circle",
        Circle,
        "The fields of `trajectory` with `type: circle`, see [circle](trajectories.md#circle).",
    ),
    Section(
        "Waypoints",
        Waypoints,
        "The fields of `trajectory` with `type: waypoints`, see [waypoints](trajectories.md#waypoints).",
    ),
    Section(
        "Stop and go",
        StopAndGo,
        "The fields of `trajectory` with `type: stop_and_go`, see [stop_and_go](trajectories.md#stop_and_go).",
    ),
)
INTRODUCTION = """# The fields of a scenario

Generated by `python -m tlf_env.task.scenario_table > docs/scenario.md`.

A scenario is everything that an episode depends on, except its seed. Its fields come from a preset (a YAML file
shipped in `configs/`, used by name), a YAML file, a mapping or keywords:

```python
import tlf_env

env = tlf_env.parallel_env("infinity", robots=5, robot={"mass_kg": 1.5}, disturbance="slip")
```

`base: infinity` in a file or a mapping builds on another scenario: mappings are merged, all else is replaced
([environment.md](environment.md)). A scenario that is not built on another has to give its `trajectory`.

On the command line, `tlf show infinity` prints a whole scenario, and `tlf show infinity --changes` what differs
from the defaults. `tlf run infinity --set PATH=VALUE` sets any field by its path, and may set several:

```console
tlf run infinity --set disturbance.slip.delta_1_mm_s=20 --set robot.mass_kg=1.5
```

Unknown fields are refused, with their path and, if there is one, the nearest name.

`null` is YAML's word for Python's `None`. A default is that of the field itself; presets set other values. The
unit 1 is that of a number without unit. "Where it acts" is a room or a file of `tlf_env`. Ranges that depend on
other fields are in the meaning."""


def scenario_models() -> list[type[BaseModel]]:
    """The scenario and all models in it, except those with a page of their own."""
    found: list[type[BaseModel]] = []
    waiting: list[type[BaseModel]] = [Scenario]
    while waiting:
        model = waiting.pop(0)
        if model in found or model in PAGES:
            continue
        found.append(model)
        for field in model.model_fields.values():
            waiting += _models_in(field.annotation)
    return found


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    # A Literal's arguments are texts, in which there is nothing.
    return [model for one in get_args(annotation) for model in _models_in(one)]


def check(meanings: Mapping[str, Mapping[str, str]]) -> None:
    """Check that the page has every field once.

    Raises
    ------
    ValueError
        for a model without a section, a field without a meaning, a meaning without a field, and a field or
        option without a group or place.
    """
    models = {model.__name__: model for model in scenario_models()}
    _same("sections of models", models, ["Scenario", *(one.model.__name__ for one in SECTIONS)])
    _same("meanings of models", models, meanings)
    for name, model in models.items():
        _same(f"meanings of {name}", model.model_fields, meanings[name])
        placed = PLACES_OF_FIELDS.get(name, {})
        _same(
            f"places of {name}",
            model.model_fields,
            model.model_fields if name in PLACES else placed,
        )
        _same(f"places of {name}", [*model.model_fields, *placed], model.model_fields)
    _same(
        "groups of Scenario", Scenario.model_fields, [one for of in GROUPS.values() for one in of]
    )
    _same("options of reset", OPTIONS, RESET_OPTIONS)


def _same(what: str, wanted: Iterable[str], given: Iterable[str]) -> None:
    missing, superfluous = set(wanted) - set(given), set(given) - set(wanted)
    if missing or superfluous:
        raise ValueError(f"{what}: missing {sorted(missing)}, superfluous {sorted(superfluous)}")


def compact(value: float) -> str:
    """A number in its shortest form, as 0.5, 9e-6 or 1e9."""
    short = f"{value:g}"
    text = short if float(short) == value else repr(value)
    return re.sub(r"e([+-])0*(\d)", lambda at: f"e{at[1].strip('+')}{at[2]}", text)


def default_text(value: Any) -> str:
    """A default as in YAML, texts as code."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f"`{value}`"
    if isinstance(value, tuple):
        return f"[{', '.join(map(default_text, value))}]"
    if isinstance(value, BaseModel):
        return DEFAULTS.get(type(value), "see below")
    if isinstance(value, Mapping):
        return "see below"
    return compact(value)


def anchor(model: type[BaseModel]) -> str:
    """A link to a model's section."""
    (title,) = (one.title for one in SECTIONS if one.model is model)
    return f"[{title}](#{title.lower().replace(' ', '-')})"


def _flat(annotation: Any, metadata: Iterable[Any]) -> tuple[Any, list[Any]]:
    """A type without its annotations, and these in one list."""
    found = [
        inner
        for one in metadata
        for inner in (one.metadata if isinstance(one, FieldInfo) else [one])
    ]
    if get_origin(annotation) is Annotated:
        kind, *more = get_args(annotation)
        return _flat(kind, [*more, *found])
    return annotation, found


def bounds(metadata: Iterable[Any]) -> dict[str, float]:
    """The bounds in annotations by their names: ``gt``, ``ge``, ``lt``, ``le``, ``min_length``, ``max_length``.

    Of two lower or two upper bounds only the narrower remains.
    """
    found: dict[str, float] = {}
    for one in metadata:
        for name in ("gt", "ge", "lt", "le", "min_length", "max_length"):
            value = getattr(one, name, None)
            if value is not None:
                narrower = max if name in ("gt", "ge", "min_length") else min
                found[name] = narrower(value, found.get(name, value))
    for open_end, closed, sign in (("gt", "ge", 1), ("lt", "le", -1)):
        if open_end in found and closed in found:
            looser = open_end if sign * found[open_end] < sign * found[closed] else closed
            del found[looser]
    return found


def _range(noun: str, within: Mapping[str, float]) -> str:
    if "ge" in within and "le" in within:
        return f"{noun} {compact(within['ge'])} to {compact(within['le'])}".replace(" -", " −")
    signs = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}
    ends = [f"{sign} {compact(within[name])}" for name, sign in signs.items() if name in within]
    return f"{noun} {', '.join(ends)}" if ends else noun


def _plural(words: str) -> str:
    words = words.removeprefix("one of ")
    return re.sub(r"^(whole number|number|mapping|pair|triple)", r"\1s", words)


def _many(annotation: Any, within: Mapping[str, float]) -> str:
    items = get_args(annotation)
    words = _plural(described(items[0]))
    if len(items) == 2 and items[1] is Ellipsis:
        few, most = within.get("min_length"), within.get("max_length")
        return f"list of {words}" if few is None else f"list of {few:g} to {most:g} {words}"
    return f"{ {2: 'pair', 3: 'triple'}[len(items)] } of {words}"


def _links(models: Sequence[type[BaseModel]]) -> str:
    return "mapping, see " + ", ".join(PAGES.get(model) or anchor(model) for model in models)


def described(annotation: Any, metadata: Iterable[Any] = ()) -> str:
    """Type and range of a value in words.

    Raises
    ------
    ValueError
        for a type that this does not know.
    """
    if annotation == PartPath:
        return "`module:factory`"
    kind, found = _flat(annotation, metadata)
    within, origin = bounds(found), get_origin(kind)
    if origin in (types.UnionType, Union):
        several = [one for one in get_args(kind) if one is not type(None)]
        nullable = ["null"] if len(several) < len(get_args(kind)) else []
        models = [one for one in several if isinstance(one, type) and issubclass(one, BaseModel)]
        others = [described(one, found) for one in several if one not in models]
        words = ([_links(models)] if models else []) + others + nullable
        return words[0] if len(words) == 1 else f"{', '.join(words[:-1])}{_or(words)}{words[-1]}"
    if origin is Literal:
        choices = [f"`{one}`" for one in get_args(kind)]
        return choices[0] if len(choices) == 1 else f"one of {', '.join(choices)}"
    if origin is tuple:
        return _many(kind, within)
    if origin is dict:
        return f"mapping of {_plural(described(get_args(kind)[1]))}"
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return _links([kind])
    names = {bool: "true or false", str: "text"}
    if kind in names:
        return names[kind]
    nouns = {int: "whole number", float: "number"}
    if kind in nouns:
        return _range(nouns[kind], within)
    raise ValueError(f"{kind} has no description; add one to tlf_env/task/scenario_table.py")


def _or(words: Sequence[str]) -> str:
    return ", or " if any("," in one for one in words) else " or "


def _has_numbers(annotation: Any) -> bool:
    kind, _ = _flat(annotation, ())
    if get_origin(kind) is dict or get_origin(kind) is Literal:
        return False
    return kind in (int, float) or any(map(_has_numbers, get_args(kind)))


def unit(model: type[BaseModel], name: str) -> str:
    """The unit of a field, from the ending of its name; 1 for a number without one."""
    if not _has_numbers(model.model_fields[name].annotation):
        return NONE
    of_endings = (text for ending, text in UNITS.items() if name.endswith(ending))
    return UNITS_OF_FIELDS.get((model.__name__, name)) or next(of_endings, None) or unit_in(name)


def row(
    model: type[BaseModel], name: str, meaning: str, given: tuple[BaseModel, ...] = ()
) -> tuple[str, ...]:
    """The cells of a field's row."""
    field = model.model_fields[name]
    allowed = described(field.annotation, field.metadata)
    if model is Scenario and name in BY_NAME:
        allowed = f"preset, file or {allowed}"
    if given:
        values = [default_text(getattr(one, name)) for one in given]
    elif field.is_required():
        values = ["required"]
    else:
        values = [default_text(field.get_default(call_default_factory=True))]
    default = values[0] if len(set(values)) == 1 else " / ".join(values)
    place = PLACES_OF_FIELDS.get(model.__name__, {}).get(name) or PLACES[model.__name__]
    return f"`{name}`", allowed, unit(model, name), default, meaning, f"`{place}`"


def table(rows: Iterable[tuple[str, ...]]) -> str:
    """The rows with their head in Markdown."""
    cells = [tuple(cell.replace("|", "\\|") for cell in one) for one in rows]
    lines = [HEAD, tuple("---" for _ in HEAD), *cells]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _weights() -> str:
    rows = [
        (f"`{name}`", "number", "1", compact(weight), REWARD_MEANINGS[name], "`task/reward.py`")
        for name, weight in DEFAULT_WEIGHTS._asdict().items()
    ]
    return (
        "## Reward terms\n\nThe entries of `reward`, the weights of the terms. The meaning is that of the term "
        "before its weight;\ne is the true position error to the robot's own reference.\n\n"
        f"{table(rows)}"
    )


def _options() -> str:
    rows = [
        (f"`{name}`", one.allowed, one.unit, one.default, one.meaning, f"`{one.place}`")
        for name, one in RESET_OPTIONS.items()
    ]
    return (
        "## Options of reset\n\nThe entries of `options` in `reset(seed=..., options={...})`. They hold for "
        "one episode. With several formations\nthe value is the same for all of them or, with one more "
        f"dimension in front, one for each.\n\n{table(rows)}"
    )


def page(meanings: Mapping[str, Mapping[str, str]] = MEANINGS) -> str:
    """The text of ``docs/scenario.md``.

    Raises
    ------
    ValueError
        as :func:`check`.
    """
    check(meanings)
    of_scenario = meanings["Scenario"]
    parts = [INTRODUCTION]
    for title, names in GROUPS.items():
        rows = [row(Scenario, name, of_scenario[name]) for name in names]
        parts.append(f"## {title}\n\n{table(rows)}")
    for title, model, text, given in SECTIONS:
        rows = [
            row(model, name, meaning, given) for name, meaning in meanings[model.__name__].items()
        ]
        parts.append(f"## {title}\n\n{text}\n\n{table(rows)}")
    return "\n\n".join([*parts, _weights(), _options()]) + "\n"


if __name__ == "__main__":
    print(page(), end="")
