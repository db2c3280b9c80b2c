"""A short part of the fuzzing campaign, cases that it once found, and the campaign's own eyes.

``python tests/campaign/fuzz.py`` runs the whole: files, mappings, actions, snapshots, arguments, commands.
"""

from __future__ import annotations

import json
import math
import os
import signal
import sys
from collections.abc import Callable
from typing import Any

import pytest
from campaign import fuzz
from campaign.fuzzing import TARGETS, Target, encoded, restored
from campaign.fuzzing.checks import finite, refused
from campaign.fuzzing.parts import robot_bases
from campaign.fuzzing.results import data_sets, run_files
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from baselines.benchmark.plan import parse_seeds, parse_sweep
from baselines.data.files import read_rows

EXAMPLES, MOST = 10, 20  # of a target with the share 1, and of any
NEEDS = {"datasets": "pyarrow"}


@pytest.mark.parametrize("name", TARGETS)
def test_hostile_cases_are_refused_or_valid(name):
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])

    @settings(
        max_examples=min(max(2, round(EXAMPLES * TARGETS[name].share)), MOST),
        derandomize=True,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(TARGETS[name].cases)
    def attempt(case: Any) -> None:
        found = fuzz.tried(name, encoded(case))
        assert found is None, found.message

    attempt()


# Cases that the campaign has found, by target. Each failed before it was mended.
FOUND: dict[str, tuple[str, Callable[[], Any]]] = {
    "a robot of 1e150 kg": ("robots", lambda: {**robot_bases()[0], "mass_kg": 1.2e150}),
    "an axle of 1e152 mm": ("robots", lambda: {**robot_bases()[0], "axle_width_mm": 1.6e152}),
    "a tolerance of 1e-11 mm": (
        "controllers",
        lambda: {"kind": "lqr", "data": {"forward_mm": 1e-11, "horizon_s": 3.0, "step_s": 0.03}},
    ),
    "a horizon of 1e12 steps": (
        "controllers",
        lambda: {"kind": "lqr", "data": {"horizon_s": 1e6, "step_s": 1e-6}},
    ),
    "a snapshot with a slip of 1e100 mm/s": ("snapshots", lambda: [True, [[1, 32, 1e100]]]),
    "an empty file of arrays": ("results", lambda: b""),
    "a run without a scenario": (
        "results",
        lambda: {**run_files()[0], "scenario": {"robots": "x"}},
    ),
    "a run with an infinite seed": ("results", lambda: {**run_files()[0], "seed": math.inf}),
    "a run with odd options": ("results", lambda: {**run_files()[0], "reset_options": 3}),
    "a setting with a control character": ("settings", lambda: ["name=@\r"]),
    "an entry's folder with a long name": ("policy_names_", lambda: "entry:" + 2000 * "x"),
    "a system with a long name": ("policy_names_", lambda: "reference:+" + 2000 * "x"),
    "arrays of texts": ("result_arrays", lambda: [0, "text"]),
}


@pytest.mark.parametrize("what", FOUND)
def test_what_was_found_is_mended(what):
    target, case = FOUND[what]
    found = fuzz.tried(target, encoded(case()))
    assert found is None, found.message


def test_a_sweep_has_a_limit():
    """Its values are made at once: a billion of them took minutes and all memory."""
    with pytest.raises(ValueError, match="with COUNT from 2 to 10000"):
        parse_sweep("level=0:1:999999999")
    assert len(parse_sweep("level=0:1:10000")[1]) == 10_000


def test_seeds_have_a_limit():
    """Their episodes are listed before the first is run."""
    with pytest.raises(ValueError, match="are more than 1000000, the most of a plan"):
        parse_seeds("0:1000000000000")
    assert parse_seeds("0:1000000") == (0, 1_000_000)


def test_a_damaged_data_set_is_refused_in_one_line(tmp_path):
    """What reads Parquet may say why in several lines."""
    pytest.importorskip("pyarrow")
    data = bytearray(data_sets()[0])
    for place in range(4, 400, 7):
        data[place] ^= 0x55
    (tmp_path / "own.parquet").write_bytes(data)
    with pytest.raises(ValueError, match=r"^[^\n]+$"):
        read_rows(tmp_path / "own.parquet")


# The campaign sees what it looks for.


def crash(_: Any) -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def lines(_: Any) -> None:
    def raising() -> None:
        raise ValueError("two\nlines")

    refused(raising)


EYES = {
    "a crash": (crash, f"the interpreter ended with status {-signal.SIGSEGV}"),
    "a number": (lambda _: finite("numbers", [1.0, math.nan]), "numbers are not finite"),
    "lines": (lines, "a ValueError of several lines"),
    "another error": (lambda _: {}["x"], "KeyError in a library"),
    "an exit": (lambda _: sys.exit(0), "SystemExit in a library"),
}


@pytest.mark.parametrize("what", EYES)
def test_the_campaign_sees(what, tmp_path, monkeypatch):
    check, signature = EYES[what]
    monkeypatch.setitem(TARGETS, "own", Target(st.integers(0, 3), check))
    _, found = fuzz.batch("own", 5, 0, set(), tmp_path)
    assert [one.signature for one in found] == [signature]
    path = fuzz.save(found[0], tmp_path)
    assert json.loads(path.read_text())["case"] == 0  # the smallest
    again, known = fuzz.batch("own", 5, 0, {signature}, tmp_path)
    if what != "a crash":
        assert (again > 0, known) == (True, [])


def test_a_hang_is_seen(tmp_path, monkeypatch):
    monkeypatch.setattr(fuzz, "CASE_LIMIT_S", 1)
    monkeypatch.setitem(TARGETS, "own", Target(st.just(0), lambda _: signal.pause()))
    _, found = fuzz.batch("own", 1, 0, set(), tmp_path)
    assert [one.signature for one in found] == ["HangError in a library"]


def test_a_campaign_counts_and_goes_on(tmp_path, monkeypatch):
    monkeypatch.setitem(TARGETS, "own", Target(st.integers(), lambda _: None))
    counts = fuzz.campaign(["own"], 30, 1, tmp_path)
    counts = fuzz.campaign(["own"], 30, 2, tmp_path)
    assert counts["own"]["cases"] == 60
    assert json.loads((tmp_path / "fuzz.json").read_text()) == counts


def test_the_table_has_a_row_for_each_kind():
    counts = {
        "paths": {"cases": 3, "findings": [1]},
        "open_loops": {"cases": 4, "findings": []},
        "plans": {"cases": 5, "findings": []},
    }
    guided = {"paths": {"cases": 60, "status": 0}, "option_texts": {"cases": 70, "status": 77}}
    assert fuzz.table(counts, guided)[2:] == [
        "| Files of paths and of torques | 7 | 60 | 1 |",
        "| Plans, trainings, searches, knobs, and the texts of their options | 5 | 70 | 1 |",
        "| **all** | 12 | 130 | 2 |",
    ]


def test_cases_come_back_from_their_files():
    case = {"a": [b"\xff\x00", math.inf, 10**40, None, {"b": "\ud800"}], "c": -0.0}
    assert restored(json.loads(json.dumps(encoded(case)))) == case
