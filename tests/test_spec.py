from pathlib import Path

import pytest

from tlf_env.envs.parallel import FormationParallelEnv
from tlf_env.envs.single import FormationEnv
from tlf_env.envs.spec import page
from tlf_env.task.actions import ACTION_ENTRIES, ACTION_KINDS, ACTION_SIZE
from tlf_env.task.info import INFO_KEYS, INFO_MEANINGS, Info
from tlf_env.task.observation import (
    PREVIEW_ENTRIES,
    SENSOR_TAIL_ENTRIES,
    TRACKING_ENTRIES,
    Preview,
    SensorTail,
    Tracking,
)
from tlf_env.task.reward import REWARD_MEANINGS, RewardTerms

ROOT = Path(__file__).parent.parent


def test_the_committed_page_is_what_the_code_says():
    assert (ROOT / "docs" / "environment.md").read_text(encoding="utf-8") == page()


@pytest.mark.parametrize(
    ("documented", "fields"),
    [
        (TRACKING_ENTRIES, Tracking._fields),
        (PREVIEW_ENTRIES, Preview._fields),
        (SENSOR_TAIL_ENTRIES, SensorTail._fields),
        (REWARD_MEANINGS, RewardTerms._fields),
        (INFO_MEANINGS, Info._fields),
        (ACTION_ENTRIES, tuple(ACTION_KINDS)),
    ],
)
def test_every_field_is_documented_in_its_order(documented, fields):
    assert tuple(documented) == fields


def test_every_kind_of_action_has_two_components():
    assert all(len(entries) == ACTION_SIZE for entries in ACTION_ENTRIES.values())


@pytest.mark.parametrize("cls", [FormationParallelEnv, FormationEnv])
def test_class_docstrings_hold_every_name(cls):
    for name in (
        *Tracking._fields,
        *RewardTerms._fields,
        *INFO_KEYS,
        *ACTION_KINDS,
    ):
        assert f"`{name}`" in cls.__doc__
