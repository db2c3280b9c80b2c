"""The page on generalisation: its tables are those of the kept runs, and its sentences hold in them."""

from __future__ import annotations

import importlib
import sys

import numpy as np
import pytest
from page_tables import DOCS

pytest.importorskip("arch")
pytest.importorskip("matplotlib")

from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from tlf_env.common.presets import preset_names

sys.path.insert(0, str(DOCS / "figures"))
causes = importlib.import_module("generalisation_causes")
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
    wanted = {(cell, entry) for cell in [*CELLS, kick.KICK] for entry in ENTRIES}
    wanted |= {(causes.key_of(one), entry) for one in causes.CAUSES for entry in one.entries}
    assert set(LINES) == wanted


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


# --- sentences: in short -------------------------------------------------------------------------


def counts(entry, rival, wanted=lambda cell: True):
    """In how many cells an entry is better, and worse, and of how many."""
    found = [
        one.verdict.split(":")[0]
        for cell, one in tables.verdicts(LINES, entry, rival)
        if wanted(cell)
    ]
    return found.count("better"), found.count("worse"), len(found)


def test_the_verdicts_in_short():
    better, worse, count = counts("residual", cells.BASE)
    assert f"better than its base in {better} of {count} cells and worse in {worse}:" in TEXT
    assert [
        cell.name
        for cell, one in tables.verdicts(LINES, "residual", cells.BASE)
        if one.verdict.startswith("worse")
    ] == ["3 s, nominal", "6 kg, `own_robot.yaml`, nominal"]
    difference = median_mm("3 s, nominal", "residual") - median_mm("3 s, nominal", cells.BASE)
    assert 0 < difference < 0.1
    assert "by less than 0.1 mm at a time gap of 3 s" in TEXT
    better, worse, _ = counts("residual", tables.BEST)
    assert f"`residual` is better in {better} cells and worse in {worse}," in TEXT
    better, worse, count = counts("from-nothing", tables.BEST)
    assert f"`from-nothing` better in {better} of {count} and worse in {worse}." in TEXT


@pytest.mark.parametrize("entry", LEARNED)
def test_where_both_win_and_lose(entry):
    better, worse, count = counts(entry, tables.BEST, lambda cell: cell.table == "disturbances")
    assert better > count / 2
    assert worse == 0
    assert counts(entry, tables.BEST, lambda cell: cell.table == "gaps") == (0, 6, 6)
    heavy = counts(entry, tables.BEST, lambda cell: cell.source == cells.OWN_ROBOT)
    assert heavy == (0, 2, 2)
    mixture = counts(entry, tables.BEST, lambda cell: cell.disturbance == cells.MIXTURE)
    assert (mixture[0], mixture[2]) == (1, 15)


def test_on_other_robots_both_are_better_but_for_one_cell():
    for name, cell in CELLS.items():
        if cell.table != "robots" or cell.disturbance != "nominal" or "6 kg" in name:
            continue
        if name == "torque limit × 0.8, nominal":
            assert all(lost(name, entry) == 20 for entry in ENTRIES)
            continue
        assert words(name, "residual") == "better"
        assert words(name, "from-nothing") == ("worse" if "wider axle" in name else "better")


def test_adrc_is_the_best_under_the_mixture_in_most_cells():
    names = [name for name, cell in CELLS.items() if cell.disturbance == cells.MIXTURE]
    best = [tables.best_classical(LINES, name) for name in names]
    assert best.count("adrc") > len(names) / 2


def test_failed_runs():
    names = tables.holdable(LINES)
    failed = {entry: sum(lost(name, entry) for name in names) for entry in ENTRIES}
    runs_of_each = sum(len(LINES[name, "adrc"]["rms_mm"]) for name in names)
    assert [entry for entry in ENTRIES if not failed[entry]] == ["adrc"]
    assert f"`residual` loses {failed['residual']} of {runs_of_each}" in TEXT
    assert f"`from-nothing` {failed['from-nothing']}, the default {failed['linearised']}." in TEXT


# --- sentences: tables ---------------------------------------------------------------------------


def test_at_constant_speed():
    for task in ("`circle`, nominal", "`corridor`, nominal"):
        assert words(task, "residual", cells.BASE) == "better"
        assert words(task, "from-nothing", cells.BASE) != "better"
        assert words(task, "from-nothing") == "worse"
    for row in named("rows"):
        assert words(row, "from-nothing") == "worse"


def test_other_tasks():
    stops = {entry: median_mm("`stop_and_go`, nominal", entry) for entry in ENTRIES}
    others = [value for entry, value in stops.items() if entry != "consistent"]
    assert stops["consistent"] < 2
    assert f"All others have {min(others):.1f} to {max(others):.1f} mm." in TEXT
    hardware = "`infinity_hardware`, hardware"
    assert tables.best_classical(LINES, hardware) == "adrc"
    for entry in LEARNED:
        assert words(hardware, entry, cells.BASE) == "better"
        assert words(hardware, entry) == "worse"
    assert not any(lost("`warehouse`, nominal", entry) for entry in ENTRIES)
    for blind in ("`slalom_posts`, nominal", "`crossing_traffic`, nominal"):
        assert all(lost(blind, entry) == len(LINES[blind, entry]["rms_mm"]) for entry in ENTRIES)


def test_the_number_of_robots_hardly_matters():
    for entry in LEARNED:
        for path in ("∞", "flower"):
            for disturbance in ("nominal", "combined-medium"):
                few, many = (
                    median_mm(f"{path}, {count} robots, {disturbance}", entry) for count in (3, 5)
                )
                assert abs(many / few - 1) < 0.15


