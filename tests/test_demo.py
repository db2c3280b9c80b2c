"""``tlf demo``: three controllers on the same draws."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import typer

from baselines import cli
from baselines.commands import demo

pytest.importorskip("matplotlib")


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """What the demo prints and writes, of runs of 8 s."""
    folder = tmp_path_factory.mktemp("demo")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo, "HORIZON_S", 8.0)
        patch.setenv("COLUMNS", "140")
        runs = demo.demo_command(3, folder, figures=True)
    return folder, runs


def test_all_have_the_same_task_and_draws(shown):
    _, runs = shown
    assert list(runs) == ["nominal", "slip"]
    for disturbance, records in runs.items():
        assert [one.policy for one in records] == [entry.policy for entry in demo.ENTRIES]
        first = records[0]
        for record in records:
            assert (record.seed, record.scenario.disturbance.name) == (3, disturbance)
            assert record.scenario.trajectory == first.scenario.trajectory
            if disturbance == "slip":
                for channel in ("slip_delta_1_mm_s", "slip_delta_2_rad_s"):
                    np.testing.assert_array_equal(record[channel], first[channel])


def test_the_table_says_what_the_records_say(shown):
    _, runs = shown
    cells = [list(column.cells) for column in demo.demo_table(runs, 3).columns]
    for number in range(len(demo.ENTRIES)):
        for column, records in zip((2, 4), runs.values(), strict=True):
            robots = records[number].metrics()
            worst = max(one.position_rmse_mm for one in robots)
            assert cells[column][number] == f"{worst:.1f}"
            assert cells[column + 1][number] == str(sum(one.lost or one.touched for one in robots))


def test_the_picture_and_the_data_are_written(shown):
    folder, runs = shown
    assert (folder / "demo.png").stat().st_size > 50_000
    for disturbance, records in runs.items():
        for record in records:
            of = folder / f"{record.policy.replace(':', '_')}-{disturbance}"
            summary = json.loads((of / "summary.json").read_text(encoding="utf-8"))
            assert summary["policy"] == record.policy


def test_the_commands_that_come_next_exist(capsys, monkeypatch, tmp_path):
    """Each is a command of ``tlf`` with options and names that are allowed."""
    monkeypatch.chdir(tmp_path)
    names = set(typer.main.get_command(cli.app).commands)
    for line, _ in demo.NEXT:
        for command in line.split(";"):
            words = command.split()
            assert words[0] == "tlf"
            assert words[1] in names
    assert Path(demo.PICTURE).suffix == ".png"
