"""Indices that compiled code need not check."""

from __future__ import annotations

from tlf_env.numerics.compiled import law

LARGEST = 2**63 - 1


@law
def natural(number: int) -> int:
    """The same whole number, at least 0, of which the compiler then knows that it is not negative.

    An index of unknown sign is compared with 0 at each use, since a negative one counts from an array's end.
    A loop over such indices gathers and scatters single numbers in place of whole vectors.
    """
    return number & LARGEST


@law
def slot_of(step: int, slots: int) -> int:
    """The place of a step of at least 0 in a ring of so many slots."""
    return natural(step) % natural(slots)
