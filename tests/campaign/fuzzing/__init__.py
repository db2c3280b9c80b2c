"""What is fuzzed: for each target the cases, and what a case must not do. ``fuzz.py`` runs them.

A module for each kind of target; importing this package registers all of them.
"""

from campaign.fuzzing import (
    actions,
    command_line,
    constructors,
    entries,
    files,
    parts,
    plans,
    policies,
    results,
    scenarios,
    snapshots,
)
from campaign.fuzzing.cases import encoded, restored
from campaign.fuzzing.registry import TARGETS, Target, ViolationError

__all__ = [
    "TARGETS",
    "Target",
    "ViolationError",
    "actions",
    "command_line",
    "constructors",
    "encoded",
    "entries",
    "files",
    "parts",
    "plans",
    "policies",
    "restored",
    "results",
    "scenarios",
    "snapshots",
]
