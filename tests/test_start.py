"""The options of a reset, read without an environment."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tlf_env.task.start import PHASE_LIMIT_S, start_options

POSES = [[0.0, 0.0, 0.0], [0.0, -300.0, 0.0]]


def refusal(options: Any, formations: int | None = None) -> str:
    with pytest.raises(ValueError, match=r"\Areset option.*\Z") as caught:
        start_options(options, 2, formations)
    return str(caught.value)


@pytest.mark.parametrize("phase_s", [0, 12.5, np.float32(3), -PHASE_LIMIT_S, PHASE_LIMIT_S])
def test_a_phase_within_the_limit_is_taken(phase_s):
    assert start_options({"phase_s": phase_s}, 2).phases_s.tolist() == [phase_s]


@pytest.mark.parametrize("phase_s", [1e300, -1e300, 1.001e9, 10**400, np.inf, np.nan])
def test_a_phase_beyond_the_limit_is_refused_with_the_limit(phase_s):
    for options, formations in (({"phase_s": phase_s}, None), ({"phase_s": [0.0, phase_s]}, 2)):
        message = refusal(options, formations)
        assert "phase_s must be a finite number of seconds" in message
        assert "at most ±1e+09 is allowed" in message


@pytest.mark.parametrize("switch", [True, False, np.True_, np.array(True)])
def test_switches_are_no_numbers_at_any_depth(switch):
    refusal({"phase_s": switch})
    refusal({"phase_s": [switch, 1.0]}, 2)
    refusal({"phase_s": [switch, switch]}, 2)
    refusal({"poses": [POSES[0], [0.0, switch, 0.0]]})
    refusal({"poses": [POSES, [POSES[0], (0.0, switch, 0.0)]]}, 2)


def test_arrays_of_switches_are_no_numbers():
    refusal({"phase_s": np.zeros(2, dtype=bool)}, 2)
    refusal({"poses": np.zeros((2, 3), dtype=bool)})
    refusal({"poses": [np.zeros(3), np.zeros(3, dtype=bool)]})


def test_an_unknown_option_is_shown_in_one_short_line():
    assert len(refusal({"x\n" * 999: 1})) < 150
