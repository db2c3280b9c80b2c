"""Tables that the command line prints."""

from __future__ import annotations

from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from baselines.benchmark.page import policy_label
from baselines.runs.run import Record
from baselines.training.curve import kept_evaluation
from tlf_env.task.metrics import RobotMetrics

RUN_COLUMNS: tuple[tuple[str, str, int], ...] = (
    ("error\nRMS\nmm", "position_rmse_mm", 2),
    ("error\nlargest\nmm", "position_max_mm", 1),
    ("formation\nRMS\nmm", "formation_rmse_mm", 1),
    ("heading\nRMS\nrad", "heading_rmse_rad", 4),
    ("gap\nRMS\ns", "time_gap_rmse_s", 4),
    ("torque\nat limit\n%", "saturation_fraction", 1),
    ("slip\nlargest\nmm/s", "slip_max_mm_s", 1),
)


def metrics_table(record: Record) -> Table:
    """The summary of a run, a row per robot."""
    scenario = record.scenario
    table = Table(
        title=f"{scenario.name}, {record.policy}, disturbance {scenario.disturbance.name}, "
        f"seed {record.seed}",
        caption=f"Errors from {scenario.settle_s:g} s on (formation: from 5 s after the robot sets out). "
        "Error: of the position, to the robot's own reference. Formation: to the leader's path, one time gap "
        "later for each robot. Gap: of the time gap.",
        box=SIMPLE_HEAD,
        collapse_padding=True,
        pad_edge=False,
    )
    table.add_column("robot")
    for heading, _, _ in RUN_COLUMNS:
        table.add_column(heading, justify="right")
    table.add_column("verdict")
    end_s = float(record.t_s[-1])
    for i, metrics in enumerate(record.metrics()):
        row = metrics._asdict() | {"saturation_fraction": 100 * metrics.saturation_fraction}
        cells = [
            "–" if row[key] is None else f"{row[key]:.{digits}f}" for _, key, digits in RUN_COLUMNS
        ]
        table.add_row(str(i), *cells, verdict(metrics, i * scenario.time_gap_s < end_s))
    return table


def verdict(metrics: RobotMetrics, set_out: bool) -> str:
    """How a run ended for one robot, in words; a robot that has not set out at the end waits."""
    if metrics.lost or metrics.touched:
        parts = ["lost"] if metrics.lost else []
        parts += [f"touched {metrics.touched_by}"] if metrics.touched else []
        return ", ".join(parts)
    return "held" if set_out else "waits"


def speed_table(result: dict[str, Any]) -> Table:
    """Agent steps per second of every environment that was measured."""
    table = Table(box=SIMPLE_HEAD)
    for name in ("environment", "robots", "formations", "threads", "agent steps/s", "to mpe2"):
        table.add_column(name, justify="left" if name == "environment" else "right")
    keys = ("env", "robots", "formations", "threads")
    ratios = {
        tuple(row[key] for key in keys): row["ratio"]
        for row in result["ratios"]
        if row["to"].startswith("mpe2")
    }
    for row in result["results"]:
        place = tuple(row[key] for key in keys)
        ratio = f"{ratios[place]:.1f} ×" if place in ratios else ""
        table.add_row(*map(str, place), f"{row['agent_steps_per_s']:.0f}", ratio)
    return table


def board_table(board: dict[str, Any]) -> Table:
    """Policies over all tasks and disturbances."""
    table = Table(title="score 0 to 100, interquartile mean over all runs", box=SIMPLE_HEAD)
    table.add_column("policy")
    for heading in ("score", "95 %", "normalised", "better than\nreference", "failed"):
        table.add_column(heading, justify="right")
    for row in board["policies"]:
        ends, better = row["score"]["interval"], row["probability_of_improvement"]
        scaled = row["normalised_score"]
        table.add_row(
            policy_label(row),
            f"{row['score']['iqm']:.1f}",
            "–" if ends is None else f"{ends[0]:.1f}–{ends[1]:.1f}",
            "–" if scaled is None else f"{scaled:.2f}",
            "–" if better is None else f"{better:.2f}",
            f"{row['failed']} of {row['runs']}",
        )
    return table


def testset_table(board: dict[str, Any]) -> Table:
    """Entries on the test set."""
    table = Table(
        title=f"test set {board['version']}, {board['fingerprint']}: geometric mean of the formation RMS, "
        "less is better",
        box=SIMPLE_HEAD,
    )
    table.add_column("entry")
    for heading in ("score\nmm", "95 %", "held", "95 %"):
        table.add_column(heading, justify="right")
    for row in board["entries"]:
        ends, held = row["score"]["interval"], row["held"]
        low, high = held["interval"]
        table.add_row(
            policy_label(row),
            f"{row['score']['mm']:.2f}",
            "–" if ends is None else f"{ends[0]:.2f}–{ends[1]:.2f}",
            f"{held['count']} of {row['cases']}",
            f"{100 * low:.0f}–{100 * high:.0f} %",
        )
    return table


def training_table(curves: list[dict[str, Any]]) -> Table:
    """Scores on the choosing seeds, a row per training seed."""
    table = Table(
        title="geometric mean of the worst robot's position RMS in mm; a failed run counts as 1000",
        box=SIMPLE_HEAD,
    )
    for name in ("seed", "start", "kept", "failed at start", "failed", "robot steps", "minutes"):
        table.add_column(name, justify="right")
    for curve in curves:
        first, best = curve["evaluations"][0], kept_evaluation(curve)
        table.add_row(
            str(curve["seed"]),
            f"{first['score_mm']:.2f}",
            f"{best['score_mm']:.2f}",
            str(first["failed"]),
            str(best["failed"]),
            f"{best['robot_steps']}",
            f"{curve['wall_time_s'] / 60:.1f}",
        )
    return table


def tune_table(found: dict[str, Any]) -> Table:
    """The result of a search compared with its start, on the tuning and the choosing seeds."""
    table = Table(title=f"trial {found['trial']}, less is better", box=SIMPLE_HEAD)
    for heading in ("seeds", "task, disturbance"):
        table.add_column(heading)
    for heading in ("cost,\nfound", "cost,\nstart", "failed,\nfound", "failed,\nstart"):
        table.add_column(heading, justify="right")
    for seeds in ("tune", "choose"):
        mine, first = found[seeds]["found"], found[seeds]["start"]
        for place, row in mine["strata"].items():
            other = first["strata"][place]
            costs = (f"{row['cost']:.3f}", f"{other['cost']:.3f}")
            table.add_row(seeds, place, *costs, str(row["failed"]), str(other["failed"]))
        scores = (f"{mine['score']:.3f}", f"{first['score']:.3f}")
        table.add_row(seeds, "all", *scores, str(mine["failed"]), str(first["failed"]))
    return table
