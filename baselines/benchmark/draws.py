"""Random numbers from which the test set's cases are made, the same on every machine and version."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from typing import TypeVar

import numpy as np

ItemT = TypeVar("ItemT")

DIGITS = 4  # significant digits of a drawn number: rounding in the last place does not matter


def rounded(value: float, digits: int = DIGITS) -> float:
    """A number to some significant digits."""
    return float(f"{value:.{digits}g}")


def words_of(text: str) -> tuple[int, ...]:
    """A text as eight 32-bit words, by SHA-256; no words for an empty text."""
    if not text:
        return ()
    digest = hashlib.sha256(text.encode()).digest()
    return tuple(int.from_bytes(digest[i : i + 4], "big") for i in range(0, 32, 4))


class Draws:
    """A stream of random numbers that depends on some whole numbers alone.

    It uses only NumPy's ``SeedSequence`` and PCG64 as uniform numbers, which do not change between
    versions; the other distributions of ``Generator`` may.
    """

    def __init__(self, *entropy: int) -> None:
        self._random = np.random.Generator(np.random.PCG64(np.random.SeedSequence(entropy)))

    def unit(self) -> float:
        """Uniform in [0, 1)."""
        return float(self._random.random())

    def uniform(self, low: float, high: float) -> float:
        """Uniform between two numbers."""
        return rounded(low + (high - low) * self.unit())

    def log(self, low: float, high: float) -> float:
        """Uniform in the logarithm between two positive numbers."""
        return rounded(low * (high / low) ** self.unit())

    def angle(self) -> float:
        """Uniform in (−π, π], rad."""
        return self.uniform(-math.pi, math.pi)

    def whole(self, low: int, high: int) -> int:
        """A whole number, both ends included."""
        return low + int(self.unit() * (high - low + 1))

    def chance(self, probability: float) -> bool:
        """True with a probability."""
        return self.unit() < probability

    def pick(self, items: Sequence[ItemT]) -> ItemT:
        """One of some items."""
        return items[self.whole(0, len(items) - 1)]
