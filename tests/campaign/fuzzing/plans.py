"""Plans, trainings, searches, knobs, and the texts of their options."""

from __future__ import annotations

import functools
from typing import Any

from campaign.fuzzing.cases import changed, word
from campaign.fuzzing.checks import REFUSED, finite, refused, working_folder
from campaign.fuzzing.registry import target
from hypothesis import strategies as st

from baselines.benchmark.envelope import load_knob
from baselines.benchmark.plan import parse_pairs, parse_seeds, parse_sweep, read_plan
from baselines.cli import PLAN_OPTIONS
from baselines.training.config import load_config
from baselines.tuning.config import load_tune
from tlf_env.common.presets import preset_names, read_preset_or_file, yaml_text


@functools.cache
def plan_bases() -> list[Any]:
    return [read_preset_or_file("plan", name) for name in preset_names("plan")]


@functools.cache
def training_bases() -> list[Any]:
    return [load_config(name).model_dump(mode="json") for name in ("quick", "residual", "scratch")]


@functools.cache
def search_bases() -> list[Any]:
    return [
        read_preset_or_file("search", name) for name in preset_names("search") if name != "nmpc"
    ]


@functools.cache
def knob_bases() -> list[Any]:
    return [read_preset_or_file("knob", name) for name in preset_names("knob")]


@target(changed(plan_bases), share=1.5)
def plans(case: Any) -> None:
    """Plans of a benchmark, and the texts of its options."""
    with working_folder() as folder:
        (folder / "own.yaml").write_text(yaml_text(case))
        found = refused(lambda: read_plan("own.yaml", PLAN_OPTIONS))
    if found is REFUSED:
        return
    for name, parse in (("seeds", parse_seeds), ("sweep", parse_sweep), ("also", parse_pairs)):
        if name in found:
            refused(lambda: parse(str(found[name])))


@target(st.one_of(word, st.text(alphabet="0123456789:=.,logeE+-x", max_size=20)), share=2.0)
def option_texts(case: str) -> None:
    """Texts of seeds, sweeps and pairs."""
    for parse in (parse_seeds, parse_sweep, parse_pairs):
        found = refused(lambda: parse(case))
        if parse is parse_sweep and found is not REFUSED:
            finite("values of a sweep", found[1])


@target(changed(training_bases, most=3), share=0.5)
def trainings(case: Any) -> None:
    """Configurations of trainings."""
    with working_folder() as folder:
        (folder / "own.yaml").write_text(yaml_text(case))
        refused(lambda: load_config("own.yaml"))


@target(changed(search_bases, most=3), share=0.3)
def searches(case: Any) -> None:
    """Configurations of searches."""
    with working_folder() as folder:
        (folder / "own.yaml").write_text(yaml_text(case))
        refused(lambda: load_tune("own.yaml"))


@target(changed(knob_bases, most=3), share=1.0)
def knobs(case: Any) -> None:
    """Knobs of envelopes."""
    with working_folder() as folder:
        (folder / "own.yaml").write_text(yaml_text(case))
        found = refused(lambda: load_knob("own.yaml"))
        if found is not REFUSED:
            for level in (found.levels[0], found.levels[-1]):
                refused(lambda: found.scenario("infinity", level, 2.0))
