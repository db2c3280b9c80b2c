"""Random smooth tasks and robots of the test set: closed curves, speed along them, stops, rows of robots."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from baselines.benchmark.draws import Draws, rounded

SAMPLES = 4096  # of a curve, for its length
WAYPOINT_S = 0.5
HORIZON_S = 60.0
AFTER_HORIZON_S = 2.0  # the waypoints go on: the reference is not at rest at the end
ROBOTS, FEW = (3, 3, 3, 4, 4, 5), (3, 3, 4)


class Curve(NamedTuple):
    """A closed curve: x and y are sums of harmonics of the angle φ, scaled to a length."""

    cosines: np.ndarray  # (harmonic, 2), mm
    sines: np.ndarray

    def at(self, angle: np.ndarray) -> np.ndarray:
        """Points ``(angle, 2)``, mm."""
        k = np.arange(1, len(self.cosines) + 1)
        phases = angle[:, None] * k
        return np.cos(phases) @ self.cosines + np.sin(phases) @ self.sines


def drawn_curve(draws: Draws) -> Curve:
    """An ellipse with 1 to 4 higher harmonics, which fade, 11 to 26 m long."""
    count, fade = draws.whole(2, 5), draws.uniform(0.25, 0.6)
    table = np.array(
        [[[draws.uniform(-1, 1) for _ in range(2)] for _ in range(2)] for _ in range(count)]
    )
    # The first harmonic is an ellipse with axes of 1 and 0.4 to 1, in a random direction.
    turn, start, axis = draws.angle(), draws.angle(), draws.uniform(0.4, 1.0)
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    table[0] = np.array(
        [[np.cos(start), axis * np.sin(start)], [-np.sin(start), axis * np.cos(start)]]
    ) @ rotation  # fmt: skip
    table *= (fade ** np.arange(count) / np.arange(1, count + 1))[:, None, None]
    curve = Curve(table[:, 0], table[:, 1])
    points = curve.at(np.linspace(0, 2 * np.pi, SAMPLES + 1))
    length_mm = np.hypot(*np.diff(points, axis=0).T).sum()
    scale = draws.uniform(11_000, 26_000) / length_mm
    return Curve(scale * curve.cosines, scale * curve.sines)


class Course(NamedTuple):
    """How a curve is driven: speed over its length, v(s) = v·(1 + swing·sin(2π·waves·s/L + phase))."""

    speed_mm_s: float
    swing: float
    waves: int
    phase_rad: float
    stops: Mapping[str, float] | None  # the times of `stop_and_go`


def drawn_course(draws: Draws) -> Course:
    """Speeds of 250 to 520 mm/s, at half of the tasks with a swing, at a quarter with stops."""
    swing = draws.uniform(0.1, 0.35) if draws.chance(0.5) else 0.0
    waves, phase = draws.whole(1, 4), draws.angle()
    stops = {
        "drive_s": draws.uniform(12, 25),
        "stop_s": draws.uniform(0.8, 2.5),
        "ramp_s": draws.uniform(2.0, 3.5),
    }
    return Course(
        speed_mm_s=draws.uniform(250, 520),
        swing=swing,
        waves=waves,
        phase_rad=phase,
        stops=stops if draws.chance(0.25) else None,
    )


def trajectory_of(curve: Curve, course: Course) -> dict[str, Any]:
    """The trajectory of a scenario: waypoints twice a second along the curve, with the stops if any."""
    angle = np.linspace(0, 2 * np.pi, SAMPLES + 1)
    steps = np.hypot(*np.diff(curve.at(angle), axis=0).T)
    place = np.concatenate([[0.0], np.cumsum(steps)])
    length = place[-1]
    wave = 2 * np.pi * course.waves * place / length + course.phase_rad
    pace = 1.0 / (course.speed_mm_s * (1.0 + course.swing * np.sin(wave)))
    time = np.concatenate([[0.0], np.cumsum(steps * (pace[1:] + pace[:-1]) / 2)])
    t_s = np.arange(round((HORIZON_S + AFTER_HORIZON_S) / WAYPOINT_S) + 1) * WAYPOINT_S
    at = np.interp(t_s % time[-1], time, angle)
    points = [
        (float(t), round(float(x), 2), round(float(y), 2))
        for t, (x, y) in zip(t_s, curve.at(at), strict=True)
    ]
    path = {"type": "waypoints", "points": points}
    if course.stops is None:
        return path
    return {"type": "stop_and_go", "path": path, **course.stops}


def drawn_robot(draws: Draws) -> dict[str, Any]:
    """A robot's parameters: about 20 % around the paper's; its controller knows them."""
    castor = draws.uniform(0.15, 0.24)
    pivot, trail = draws.uniform(76, 94), draws.uniform(13, 17)
    mass = draws.uniform(1.0, 1.45)
    return {
        "mass_kg": mass,
        "body_inertia_kg_mm2": rounded(mass * draws.uniform(4200, 5800)),
        "wheel_radius_mm": draws.uniform(43, 57),
        "axle_width_mm": draws.uniform(132, 180),
        "wheel_inertia_kg_mm2": draws.uniform(42, 63),
        "castor_load_share": castor,
        "drive_load_share": (1.0 - castor) / 2,
        "castor_pivot_mm": pivot,
        "castor_trail_mm": trail,
        "com_offset_mm": castor * (pivot + trail),
        "torque_limit_Nmm": draws.uniform(13.5, 18),
    }


def drawn_row(draws: Draws, *, stops: bool) -> dict[str, Any]:
    """Number of robots, their parameters (alike in a third of the rows), time gap and start.

    A row that stops needs longer gaps: while the first robot is at rest, the others close up. It begins at
    rest; of the others, 60 % begin with a ramp.
    """
    count = draws.pick(FEW if stops else ROBOTS)
    alike = draws.chance(1 / 3)
    robots = [drawn_robot(draws) for _ in range(count)]
    gap_periods = draws.whole(325, 450) if stops else draws.whole(180, 300)
    return {
        "robots": [robots[0]] * count if alike else robots,
        "time_gap_s": gap_periods / 50,  # whole control periods
        "start_spacing_mm": draws.uniform(290, 400),
        "start_ramp_s": draws.uniform(1.5, 6.0) if not stops and draws.chance(0.6) else 0.0,
    }
