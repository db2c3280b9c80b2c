"""Policies that see observations only, and what is done with them: runs, figures, tables, training."""

from __future__ import annotations

from baselines.policies.learned import load_policy
from baselines.policies.reference import ReferencePolicy

__all__ = ["ReferencePolicy", "load_policy"]
