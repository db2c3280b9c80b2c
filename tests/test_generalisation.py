"""The page on generalisation: its tables are those of the kept runs, and its sentences hold in them."""

from __future__ import annotations

import importlib
import sys

import numpy as np
import pytest
from page_tables import DOCS, rows_of

pytest.importorskip("arch")
pytest.importorskip("matplotlib")

from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from tlf_env.common.presets import preset_names

sys.path.insert(0, str(DOCS / "figures"))
cells = importlib.import_module("generalisation_cells")
kick = importlib.import_module("generalisation_kick")
runs = importlib.import_module("generalisation_runs")
tables = importlib.import_module("generalisation_tables")
script = importlib.import_module("make_generalisation")

PAGE = (DOCS / "generalisation.md").read_text(encoding="utf-8")
TEXT = " ".join(PAGE.split())
LINES = runs.kept()
ENTRIES, LEARNED, CLASSICAL = cells.ENTRIES, cells.LEARNED, cells.CLASSICAL
CELLS = {cell.name: cell for cell in cells.CELLS}


def median_mm(cell, entry):
    return float(np.median(LINES[cell, entry]["rms_mm"]))


def lost(cell, entry):
    return len(LINES[cell, entry]["failed"])


def named(table):
    return [cell.name for cell in cells.CELLS if cell.table == table]


def words(cell, entry, rival=tables.BEST):
    """better, worse, unclear or no difference."""
    return tables.compared(LINES, cell, entry, rival).verdict.split(":")[0]


# --- tables and data -----------------------------------------------------------------------------


def test_the_tables_are_those_of_the_kept_runs():
    for name, text in tables.tables(LINES).items():
        assert f"<!-- {name} -->\n{text}\n<!-- end of {name} -->" in PAGE, name


def test_every_entry_drove_the_same_seeds_which_nothing_was_tuned_on():
    for name, cell in CELLS.items():
        count = cell.most_seeds or 20
        for entry in ENTRIES:
            line = LINES[name, entry]
            assert line["seeds"] == [FIRST_TABLE_SEED, FIRST_TABLE_SEED + count]
            assert len(line["rms_mm"]) == count
            assert set(line["failed"]) <= set(range(*line["seeds"]))
    assert set(LINES) == {(cell, entry) for cell in [*CELLS, kick.KICK] for entry in ENTRIES}


def test_a_cell_has_the_kept_digits_when_it_is_driven_again():
    cell = CELLS["`corridor`, nominal"]
    for entry in ENTRIES:
        again = runs.drive(None, runs.Job(cell, entry, (20_000, 20_001)))
        kept = LINES[cell.name, entry]
        assert [line["rms_mm"] for line in again] == kept["rms_mm"][:2]
        assert [line["seed"] for line in again if line["failed"]] == [
            seed for seed in kept["failed"] if seed < 20_002
        ]


@pytest.mark.slow
def test_one_slip_has_the_kept_digits_when_it_is_driven_again():
    assert kick.kicked("linearised") == LINES[kick.KICK, "linearised"]


# --- what was seen -------------------------------------------------------------------------------


def test_only_the_first_rows_of_the_tables_were_in_both_trainings():
    seen = [name for name, cell in CELLS.items() if tables.was_trained("residual", cell)]
    assert seen == [
        f"{row}, {disturbance}"
        for row in ("∞, 3 robots", "flower, 5 robots")
        for disturbance in ("nominal", "combined-medium")
    ]
    also = [name for name, cell in CELLS.items() if tables.was_trained("from-nothing", cell)]
    assert also == [*seen, "`split-ice-right`", "`split-ice-right` × 0.5"]


def test_every_task_of_no_training_is_driven():
    trained = {task for entry in LEARNED for task in tables.training_of(entry)["tasks"]}
    driven = {cell.source for cell in cells.CELLS}
    assert set(preset_names("scenario")) - trained <= driven


def test_presets_of_no_training_are_driven_or_named():
    trained = {one for entry in LEARNED for one in tables.trained_disturbances(entry)}
    driven = {cell.disturbance for cell in cells.CELLS}
    for name in set(preset_names("disturbance")) - trained - driven:
        assert f"`{name}`" in PAGE
