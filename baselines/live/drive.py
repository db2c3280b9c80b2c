"""A leader that is driven by hand: its reference follows keys or a stick, and is kept as a path."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from baselines.live.session import Session
from tlf_env.common.trust import Trust
from tlf_env.onboard.observer import Reference
from tlf_env.task.scenario import Scenario, load_scenario
from tlf_env.task.trajectories import reference_from
from tlf_env.task.warn import without_warnings

SPEED_MM_S = 400.0  # with the key or the stick fully forward
ACCELERATION_MM_S2, BRAKING_MM_S2, ROLLING_MM_S2 = 150.0, 200.0, 100.0
LATERAL_MM_S2 = (
    120.0  # below the 150 that the limiter `grip` leaves to the tyres on a slippery floor
)
YAW_RATE_RAD_S, YAW_ACCELERATION_RAD_S2 = 0.9, 1.2
RADIUS_MM = 250.0  # of the tightest turn
SPACING_S = 0.1  # between the points of the path that is kept
STANDING_MM = 1.0  # what the leader's reference moves in a whole episode that is not driven
HORIZON_S = 600.0


class Hand(NamedTuple):
    """What is asked for by hand, each from −1 to 1."""

    forward: float = 0.0  # below 0: brake
    left: float = 0.0


class DrivenReference:
    """A reference that moves like a robot can: forward only, with bounded accelerations.

    Units are mm, s and rad; headings counter-clockwise from +y.

    Parameters
    ----------
    x_mm, y_mm, theta_rad
        Where it starts, at rest.
    """

    def __init__(self, x_mm: float, y_mm: float, theta_rad: float) -> None:
        self.x, self.y, self.theta = x_mm, y_mm, theta_rad
        self.speed = self.yaw_rate = 0.0
        self.hand = Hand()

    def advance(self, dt_s: float) -> None:
        """Move on by a time step."""
        wanted = max(self.hand.forward, 0.0) * SPEED_MM_S
        if self.hand.forward < 0:
            slower = -self.hand.forward * BRAKING_MM_S2
        else:
            slower = ROLLING_MM_S2
        change = min(max(wanted - self.speed, -slower * dt_s), ACCELERATION_MM_S2 * dt_s)
        speed = max(self.speed + change, 0.0)
        most = min(YAW_RATE_RAD_S, speed / RADIUS_MM, LATERAL_MM_S2 / max(speed, 1.0))
        turn = self.hand.left * most - self.yaw_rate
        turn = min(max(turn, -YAW_ACCELERATION_RAD_S2 * dt_s), YAW_ACCELERATION_RAD_S2 * dt_s)
        yaw_rate = min(max(self.yaw_rate + turn, -most), most)
        middle = self.theta + 0.5 * dt_s * yaw_rate
        way = 0.5 * dt_s * (self.speed + speed)
        self.x -= way * math.sin(middle)
        self.y += way * math.cos(middle)
        self.theta += dt_s * yaw_rate
        self.speed, self.yaw_rate = speed, yaw_rate

    def reference(self) -> Reference:
        """The pose and twist now."""
        return Reference(self.x, self.y, self.theta, self.speed, self.yaw_rate)

    def ahead(self, steps: int, dt_s: float) -> np.ndarray:
        """The reference now and at the next steps if the hand stays, ``(steps, 5)``."""
        copy = DrivenReference(self.x, self.y, self.theta)
        copy.speed, copy.yaw_rate, copy.hand = self.speed, self.yaw_rate, self.hand
        rows = []
        for _ in range(steps):
            rows.append(copy.reference())
            copy.advance(dt_s)
        return np.array(rows)


class DriveSession(Session):
    """An episode whose leader follows a reference that is driven by hand; the others keep the time gap.

    The leader's reference is written into the table of its path step by step, up to the longest preview,
    as if the hand stayed. The scenario's own path is only drawn.

    Parameters
    ----------
    scenario, policy, seed, trust
        As of :class:`~baselines.live.session.Session`.
    horizon_s
        The longest drive, s.
    """

    def __init__(
        self,
        scenario: Scenario,
        policy: str = "reference",
        seed: int = 0,
        *,
        options: Mapping[str, Any] | None = None,
        trust: Trust = False,
        horizon_s: float = HORIZON_S,
    ) -> None:
        period_s = scenario.control_period_s
        t_s = np.arange(scenario.horizon_steps + 1) * period_s
        path = reference_from(scenario.trajectory, t_s, scenario.start_ramp_s, 0.0)
        self.guide_mm = path[:, :2]  # of the scenario
        x, y, theta = path[0, :3].tolist()
        end = x - STANDING_MM * math.sin(theta), y + STANDING_MM * math.cos(theta)
        with without_warnings():
            standing = load_scenario(
                scenario,
                trajectory={"type": "waypoints", "points": [[0, x, y], [horizon_s, *end]]},
                horizon_s=horizon_s,
                start_ramp_s=None,
            )
        super().__init__(standing, policy, seed, options=options, trust=trust)

    def restart(self, **changes: Any) -> None:
        """As of a session; the drive begins anew."""
        super().restart(**changes)
        x, y, theta = self.formation.arrays.tables[0, 0, :3].tolist()
        self.drive = DrivenReference(x, y, theta)
        self._every = max(round(SPACING_S / self.scenario.control_period_s), 1)
        self._points = [(0.0, x, y)]

    def step(self) -> None:
        """One control step, with the hand's present wish."""
        if self.ended:
            return
        arrays, period_s = self.formation.arrays, self.scenario.control_period_s
        step = self.formation.step_count
        self.drive.advance(period_s)
        slots = arrays.references.shape[1]  # the present step and those of the preview
        rows = self.drive.ahead(slots, period_s)
        arrays.tables[0, step + 1 : step + 1 + slots] = rows
        for i in range(slots - 1):
            arrays.references[:, (step + 1 + i) % slots, 0, 0] = rows[i]
        super().step()
        if (step + 1) % self._every == 0:
            self._points.append((self.formation.time_s, self.drive.x, self.drive.y))

    def path(self) -> tuple[np.ndarray, np.ndarray]:
        """Times (s) and positions (mm), ``(point,)`` and ``(point, 2)``, from the start to the last motion.

        Without a point if the leader never moved.
        """
        rows = np.array(self._points)
        moved = np.flatnonzero((rows[1:, 1:] != rows[:-1, 1:]).any(axis=1))
        if not len(moved):
            return np.zeros(0), np.zeros((0, 2))
        kept = rows[moved[0] : moved[-1] + 2]
        return kept[:, 0] - kept[0, 0], kept[:, 1:]
