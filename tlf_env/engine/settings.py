"""A scenario's numbers as the compiled drivers take them."""

from __future__ import annotations

import math
from typing import NamedTuple

from tlf_env.disturbances.model import changes_within_episode
from tlf_env.numerics.pointers import by_pointer
from tlf_env.onboard.kinds import ESTIMATOR_CODES, EXTERNAL
from tlf_env.onboard.limiters import behind
from tlf_env.onboard.observer import ObserverParameters
from tlf_env.onboard.rays import Rays
from tlf_env.onboard.supervisor import SupervisorRow, supervisor_row
from tlf_env.onboard.tracking import Controller, ControllerRow, controller_row
from tlf_env.task.measures import TIME_GAP_WINDOW_S
from tlf_env.task.observation import neighbour_place
from tlf_env.task.scenario import Scenario


@by_pointer
class Settings(NamedTuple):
    """Numbers of a scenario that all robots share."""

    kinematic: bool
    by_chipmunk: bool  # pymunk's bodies and constraints move the robots, not the kernel
    collides: bool  # robots that are near are stepped through a space with contact
    round_outlines: bool  # outlines are circles, so that compiled laws can say which touch
    substeps: int
    number: float  # 1, of the precision in which substeps are computed
    dt: float  # physics period, s
    period: float  # control period, s
    gap: int  # control steps of the time gap
    lookahead: int  # control steps of the longest preview
    spacing: float  # mm between neighbours at the start
    window: int  # control steps around one gap ago in which the time gap is measured
    half_window: (
        int  # control steps before and after a moment that a smoothed broadcast uses; 0: none
    )
    observer_gain: float  # 1/s
    smoothing: float  # s
    lost_beyond: float  # mm
    end_on_lost: bool
    end_on_touched: bool
    estimator: int  # EKF, TRUTH, EXTERNAL, EKF_SLIP or EKF_GYRO
    has_parts: bool  # objects in Python that are called between the substeps
    external_wheel_loop: bool
    external_observer: bool
    ray_range: float  # mm
    ray_noise: float  # standard deviation, mm
    ray_period: int  # control steps from a reading of the range sensors to the next
    neighbour_range: float  # mm; 0 where robots hear only their predecessors
    cooperative: bool  # every robot gets the formation's mean reward
    changing: bool  # whether a channel of every substep varies within an episode
    adversary: bool
    base: ControllerRow  # of the twist that a residual is added to
    full_1: float  # what an action of 1.0 adds to a twist, mm/s and rad/s
    full_2: float
    limits: ControllerRow  # of the scenario's limiter, with no law in use
    supervisor: SupervisorRow  # of that limiter
    residual_fade: float  # mm; 0 where a residual counts fully near the reference
    residual_reach: float  # mm; infinity where it does far from it
    tracking_fade: float  # mm; the same of the action `tracking_twist`


def make_settings(scenario: Scenario) -> Settings:
    """The scenario's numbers as the drivers take them."""
    observer = scenario.observer
    paper = observer if isinstance(observer, ObserverParameters) else ObserverParameters()
    rays = Rays() if scenario.rays is None else scenario.rays
    full_1, full_2 = (entry.scale for entry in scenario.action_entries)
    limiter = scenario.action_limiter
    return Settings(
        kinematic=scenario.plant == "kinematic",
        by_chipmunk=scenario.plant == "chipmunk",
        collides=scenario.plant in ("pymunk", "chipmunk"),
        round_outlines=all(one.outline_polygon_mm is None for one in scenario.robot_models),
        substeps=scenario.substeps,
        number=1.0,
        dt=scenario.physics_period_s,
        period=scenario.control_period_s,
        gap=scenario.gap_steps,
        lookahead=max(scenario.preview_steps, default=0),
        spacing=scenario.start_spacing_mm,
        window=round(TIME_GAP_WINDOW_S / scenario.control_period_s),
        half_window=scenario.smoothing_steps,
        observer_gain=paper.gain_per_s,
        smoothing=paper.smoothing_s,
        lost_beyond=scenario.lost_beyond_mm,
        end_on_lost="lost" in scenario.end_on,
        end_on_touched="touched" in scenario.end_on,
        estimator=ESTIMATOR_CODES.get(scenario.estimator, EXTERNAL),
        has_parts=bool(scenario.part_paths),
        external_wheel_loop=isinstance(scenario.wheel_loop, str),
        external_observer=isinstance(observer, str),
        ray_range=rays.range_mm,
        ray_noise=rays.noise_std_mm,
        ray_period=round((rays.period_s or scenario.control_period_s) / scenario.control_period_s),
        neighbour_range=0.0 if scenario.neighbour is None else scenario.neighbour.range_mm,
        cooperative=scenario.cooperative,
        changing=changes_within_episode(scenario.disturbance),
        adversary=scenario.adversary,
        base=controller_row(
            scenario.base_controller, scenario.control_period_s, scenario.preview_s
        ),
        full_1=full_1,
        full_2=full_2,
        limits=controller_row(
            behind(Controller(), limiter), scenario.control_period_s, scenario.preview_s
        ),
        supervisor=supervisor_row(
            limiter.supervisor, neighbour_place(scenario.preview_s, scenario.neighbour)
        ),
        residual_fade=scenario.residual_fade_mm,
        residual_reach=scenario.residual_reach_mm or math.inf,
        tracking_fade=scenario.action_fade_mm,
    )
