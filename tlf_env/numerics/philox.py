"""Random numbers without stored state: Philox 4×64 with ten rounds.

A draw is a function of (seed, channel, robot, episode, index) alone. The order of the robots, the size
of a batch, a partial reset or a snapshot cannot change a draw, and no channel shifts another's draws.
Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011.
"""

from __future__ import annotations

import math

import numpy as np

from tlf_env.common.errors import shown
from tlf_env.numerics.compiled import law, law_in_double
from tlf_env.numerics.trig import log, sincos

MULTIPLIER_0 = np.uint64(0xD2E7470EE14C6C93)
MULTIPLIER_1 = np.uint64(0xCA5A826395121157)
WEYL_0 = np.uint64(0x9E3779B97F4A7C15)
WEYL_1 = np.uint64(0xBB67AE8584CAA73B)
LOW_32 = np.uint64(0xFFFFFFFF)
SHIFT_32 = np.uint64(32)
SHIFT_1, SHIFT_31 = np.uint64(1), np.uint64(31)
SHIFT_11 = np.uint64(11)
ZERO, TWO, FOUR, SIX, EIGHT = (np.uint64(i) for i in (0, 2, 4, 6, 8))
UNIT = 2.0**-53

MAX_SEED = 2**63 - 1

Words = tuple[np.uint64, np.uint64, np.uint64, np.uint64]


@law
def high_product(a: np.uint64, b: np.uint64) -> np.uint64:
    """Upper 64 bits of the product of two unsigned 64-bit integers.

    The two middle products are added as twice their mean, which cannot overflow. The compiler would
    recognise the usual sum with carries as one 128-bit product, which has no vector instruction.
    """
    a_low, a_high = a & LOW_32, a >> SHIFT_32
    b_low, b_high = b & LOW_32, b >> SHIFT_32
    middle = a_high * b_low + ((a_low * b_low) >> SHIFT_32)
    other = a_low * b_high
    mean = (middle & other) + ((middle ^ other) >> SHIFT_1)
    return a_high * b_high + (mean >> SHIFT_31)


@law
def two_rounds(
    c_0: np.uint64, c_1: np.uint64, c_2: np.uint64, c_3: np.uint64, k_0: np.uint64, k_1: np.uint64
) -> Words:
    """Two Philox rounds; the second uses the next keys."""
    high_0, low_0 = high_product(MULTIPLIER_0, c_0), MULTIPLIER_0 * c_0
    high_1, low_1 = high_product(MULTIPLIER_1, c_2), MULTIPLIER_1 * c_2
    c_0, c_1, c_2, c_3 = high_1 ^ c_1 ^ k_0, low_1, high_0 ^ c_3 ^ k_1, low_0
    high_0, low_0 = high_product(MULTIPLIER_0, c_0), MULTIPLIER_0 * c_0
    high_1, low_1 = high_product(MULTIPLIER_1, c_2), MULTIPLIER_1 * c_2
    return high_1 ^ c_1 ^ (k_0 + WEYL_0), low_1, high_0 ^ c_3 ^ (k_1 + WEYL_1), low_0


@law
def philox(
    c_0: np.uint64, c_1: np.uint64, c_2: np.uint64, c_3: np.uint64, k_0: np.uint64, k_1: np.uint64
) -> Words:
    """Four random words for a counter of four words and a key of two; all ``uint64``.

    The ten rounds are written out: an inner loop would prevent vectorisation over robots.
    """
    c_0, c_1, c_2, c_3 = two_rounds(c_0, c_1, c_2, c_3, k_0, k_1)
    c_0, c_1, c_2, c_3 = two_rounds(c_0, c_1, c_2, c_3, k_0 + WEYL_0 * TWO, k_1 + WEYL_1 * TWO)
    c_0, c_1, c_2, c_3 = two_rounds(c_0, c_1, c_2, c_3, k_0 + WEYL_0 * FOUR, k_1 + WEYL_1 * FOUR)
    c_0, c_1, c_2, c_3 = two_rounds(c_0, c_1, c_2, c_3, k_0 + WEYL_0 * SIX, k_1 + WEYL_1 * SIX)
    return two_rounds(c_0, c_1, c_2, c_3, k_0 + WEYL_0 * EIGHT, k_1 + WEYL_1 * EIGHT)


@law_in_double
def words(seed: int, channel: int, robot: int, episode: int, index: int) -> Words:
    """The four words of one draw; all arguments are non-negative whole numbers."""
    key = (np.uint64(channel) << SHIFT_32) | np.uint64(robot)
    return philox(np.uint64(index), np.uint64(episode), ZERO, ZERO, np.uint64(seed), key)


@law_in_double
def unit(word: np.uint64) -> float:
    """A float in [0, 1) from the upper 53 bits of a word."""
    return float(word >> SHIFT_11) * UNIT


@law_in_double
def normal_pair(
    seed: int, channel: int, robot: int, episode: int, index: int
) -> tuple[float, float]:
    """Two independent standard normal numbers (Box and Muller)."""
    w_0, w_1, _, _ = words(seed, channel, robot, episode, index)
    radius = math.sqrt(-2.0 * log(1.0 - unit(w_0)))
    sin, cos = sincos(2.0 * math.pi * unit(w_1))
    return radius * cos, radius * sin


def checked_seed(seed: int) -> int:
    """A seed as a plain int.

    Raises
    ------
    ValueError
        if it is not a whole number from 0 to 2⁶³ − 1.
    """
    if (
        isinstance(seed, bool)
        or not isinstance(seed, int | np.integer)
        or not 0 <= seed <= MAX_SEED
    ):
        raise ValueError(f"seed {shown(seed)} must be a whole number from 0 to {MAX_SEED}")
    return int(seed)
