"""Seed ranges: which seeds may train and tune, which may choose, and which are for tables only."""

from __future__ import annotations

SeedRange = tuple[int, int]  # first seed, and the one after the last

TRAINING_SEEDS: SeedRange = (0, 10_000)
CHOOSING_SEEDS: SeedRange = (10_000, 20_000)
FIRST_TABLE_SEED = CHOOSING_SEEDS[1]
USES = (
    f"seeds {TRAINING_SEEDS[0]} to {TRAINING_SEEDS[1] - 1} train and tune, "
    f"{CHOOSING_SEEDS[0]} to {CHOOSING_SEEDS[1] - 1} choose, {FIRST_TABLE_SEED} and above are for "
    "tables"
)


def check_seeds(what: str, seeds: SeedRange, allowed: SeedRange) -> None:
    """Check that a range of seeds is not empty and lies within the range for its use.

    Parameters
    ----------
    what
        Name of the range in the error.

    Raises
    ------
    ValueError
        for an empty range, or a seed that is reserved for another use.
    """
    first, end = seeds
    if first >= end:
        raise ValueError(f"{what} {first}:{end} must be FIRST:END with FIRST below END")
    if not allowed[0] <= first < end <= allowed[1]:
        raise ValueError(
            f"{what} {first} to {end - 1} must lie within {allowed[0]} to {allowed[1] - 1}: {USES}"
        )
