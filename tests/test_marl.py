"""The comparison of central and own critics: its table, its figure, and what the page says of it."""

from __future__ import annotations

import importlib
import json
import re
from pathlib import Path

import numpy as np
import pytest

DOCS = Path(__file__).resolve().parents[1] / "docs"
SECTION = "## A critic with the truth"


@pytest.fixture
def make_marl(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS / "figures"))
    return importlib.import_module("make_marl")


@pytest.fixture
def kept():
    return json.loads((DOCS / "learning" / "marl.json").read_text(encoding="utf-8"))


def section() -> str:
    page = (DOCS / "learning.md").read_text(encoding="utf-8")
    return page.split(SECTION)[1].split("\n## ")[0]


def test_the_page_has_the_table_of_the_kept_runs(make_marl, kept):
    assert make_marl.table(kept) in section()


def test_an_interval_is_that_of_student_s_t(make_marl):
    """Logarithms −1, 0, 1: by the table of the distribution ± 4.303 · 1/√3."""
    half = 4.303 / np.sqrt(3)
    assert make_marl.interval([0.1, 1.0, 10.0]) == f"1 [{10**-half:.3g}, {10**half:.0f}]"


def test_a_ratio_of_equal_groups_is_one_and_of_distant_ones_not(make_marl):
    values = [1.0, 2.0, 4.0]
    middle, low, high = map(
        float, make_marl.ratio(values, values).strip("]").replace("[", "").replace(",", "").split()
    )
    assert low < middle == 1.0 < high
    far = make_marl.ratio([100 * value for value in values], values)
    assert far.startswith("100 [")
    assert float(far.split("[")[1].split(",")[0]) > 1


def test_every_row_counts_the_runs_of_its_seeds(make_marl):
    runs = [
        {
            "variant": "IPPO",
            "seed": seed,
            "minutes": 2.0 + seed,
            "returns": [1.0, 2.0],
            "nominal": {"rms_mm": [10.0] * 50, "failed": [0] * 50},
            "slip": {"rms_mm": [100.0] * 50, "failed": [1] * 10 + [0] * 40},
        }
        for seed in range(3)
    ]
    row = make_marl.table(runs).splitlines()[-1]
    assert row == "| IPPO | 3 | 10 [10, 10] | 100 [100, 100] |  | 0 of 150 | 30 of 150 | 3.0 |"


def test_the_figure_is_drawn(make_marl, kept, tmp_path):
    path = tmp_path / "marl.png"
    make_marl.draw(kept, path)
    assert path.read_bytes().startswith(b"\x89PNG")


def test_the_page_says_what_the_runs_show(make_marl, kept):
    own = "MAPPO, a value and a network for each robot, all observations"
    central = {
        "MAPPO": "one value for the formation {} of 250 nominal runs fail",
        "MAPPO, all observations": "observations in place of the state {}, with",
        "MAPPO, a value for each robot": "with a value for each robot {}, and",
        "MAPPO, a value for each robot, all observations": "with both\n  changes {}.",
        own: "",
    }
    of = {name: [one for one in kept if one["variant"] == name] for name in make_marl.VARIANTS}
    assert [len(runs) for runs in of.values()] == [make_marl.SEEDS] * 7
    failed = {name: sum(sum(one["nominal"]["failed"]) for one in runs) for name, runs in of.items()}
    assert failed["IPPO"] == 0
    medians = {
        name: [float(np.median(one["nominal"]["rms_mm"])) for one in runs]
        for name, runs in of.items()
    }
    ratios = []
    for name, claim in central.items():
        assert claim.format(failed[name]) in section()
        middle, low, _ = re.findall(r"[\d.]+", make_marl.ratio(medians[name], medians["IPPO"]))
        assert float(low) > 1
        ratios.append(float(middle))
    assert f"{min(ratios):.0f} to {max(ratios):.0f} times smaller" in section()
    assert max(medians["IPPO"]) / min(medians["IPPO"]) == pytest.approx(20, rel=0.1)
    unshared = "IPPO, a network for each robot"
    lost = [sum(one["nominal"]["failed"]) for one in of[unshared]]
    assert sorted(lost) == [0, 0, 0, 0, 50]
    middle, low, high = make_marl.ratio(medians[unshared], medians["IPPO"]).strip("]").split()
    assert (f"{float(middle):.1f}", f"{float(low.strip('[,')):.1f}") == ("4.0", "0.7")
    assert high == "24"
    assert "4.0 times that with a shared network, with an interval from 0.7 to 24" in section()
    with_both = "MAPPO, a value for each robot, all observations"
    found = [
        make_marl.ratio(medians[name], medians["IPPO"]).split()[0] for name in (own, with_both)
    ]
    assert [round(float(one)) for one in found] == [24, 9]
