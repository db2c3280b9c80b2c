"""The robot's body as the other packages use it: two driven wheels and a castor.

Code outside :mod:`tlf_env.physics` imports everything that is particular to this body from here. A
second body, for example a four-wheel skid-steer, has to supply the same names:

=====================  ==============================================================================
parameters             :class:`RobotParameters`, a validated model; its ``outline_radius_mm`` and
                       ``torque_limit_Nmm`` are used by tasks and pictures
constants              :class:`Body`, one row of numbers per robot, made by :func:`body` and
                       :func:`body_array`
state                  :class:`Motion` (pose and velocities) and :class:`Contact` (the solver's
                       memory, with the slip speeds)
inputs of a substep    two torques, :class:`Floor` and :class:`Push`
substep                :func:`roll` in closed form, and whether it holds; :func:`slide` in every case;
                       :func:`substep` chooses between them; :func:`begin_slide`, :func:`sweep_together`
                       and :func:`end_slide` are ``slide`` for ``SLIDE_COLUMNS`` robots in a table
kinematic substep      :func:`follow_wheels`
pose                   :func:`advance_pose`, :func:`axle_midpoint` (the point c that follows the
                       reference), :func:`forward_and_yaw`
wheels and twist       :func:`odometry` (wheels to twist) and :func:`wheel_speeds` (twist to wheels)
injected slip          :func:`conveyor`, floor speeds under the wheels from δ₁, δ₂ of eq. (14)
payload                :class:`Mass`, the constants that a payload changes, by :func:`laden`
=====================  ==============================================================================

Four more places outside this package depend on the wheels and have to be adapted:
:func:`tlf_env.disturbances.model.wheel_factors` (wheels on friction patches), the inverse dynamics of
:mod:`tlf_env.task.feasibility`, the castor's entry in :class:`tlf_env.task.info.State`, and
:mod:`tlf_env.rendering`. Inside it, :mod:`~tlf_env.physics.linear`, :mod:`~tlf_env.physics.openloop` and
:mod:`~tlf_env.physics.chipmunk_plant` do.
"""

from tlf_env.physics.kernel import (
    SLIDE_COLUMNS,
    SLIDE_ROWS,
    begin_slide,
    end_slide,
    roll,
    slide,
    substep,
)
from tlf_env.physics.kinematics import follow_wheels, odometry, wheel_speeds
from tlf_env.physics.parameters import (
    Body,
    FrictionCurve,
    JointFriction,
    Mass,
    RobotParameters,
    body,
    body_array,
    laden,
)
from tlf_env.physics.sliding import sweep_together
from tlf_env.physics.state import (
    Contact,
    Floor,
    Motion,
    Push,
    advance_pose,
    axle_midpoint,
    conveyor,
    forward_and_yaw,
)

__all__ = [
    "SLIDE_COLUMNS",
    "SLIDE_ROWS",
    "Body",
    "Contact",
    "Floor",
    "FrictionCurve",
    "JointFriction",
    "Mass",
    "Motion",
    "Push",
    "RobotParameters",
    "advance_pose",
    "axle_midpoint",
    "begin_slide",
    "body",
    "body_array",
    "conveyor",
    "end_slide",
    "follow_wheels",
    "forward_and_yaw",
    "laden",
    "odometry",
    "roll",
    "slide",
    "substep",
    "sweep_together",
    "wheel_speeds",
]
