"""The worked examples of docs/extending.md, applied to one copy of the sources and run."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "extending.md"
BLOCK = re.compile(
    r"^`([^`]+)`(?:, (after|before|in place of) the line `([^\n]+)`| (\(a new file\))):\n\n"
    r"```\w+\n(.*?)^```$",
    re.M | re.S,
)


class Edit(NamedTuple):
    """One block of the page."""

    section: str
    path: str
    how: str  # after, before, in place of; or empty for a new file
    line: str  # the line that it refers to begins so
    text: str

    def apply(self, root: Path) -> None:
        place = root / self.path
        if not self.how:
            assert not place.exists()
            place.write_text(self.text, encoding="utf-8")
            return
        lines = place.read_text(encoding="utf-8").splitlines(keepends=True)
        found = [i for i, line in enumerate(lines) if line.strip().startswith(self.line)]
        assert len(found) == 1, f"{self.path}: {self.line!r} is there {len(found)} times"
        first = found[0] + (self.how == "after")
        lines[first : first + (self.how == "in place of")] = [self.text]
        place.write_text("".join(lines), encoding="utf-8")


def edits() -> list[Edit]:
    """All blocks in the order of the page."""
    found = []
    for section in re.split(r"^## ", PAGE.read_text(encoding="utf-8"), flags=re.M)[1:]:
        for path, how, line, _, text in BLOCK.findall(section):
            found.append(Edit(section.split("\n")[0], path, how, line, text))
    return found


EDITS = edits()


def of(section: str) -> list[Edit]:
    return [edit for edit in EDITS if edit.section == section]


def test_every_block_of_code_is_an_edit():
    text = PAGE.read_text(encoding="utf-8")
    assert len(EDITS) == text.count("\n```") // 2


def test_a_channel_takes_at_most_three_files_and_twelve_lines():
    channel = of("A disturbance channel")
    assert len({edit.path for edit in channel}) <= 3
    assert sum(len(edit.text.splitlines()) for edit in channel) <= 12


def test_an_observation_entry_takes_at_most_two_files():
    assert len({edit.path for edit in of("An observation entry")}) <= 2


def test_a_quantity_on_board_takes_edits_in_two_files():
    """A row in the layout; its place in a tile and its law."""
    assert [Path(edit.path).name for edit in of("A quantity on board")] == [
        "layout.py",
        "tile_sensing.py",
        "tile_sensing.py",
    ]


# What is the same with and without the edits: draws, infos, rewards, the actions of shipped policies, and
# the hashes of recorded results.
SAME = """
import hashlib
import numpy as np
import tlf_env
from baselines import load_policy
from tlf_env.disturbances.channels import number
from tlf_env.task.neutral import scenario_hash
from tlf_env.task.reward import RewardTerms

plant = tlf_env.BatchPlant("infinity", 1, disturbance="payload")
plant.reset(seed=20000)
print("payload", round(plant.applied[0, 0, number("payload.mass_kg")], 5))
for disturbance in ("nominal", "combined-hard", "payload"):
    print("hash", scenario_hash(tlf_env.load_scenario("infinity", disturbance=disturbance)))
for name in ("residual", "from-nothing"):
    policy = load_policy(name)
    fields = {**policy.scenario_overrides, "end_on": ()}
    plant = tlf_env.BatchPlant("infinity", 4, disturbance="combined-hard", **fields)
    plant.reset(seed=20000)
    digest, state = hashlib.sha256(), None
    for _ in range(100):
        rows = plant.observations.reshape(12, -1)
        actions, state = policy.predict(rows, state)
        plant.step(np.asarray(actions).reshape(4, 3, 2))
        digest.update(np.asarray(actions).tobytes())
        for array in (plant.infos, plant.rewards, plant.state()):
            digest.update(np.ascontiguousarray(array).tobytes())
    print(name, digest.hexdigest())
"""

NEW = """
import numpy as np
import tlf_env
from baselines import ReferencePolicy
from baselines.runs.run import run_policy
from tlf_env.disturbances.channels import number
from tlf_env.disturbances.table import table
from tlf_env.task.observation import tracking_entries
from tlf_env.task.reward import RewardTerms

# the channel acts at once, and has its row on the page
def driven(**channels):
    disturbance = {"encoder": channels} if channels else "nominal"
    plant = tlf_env.BatchPlant("infinity", 2, disturbance=disturbance, end_on=())
    plant.reset(seed=20000)
    policy = ReferencePolicy("consistent")
    for _ in range(200):
        actions, _ = policy.predict(plant.observations.reshape(6, -1))
        plant.step(actions.reshape(2, 3, 2))
    return plant

plain, scaled = driven(), driven(scale_l=1.02)
assert (scaled.applied[:, :, number("encoder.scale_l")] == 1.02).all()
assert np.abs(plain.infos - scaled.infos)[:, :, 0].min() > 1.0, "the scale shows in the position"
assert "`encoder.scale_r` | 1 | 1 | 0.5 to 2 | substep |" in table()

# the observation entry is where the page puts it, and is the filter's
names = list(tracking_entries(plain.scenario.preview_s))
i = names.index("heading_std")
assert names[i - 1] == "innovation_right"
p_tt = plain.named("estimate").p_tt
np.testing.assert_allclose(plain.observations[:, :, i], np.sqrt(p_tt) / 0.1, rtol=1e-6)
assert (p_tt > 0).all()

# the reward term
assert plain.scenario.reward["energy"] == 0.0
energy = plain.infos[:, :, 8]
assert (plain.terms[:, :, RewardTerms._fields.index("energy")] == energy).all() and energy.any()

# the quantity on board: what encoders say that the wheels have rolled, from 0 in every episode
rolled = plain.named("odometer").rolled_mm
assert rolled.shape == (2, 3) and (rolled > 100).all()
plain.reset(mask=np.array([True, False]))
assert (plain.named("odometer").rolled_mm[0] == 0).all()
assert (plain.named("odometer").rolled_mm[1] > 100).all()

# the trajectory, the controller and the estimator
env = tlf_env.parallel_env("ellipse", horizon_s=2.0)
assert env.scenario.trajectory.type == "ellipse"
gentle = ReferencePolicy("gentle")
assert gentle.controller.gains.k_1_per_s == 0.15
assert gentle.controller.gains.k_3_mm2 == ReferencePolicy("consistent").controller.gains.k_3_mm2
scenario = tlf_env.load_scenario(
    "ellipse", horizon_s=2.0, estimator="dead_reckoning:DeadReckoning", disturbance="none"
)
record = run_policy(scenario, gentle, trust=True)
assert np.isfinite(record["x_mm"]).all() and record["x_mm"].any()
print("done")
"""


def run(code: str, root: Path) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=root,
        env=os.environ | {"PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.fixture(scope="module")
def extended(tmp_path_factory) -> Path:
    """A copy of the sources with all edits applied."""
    root = tmp_path_factory.mktemp("extended")
    for folder in ("tlf_env", "baselines", "configs"):
        shutil.copytree(ROOT / folder, root / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for edit in EDITS:
        edit.apply(root)
    return root


def test_nothing_else_moves(extended):
    before = run(SAME, ROOT)
    assert run(SAME, extended) == before
    assert "payload 0.14184" in before


def test_everything_new_works_at_once(extended):
    assert run(NEW, extended).strip() == "done"
