"""Policies that act on observations only, and tools for them: runs, figures, benchmark, tuning, training."""

from __future__ import annotations

from baselines.policies.learned import load_policy
from baselines.policies.reference import ReferencePolicy

__all__ = ["ReferencePolicy", "load_policy"]
