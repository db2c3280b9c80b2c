"""Draw ``docs/images/worlds.png``: the four worlds, each with a run of the reference up to the first touch.

Run ``python docs/figures/make_worlds.py``. This needs the extra ``figures``.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from matplotlib.figure import Figure

from baselines import ReferencePolicy
from baselines.runs.panels import legend_below
from baselines.runs.plane import draw_plane
from baselines.runs.run import Record, run_policy
from baselines.runs.style import METADATA
from baselines.runs.world import world_handles
from tlf_env.common.files import atomic
from tlf_env.task.scenario import load_scenario
from tlf_env.task.warn import without_warnings

PICTURE = Path(__file__).resolve().parents[1] / "images" / "worlds.png"
DPI = 100
LAP_S = 50.0  # of the ∞
NAMES = ("corridor", "warehouse", "slalom_posts", "crossing_traffic")


def record(name: str) -> Record:
    """A run of the reference in a world, cut off when a robot first touches something."""
    with without_warnings():
        scenario = load_scenario(name, estimator="ekf", broadcast_smoothing_s=0.0)
        scenario = load_scenario(scenario, horizon_s=min(scenario.horizon_s, LAP_S))
    run = run_policy(scenario, ReferencePolicy("consistent"), seed=1)
    rows = run.t_s <= run.touched_at_s.min()
    return replace(
        run,
        t_s=run.t_s[rows],
        columns={name: column[rows] for name, column in run.columns.items()},
        objects=None if run.objects is None else run.objects[rows],
    )


def main() -> None:
    """Write the picture."""
    figure = Figure(figsize=(9.6, 9.8), layout="constrained", facecolor="white")
    handles = {}
    for name, axes in zip(NAMES, figure.subplots(2, 2).flat, strict=True):
        run = record(name)
        draw_plane(run, axes, [len(run.t_s) - 1])
        axes.set_title(name)
        for handle in [*axes.get_legend_handles_labels()[0], *world_handles(run)]:
            handles.setdefault(handle.get_label(), handle)
    legend_below(figure, list(handles.values()), columns=5)
    with atomic(PICTURE, "wb") as file:
        figure.savefig(file, format="png", dpi=DPI, metadata=METADATA.get("png"))


if __name__ == "__main__":
    main()
