"""When a run counts as failed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from tlf_env.task.metrics import RobotMetrics


def failed(robots: Iterable[RobotMetrics | Mapping[str, Any]]) -> bool:
    """Whether a run failed: a robot is lost, or touched another, a wall or an obstacle.

    Parameters
    ----------
    robots
        Metrics of every robot, as :meth:`baselines.runs.run.Record.metrics` returns them or as a line
        of ``runs.jsonl`` has them under ``robots``.
    """
    rows = (robot if isinstance(robot, Mapping) else robot._asdict() for robot in robots)
    return any(row["lost"] or row["touched"] for row in rows)