def test_how_near_references_come():
    t_s = np.arange(0.0, 60.0, 0.02)

    def place(times_s):
        return 2000 * np.stack([np.sin(0.125 * times_s), np.sin(0.25 * times_s)])

    nearest = [np.hypot(*(place(t_s + gap) - place(t_s))).min() for gap in (2, 3, 5)]
    assert "within {:.0f} and {:.0f} mm of".format(*nearest) in TEXT
    assert f"with 5 s within {nearest[2]:.0f} mm" in TEXT


def test_short_gaps():
    for gap in ("2 s", "3 s"):
        for disturbance in ("nominal", "combined-medium"):
            name = f"{gap}, {disturbance}"
            limited = [median_mm(name, one) for one in ("linearised", "adrc", "kanayama")]
            assert min(limited) > 20
            assert median_mm(name, "residual") == pytest.approx(limited[0], rel=0.02)
            for other in limited:
                assert 1.35 < median_mm(name, "from-nothing") / other < 1.95
        assert median_mm(f"{gap}, nominal", "consistent") < 6


def test_a_long_gap():
    def ratio(entry):
        return median_mm("8 s, nominal", entry) / median_mm("∞, 3 robots, nominal", entry)

    for entry in ("linearised", "adrc", "kanayama"):
        assert ratio(entry) == pytest.approx(1, abs=0.05)
    assert ratio("residual") == pytest.approx(2, abs=0.25)
    assert ratio("from-nothing") == pytest.approx(3, abs=0.25)


def test_disturbances():
    families = ("swell", "slip-sines", "pushes", "creep", "rolling", "radio", "fixes-camera")
    for name in named("disturbances"):
        if CELLS[name].disturbance in families or name == "`fixes-outage` × 0.5":
            assert words(name, "residual") == words(name, "from-nothing") == "better"
    for entry in LEARNED:
        assert words("`fixes-outage`", entry) == "no difference"
    assert all(lost("`fixes-uwb`", entry) == 20 for entry in ENTRIES)


def test_ice_on_the_right():
    ice = "`split-ice-right`"
    failed = {entry: lost(ice, entry) for entry in ENTRIES}
    assert failed["residual"] == failed["adrc"] == 0
    assert f"has an error of {median_mm(ice, 'residual'):.0f} mm" in TEXT
    assert f"Its base loses {failed['linearised']} of 20, `kanayama` {failed['kanayama']}," in TEXT
    assert f"which was trained with it, {failed['from-nothing']}." in TEXT


def test_causes():
    gap, place, torques, mixed = causes.CAUSES

    def after(cause, entry):
        return median_mm(causes.key_of(cause), entry)

    assert after(gap, "kanayama") < 1
    assert not lost(causes.key_of(gap), "kanayama")
    assert after(place, "from-nothing") < 0.5 * median_mm(place.cell, "from-nothing")
    assert after(place, "residual") > 0.9 * median_mm(place.cell, "residual")
    for entry in LEARNED:
        assert after(mixed, entry) > median_mm(mixed.cell, "adrc")
    heavy = torques.cell
    assert after(torques, "residual") < min(median_mm(heavy, entry) for entry in CLASSICAL)
    quarter = after(torques, "from-nothing") / median_mm(heavy, "from-nothing")
    assert quarter == pytest.approx(0.25, abs=0.03)
    assert cells.scenario_of(CELLS[heavy]).robot.torque_limit_Nmm == 10 * 15


# --- sentences: along the row --------------------------------------------------------------------


def test_one_slip():
    change = {
        entry: LINES[kick.KICK, entry]["row_mm"][-1] / LINES[kick.KICK, entry]["row_mm"][2] - 1
        for entry in ENTRIES
    }
    percent = {entry: round(100 * abs(value)) for entry, value in change.items()}
    assert all(change[entry] < 0 for entry in (*LEARNED, "linearised", "kanayama"))
    learned = sorted(percent[entry] for entry in LEARNED)
    assert f"shrinks by {learned[0]} to {learned[1]} %," in TEXT
    assert (
        f"by {percent['kanayama']} to {percent['linearised']} % with `kanayama` and `linearised`"
        in TEXT
    )
    assert f"grows by {percent['adrc']} % with `adrc`" in TEXT
    assert f"by {percent['consistent']} % with `consistent`" in TEXT


def test_errors_along_twenty_robots():
    own, path = {}, {}
    for entry in ENTRIES:
        line = LINES["20 robots, nominal", entry]
        own[entry] = line["row_mm"][-1] / line["row_mm"][1]
        path[entry] = line["path_mm"][-1] / line["path_mm"][1]
    assert all(own[entry] <= 1.25 for entry in LEARNED)
    assert own["adrc"] == pytest.approx(1.5, abs=0.05)
    assert own["consistent"] == pytest.approx(6, abs=0.1)
    others = [value for entry, value in path.items() if entry != "consistent"]
    assert min(others) > 5
    assert max(others) < 9.5
    assert f"{path['consistent']:.0f}-fold" in TEXT


def test_the_most_precise_leader_has_the_largest_gain():
    for row in named("rows"):
        lines = {entry: LINES[row, entry] for entry in ENTRIES}
        assert min(ENTRIES, key=lambda entry: lines[entry]["path_mm"][-1]) == "residual"
        assert min(ENTRIES, key=lambda entry: lines[entry]["path_mm"][0]) == "residual"
        assert max(ENTRIES, key=lambda entry: lines[entry]["gain"]) == "residual"
        ahead, behind = lines["residual"]["path_mm"][:2]
        assert lines["residual"]["gain"] == pytest.approx(behind / ahead, rel=0.05)


def test_only_consistent_loses_long_rows():
    failed = {(row, entry): lost(row, entry) for row in named("rows") for entry in ENTRIES}
    assert {key: count for key, count in failed.items() if count} == {
        ("20 robots, pushes", "consistent"): 5
    }
