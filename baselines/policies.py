"""Policies by name."""

from __future__ import annotations

from baselines.reference import ReferencePolicy
from baselines.run import Policy

POLICIES = ("reference",)


def make_policy(name: str, gains: str = "consistent") -> Policy:
    """A policy by name; ``gains`` are those of the reference.

    Raises
    ------
    ValueError
        naming the policies, or the gain presets, there are.
    """
    if name != "reference":
        raise ValueError(f"policy {name!r} is not one of {', '.join(POLICIES)}")
    return ReferencePolicy(gains)
