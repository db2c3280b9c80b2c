"""Policies that act on observations only, and tools for them: runs, figures, benchmark, tuning, training."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from baselines.policies.learned import load_policy
    from baselines.policies.reference import ReferencePolicy

__all__ = ["ReferencePolicy", "load_policy"]

# Imported when they are asked for: they need Numba, and `tlf --help` does not.
_MODULES = {
    "ReferencePolicy": "baselines.policies.reference",
    "load_policy": "baselines.policies.learned",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(_MODULES[name]), name)
