"""What limits the default under fast slip, own estimate, broadcast or law: a table of ``gyro-estimator.md``.

``python docs/figures/make_links.py`` drives 16 seeds of each cell for 60 s on the batch plant: with the
filter's values, with the true ones in place of either link, and of both. It takes some minutes on one core
and needs no extra.
"""

from __future__ import annotations

import argparse
from typing import Any
from unittest import mock

import numpy as np
from make_board import DOCS
from make_gyro import COLUMNS, GYRO
from make_parts import put

from baselines.policies.registry import fit_policy
from baselines.runs.outcome import failed
from baselines.runs.run import run_seeds
from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from tlf_env import BatchPlant
from tlf_env.engine.excerpt import Excerpt
from tlf_env.task.info import State
from tlf_env.task.scenario import load_scenario

LAW = "feedback_linearisation:bounded"
ROWS = ("sine 1 Hz", "OU 1.5 s", "OU 0.5 s", "OU 0.1 s")
SEEN = ("x_mm", "y_mm", "sin_theta", "cos_theta", "forward_mm_s", "yaw_rad_s")  # of a broadcast
HEAD = "| slip | filter | true broadcasts | true own estimate | both true |"


class Replaced(BatchPlant):
    """A batch whose broadcasts may be the truth plus given errors; it keeps the errors of its own."""

    added: np.ndarray | None = None  # (step, Message, robot, lane); None: nothing is replaced

    def reset(self, *given: Any, **named: Any) -> Any:
        """Start anew, with no error kept."""
        found = super().reset(*given, **named)
        self.true = np.zeros(self.arrays.messages.shape)
        self.errors: list[np.ndarray] = []
        self.note(0)
        return found

    def step(self, actions: np.ndarray, excerpt: Excerpt | None = None) -> None:
        """A step, and then the broadcasts."""
        super().step(actions, excerpt)
        now = int(self.step_counts[0])
        self.note(now)
        # A smoothed broadcast is written half a window later.
        last = max(now - self.half, 0)
        messages, ring = self.arrays.messages, self.arrays.messages.shape[1]
        self.errors[last] = messages[:, last % ring] - self.true[:, last % ring]
        if self.added is not None:
            for step in {now, last}:
                messages[:, step % ring] = self.true[:, step % ring] + self.added[step]

    def note(self, now: int) -> None:
        """Keep what a broadcast of this step would be if all were known, and the error of what it is."""
        rows = self.state().transpose(2, 1, 0)  # (State, robot, lane)
        x, y, sin, cos, forward, yaw = (rows[State._fields.index(name)] for name in SEEN)
        slot = now % self.true.shape[1]
        sent = self.arrays.messages[:, slot]
        turn = np.arctan2(sin, cos) - sent[2, :, : self.formations]
        heading = sent[2, :, : self.formations] + np.arctan2(np.sin(turn), np.cos(turn))
        self.true[:, slot, :, : self.formations] = x, y, heading, forward, yaw
        self.errors.append(sent - self.true[:, slot])

    @property
    def half(self) -> int:
        """Control periods after which a broadcast is replaced by the smoothed one."""
        scenario = self.scenarios[0]
        return round(scenario.smoothing_s / scenario.control_period_s)


def driven(estimator: str, fields: dict[str, Any], seeds: range, added: Any) -> tuple[str, Any]:
    """Median position RMS (mm) and failed runs, and the errors of the broadcasts."""
    plants = []

    def make(*given: Any) -> Replaced:
        plants.append(Replaced(*given))
        if added is not None:
            steps, shape = plants[0].scenarios[0].horizon_steps, plants[0].arrays.messages.shape
            plants[0].added = np.zeros((steps + 1, shape[0], *shape[2:])) + added
        return plants[0]

    name = f"{LAW}+{estimator}+grip"
    scenario = load_scenario(source="infinity", horizon_s=60.0, plant="batch", **fields)
    fitted = fit_policy(name, scenario)
    with mock.patch("baselines.runs.run.BatchPlant", make):
        runs = [one.metrics() for one in run_seeds(fitted.scenario, fitted.policy, seeds)]
    rms_mm = np.median([max(robot.position_rmse_mm or 0.0 for robot in run) for run in runs])
    lost = sum(map(failed, runs))
    text = f"{float(f'{rms_mm:.3g}'):g}" + (f" ({lost})" if lost else "")
    return text, np.array(plants[0].errors)


def row(name: str, seeds: range) -> str:
    """The cells of a disturbance."""
    fields = {"disturbance": {"slip": COLUMNS[name], "gyro": GYRO}}
    by_filter, errors = driven("ekf-gyro-smoothed", fields, seeds, None)
    true_broadcasts, _ = driven("ekf-gyro-smoothed", fields, seeds, 0.0)
    true_estimate, _ = driven("truth", fields, seeds, errors)
    both, _ = driven("truth", fields, seeds, None)
    return f"| {name} | " + " | ".join((by_filter, true_broadcasts, true_estimate, both)) + " |"


def main() -> None:
    """Drive and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=16)
    count = parser.parse_args().seeds
    lines = [HEAD, "|---" + "|---:" * 4 + "|"]
    for name in ROWS:
        lines.append(row(name, range(FIRST_TABLE_SEED, FIRST_TABLE_SEED + count)))
        print(lines[-1], flush=True)
    put(DOCS / "controller" / "gyro-estimator.md", "\n".join(lines), "links")


if __name__ == "__main__":
    main()
