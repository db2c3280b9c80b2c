"""Comparison of each entry with the best of the other policies, on the same seeds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import binomtest

from baselines.benchmark.lines import Line, Strata, failures, stratum_of, worst
from baselines.benchmark.statistics import paired
from baselines.policies.registry import policy_names
from baselines.policies.systems import parse_system
from baselines.runs.outcome import failed
from tlf_env.common.presets import preset_names

COMPARED = {  # metric: how a policy is compared with its rival, both at the run's worst robot
    "position_rmse_mm": "difference",
    "error_capped_mean_mm": "difference",
    "torque_rms_Nmm": "ratio",
}

SIGNIFICANT = 0.05
LEAST_RUNS = (
    6  # of fewer pairs, even differences that all have one sign are no evidence at that level
)


def comparisons(groups: Mapping[str, Strata], ranked: Sequence[str]) -> list[dict[str, Any]]:
    """Each entry against the best of the other policies, stratum by stratum, on the same seeds.

    Entries are the policies that are not built in, for example learned policies.
    Without such a policy, the first of ``ranked`` is the entry. The rival in a stratum is the other
    policy with the fewest failed runs, and among equals the one with the smallest median position RMS.
    It is chosen by the same runs that are compared, which favours the rival. A privileged policy
    cannot be the rival.

    Raises
    ------
    ValueError
        if an entry and its rival have not run the same seeds.
    """
    entries = [policy for policy in groups if not built_in(policy)] or list(ranked[:1])
    others = [
        policy
        for policy, strata in groups.items()
        if policy not in entries
        and not any(line["privileged"] for lines in strata.values() for line in lines)
    ]
    rows = []
    for entry in entries:
        for stratum, lines in groups[entry].items():
            rivals = {name: groups[name][stratum] for name in others if stratum in groups[name]}
            if rivals:
                rival = min(rivals, key=lambda name: standing(rivals[name]))
                rows.append(comparison(lines, rivals[rival]))
    return rows


def built_in(policy: str) -> bool:
    """Whether a policy is among the package's named ones, or a system of its named parts."""
    known = ("reference", *policy_names())
    system = parse_system(policy)
    if system is None:
        return policy in known
    return system.controller in known and system.limiter in (None, *preset_names("limiter"))


def standing(lines: Sequence[Line]) -> tuple[int, float]:
    """Rank of a policy in a stratum, less is better: failed runs, then the median position RMS."""
    values = [worst(line, "position_rmse_mm") for line in lines]
    defined = [value for value in values if value is not None]
    return failures(lines), float(np.median(defined)) if defined else math.inf


def comparison(mine: Sequence[Line], theirs: Sequence[Line]) -> dict[str, Any]:
    """Difference between a policy and its rival in one stratum.

    Raises
    ------
    ValueError
        if they have not run the same seeds.
    """
    other = {line["seed"]: line for line in theirs}
    if sorted(other) != sorted(line["seed"] for line in mine):
        place = ", ".join(str(part) for part in stratum_of(mine[0]) if part is not None)
        raise ValueError(
            f"{mine[0]['policy']} and {theirs[0]['policy']} have not run the same seeds of {place}"
        )
    pairs = [(line, other[line["seed"]]) for line in mine]
    task, disturbance, swept = stratum_of(mine[0])
    return {
        "policy": mine[0]["policy"],
        "rival": theirs[0]["policy"],
        "task": task,
        "disturbance": disturbance,
        "sweep": swept,
        "runs": len(pairs),
        "failed": [failures(mine), failures(theirs)],
        **{
            metric: paired([(worst(a, metric), worst(b, metric)) for a, b in pairs], how)
            for metric, how in COMPARED.items()
        },
    }


def only_one_failed(mine: Sequence[Line], theirs: Sequence[Line]) -> tuple[int, int]:
    """The number of seeds of which only the first policy fails, and only the second."""
    other = {line["seed"]: failed(line["robots"]) for line in theirs}
    pairs = [
        (failed(line["robots"]), other[line["seed"]]) for line in mine if line["seed"] in other
    ]
    return sum(a and not b for a, b in pairs), sum(b and not a for a, b in pairs)


def in_words(row: Mapping[str, Any], only: tuple[int, int]) -> str:
    """A comparison in one stratum in words: ``better: …``, ``worse: …``, ``no difference``, or ``unclear: …``.

    Failures come first: by the exact sign test of the seeds that only one of them fails. Where it finds no
    difference, the interval of the paired differences of the position RMS decides, unless failures point the
    other way, or both fail in most runs, or there are fewer than :data:`LEAST_RUNS`.

    Parameters
    ----------
    row
        As of :func:`comparison`.
    only
        As of :func:`only_one_failed`.
    """
    mine, theirs = row["failed"]
    ends = row["position_rmse_mm"]["interval"]
    if sum(only) and binomtest(only[0], sum(only)).pvalue < SIGNIFICANT:
        return "better: fails less" if only[0] < only[1] else "worse: fails more"
    if ends is None or row["runs"] < LEAST_RUNS:
        return "too few runs"
    if 2 * min(mine, theirs) > row["runs"]:
        return "no difference: both fail"
    if ends[1] < 0:
        return (
            "better: smaller error" if mine <= theirs else "unclear: smaller error, more failures"
        )
    if ends[0] > 0:
        return "worse: larger error" if mine >= theirs else "unclear: larger error, fewer failures"
    return "no difference"
