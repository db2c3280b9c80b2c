"""Simulated runs for the pictures of the families of disturbances, and what their panels share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from baselines.policies.registry import fit_policy
from baselines.runs.run import Record, run_policy
from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from baselines.runs.style import GREY, tidy
from tlf_env import BatchPlant
from tlf_env.disturbances.channels import number
from tlf_env.engine.layout import Sample
from tlf_env.physics.vehicle import RobotParameters
from tlf_env.task.scenario import load_scenario
from tlf_env.task.warn import without_warnings

SEED = FIRST_TABLE_SEED
ROBOT = RobotParameters()
RADIUS_MM, MASS_KG, GRAVITY = ROBOT.wheel_radius_mm, ROBOT.mass_kg, ROBOT.gravity_mm_s2
FREE = {"joint_friction": False}
# Okabe and Ito's colours, which differ in lightness; each line has its own dashes too.
STYLES: tuple[dict[str, Any], ...] = (
    {"color": "#0072B2", "ls": "-"},
    {"color": "#D55E00", "ls": "--"},
    {"color": "#009E73", "ls": "-."},
    {"color": "black", "ls": ":"},
)
LAW = {"color": GREY, "ls": (0, (4, 2)), "lw": 0.9, "zorder": 1.5}
WIDTH_IN, ROW_IN = 9.6, 2.9


def panels(figure: Figure, names: Sequence[str], **sharing: Any) -> list[Axes]:
    """Panels in two columns, each with a title."""
    rows = -(-len(names) // 2)
    figure.set_size_inches(WIDTH_IN, ROW_IN * rows)
    found = list(figure.subplots(rows, 2, **sharing).flat)[: len(names)]
    for axes, name in zip(found, names, strict=True):
        axes.set_title(name, fontsize="medium")
    tidy(*found)
    return found


def legend(axes: Axes, **where: Any) -> None:
    """A small legend."""
    axes.legend(fontsize=8, framealpha=0.9, edgecolor="none", **where)


def course(disturbance: Any, path: str, seconds: float, **fields: Any) -> np.ndarray:
    """Values of a channel for robots at rest, (control step, robot)."""
    with without_warnings():
        plant = BatchPlant("infinity", 1, disturbance=disturbance, end_on=(), **fields)
    plant.reset(seed=SEED)
    rest, place = np.zeros((1, plant.scenario.robot_count, 2)), number(path)
    rows = [plant.applied[0, :, place].copy()]
    for _ in range(round(seconds / plant.scenario.control_period_s)):
        plant.step(rest)
        rows.append(plant.applied[0, :, place].copy())
    return np.array(rows)


def times(values: np.ndarray, period_s: float = 0.02) -> np.ndarray:
    """Times of the rows of a course, s."""
    return np.arange(len(values)) * period_s


class Torques:
    """A policy that commands shares of the torque limit, by the time in s."""

    def __init__(self, shares: Callable[[float], tuple[float, float]], period_s: float) -> None:
        self._shares, self._period_s = shares, period_s

    def predict(
        self, observation: np.ndarray, state: Any = None, *_: Any
    ) -> tuple[np.ndarray, int]:
        """The next actions, the same for every row; the state counts the steps."""
        step = state or 0
        return np.tile(self._shares(step * self._period_s), (len(observation), 1)), step + 1


def open_loop(
    shares: Callable[[float], tuple[float, float]], seconds: float, **fields: Any
) -> Record:
    """One robot from rest at the origin, heading +y, with given shares of its torque limit."""
    fields = {"plant": "batch", "disturbance": "none"} | fields
    with without_warnings():
        scenario = load_scenario(
            "infinity", robots=1, action="torque", horizon_s=seconds, preview_s=(), **fields
        )
        return run_policy(
            scenario,
            Torques(shares, scenario.control_period_s),
            SEED,
            options={"poses": [[0.0, 0.0, 0.0]]},
        )


def speed(record: Record) -> np.ndarray:
    """Forward speed along +y of the only robot, mm/s."""
    return np.gradient(record["y_mm"][:, 0], record.t_s)


def followed(seconds: float, **fields: Any) -> Record:
    """A run of ∞ under ``tuned``."""
    with without_warnings():
        scenario = load_scenario("infinity", plant="batch", horizon_s=seconds, **fields)
        fitted = fit_policy("reference:tuned", scenario)
        return run_policy(fitted.scenario, fitted.policy, SEED)


def drawn(disturbance: Any, path: str, episodes: int) -> np.ndarray:
    """Values of a channel at the start of an episode, (episode, robot)."""
    with without_warnings():
        plant = BatchPlant("infinity", episodes, disturbance=disturbance, end_on=())
    plant.reset(seed=SEED)
    return plant.applied[:, :, number(path)].copy()


def sampled(
    seconds: float, held: tuple[float, float], *names: str, **fields: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Sensor readings of one robot from rest at the origin with an action that is held.

    Returns times (s) and the named columns of :class:`~tlf_env.engine.layout.Sample`, (name, substep).
    """
    with without_warnings():
        plant = BatchPlant(
            "infinity", 1, robots=1, end_on=(), preview_s=(), horizon_s=2000.0, **fields
        )
    plant.reset(seed=SEED, options={"poses": [[0.0, 0.0, 0.0]]})
    places = [Sample._fields.index(name) for name in names]
    actions, rows = np.full((1, 1, 2), held), []
    for _ in range(round(seconds / plant.scenario.control_period_s)):
        plant.step(actions)
        rows.append(plant.arrays.samples[:, places, 0, 0].copy())
    columns = np.concatenate(rows).T
    return (1 + np.arange(columns.shape[1])) * plant.scenario.physics_period_s, columns
