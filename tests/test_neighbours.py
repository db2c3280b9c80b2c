"""Neighbours: what robots of a row see of their predecessors, and the claims of the page about it."""

from __future__ import annotations

import importlib
import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from page_tables import DOCS

pytest.importorskip("stable_baselines3")
pytest.importorskip("matplotlib")

sys.path.insert(0, str(DOCS / "figures"))
arms = importlib.import_module("neighbours_arms")

# A gap of 5 control steps, episodes of 12.
SHORT = {
    "time_gap_s": 0.1,
    "horizon_s": 0.24,
    "preview_s": [0.02],
    "action": "tracking_twist",
    "disturbance": "slip-noise",
}
GAP, HORIZON, ROBOTS, FORMATIONS = 5, 12, 3, 4


def made(name):
    arm = arms.Arm(name)
    envs = arms.RowVecEnv("infinity", FORMATIONS, arm=arm, robots=ROBOTS, infos=False, **SHORT)
    envs.seed(3)
    return envs, envs.reset()


def plain_rows(envs):
    """The observations without what the arm adds."""
    plants = [plant.observations for plant in envs.plants]
    return np.concatenate([one.reshape(-1, one.shape[2]) for one in plants]).copy()


def actions_of(envs, step):
    generator = np.random.default_rng(step)
    return generator.uniform(-1, 1, size=(envs.num_envs, envs.action_space.shape[0]))


def ahead(rows):
    """From the definition: the row of the predecessor, 0 for the leader."""
    found = np.zeros_like(rows)
    for i in range(len(rows)):
        if i % ROBOTS:
            found[i] = rows[i - 1]
    return found


def test_a_robot_gets_its_predecessors_observation_of_now_and_of_one_gap_ago():
    envs, seen = made("shared")
    size = plain_rows(envs).shape[1]
    assert envs.observation_space.shape == (3 * size,)
    rows = [plain_rows(envs)]
    for step in range(2 * HORIZON + 3):
        at = step % HORIZON  # of an episode; the next one begins with nothing
        past = ahead(rows[step - GAP]) if at >= GAP else np.zeros_like(rows[step])
        wanted = np.concatenate([rows[step], ahead(rows[step]), past], axis=1)
        np.testing.assert_array_equal(seen, wanted)
        seen, _, dones, infos = envs.step(actions_of(envs, step))
        assert dones.all() == (at == HORIZON - 1)
        if dones.any():  # the last observation of an episode still has its past
            last = np.stack([info["terminal_observation"] for info in infos])
            np.testing.assert_array_equal(last[:, size : 2 * size], ahead(last[:, :size]))
            np.testing.assert_array_equal(last[:, 2 * size :], ahead(rows[step + 1 - GAP]))
        rows.append(plain_rows(envs))
    assert np.abs(seen[:, 2 * size :]).max() == 0  # and the two parts were not equal before:
    assert any((one[1:] != two[1:]).any() for one, two in zip(rows[GAP:], rows, strict=False))


def test_a_formation_that_is_begun_anew_has_no_past_and_the_others_keep_theirs():
    envs, _ = made("shared")
    size = plain_rows(envs).shape[1]
    for step in range(GAP + 1):
        envs.step(actions_of(envs, step))
    before = envs.observations()[:, 2 * size :]
    envs.begin_next(0, np.arange(FORMATIONS) == 1)
    after = envs.observations()[:, 2 * size :]
    begun = np.arange(envs.num_envs) // ROBOTS == 1
    assert not after[begun].any()
    np.testing.assert_array_equal(after[~begun], before[~begun])
    assert before[begun][1:].any()


def test_the_own_arm_has_nothing_of_the_predecessor_and_all_the_rest():
    envs, seen = made("own")
    _, rows = made("heard")
    names = arms.entry_names(envs.plants[0].scenario)
    of_predecessor = np.array([name.startswith("predecessor_") for name in names])
    assert of_predecessor.sum() == 6
    assert rows[1][of_predecessor].any()
    assert not seen[:, of_predecessor].any()
    np.testing.assert_array_equal(seen[:, ~of_predecessor], rows[:, ~of_predecessor])


@pytest.mark.parametrize("name", ["own", "heard", "shared"])
def test_a_policy_sees_in_a_run_what_its_environments_showed(name):
    envs, seen = made(name)
    scenario = envs.plants[0].scenario
    shown = []

    def predict(rows, deterministic):
        shown.append(rows.copy())
        return actions_of(envs, len(shown) - 1).astype(np.float32), None

    policy = arms.RowPolicy(SimpleNamespace(predict=predict), envs._arm, scenario)
    state, start = None, np.ones(envs.num_envs, dtype=np.bool_)
    for step in range(HORIZON + 2):
        acted, state = policy.predict(plain_rows(envs), state, start)
        np.testing.assert_array_equal(shown[-1], seen)
        actions = actions_of(envs, step).astype(np.float32)
        np.testing.assert_array_equal(acted, actions)
        seen, _, start, _ = envs.step(actions)


def test_tasks_with_different_gaps_are_refused():
    with pytest.raises(ValueError, match=r"time_gap_s 0\.2, the first task 5;"):
        arms.RowVecEnv(
            {
                "a": ["infinity"],
                "b": {"name": "b", "base": "infinity", "time_gap_s": 0.2},
            },
            2,
            arm=arms.ARMS["shared"],
            **{key: value for key, value in SHORT.items() if key != "time_gap_s"},
        )


@pytest.mark.parametrize(
    "weights",
    [
        arms.OWN_ERROR,
        arms.CORRECTED_ERROR,
        arms.Weights(sent=(0.5, -0.2), relayed=(0.9, 0.3), applied=(1.2, 0.7)),
    ],
)
def test_a_correction_is_what_the_predecessor_sent_one_gap_ago(weights):
    scenario = arms.RowVecEnv("infinity", 1, arm=arms.Arm("own"), robots=ROBOTS, **SHORT).plants[0]
    scenario = scenario.scenario
    names = arms.entry_names(scenario)
    seen = []

    def predict(rows, *_):
        seen.append(rows.copy())
        return np.zeros((len(rows), 2)), None

    policy = arms.CorrectingPolicy(SimpleNamespace(predict=predict), scenario, weights)
    generator = np.random.default_rng(0)
    rows = generator.normal(size=(3 * GAP, 2 * ROBOTS, len(names))).astype(np.float32)
    places = [names.index(name) for name in ("e_1", "e_2")]
    rows[:, :, places] *= 0.005  # a few mm
    state, start = None, np.ones(2 * ROBOTS, dtype=np.bool_)
    for one in rows:
        _, state = policy.predict(one, state, start)
        start[:] = False
    sent_mm = np.zeros((3 * GAP, 2 * ROBOTS, 2))
    for step in range(3 * GAP):
        heard = ahead(sent_mm[step - GAP]) if step >= GAP else np.zeros((2 * ROBOTS, 2))
        heard = np.clip(heard, -arms.MOST_MM, arms.MOST_MM)
        own = rows[step][:, places] * 500
        sent_mm[step] = np.array(weights.sent) * own + np.array(weights.relayed) * heard
        wanted = rows[step].copy()
        for kind, scale in (("", 500), ("_fine", 10)):
            for i in (1, 2):
                added = weights.applied[i - 1] * heard[:, i - 1]
                wanted[:, names.index(f"e_{i}{kind}")] += added / scale
        np.testing.assert_allclose(seen[step], wanted, rtol=1e-4, atol=1e-4)
    assert (np.abs(sent_mm) > 0.1).any()


# --- the section of the page ---------------------------------------------------------------------

script = importlib.import_module("make_neighbours")
PAGE = (DOCS / "learning.md").read_text(encoding="utf-8")
SECTION = PAGE.split("## Neighbours and messages\n")[1].split("\n## ")[0]
TEXT = " ".join(SECTION.split())
ROWS = json.loads(script.RESULTS.read_text(encoding="utf-8"))
NAMES = [cell.name for cell in script.CELLS]
OWN, PATH, OWN_GROWTH, PATH_GROWTH = script.MEASURES


def median(cell, arm, measure):
    return float(np.nanmedian(script.measured(ROWS, cell, arm, measure)))


def apart(cell, arm, other, measure):
    found = (script.measured(ROWS, cell, name, measure) for name in (arm, other))
    return script.difference(*found)


@pytest.mark.parametrize("make", ["kick_table", "probe_table"])
def test_the_short_tables_are_those_of_the_kept_runs(make):
    assert getattr(script, make)(ROWS) in SECTION


@pytest.mark.slow  # a hundred thousand resamples
def test_the_tables_are_those_of_the_kept_runs():
    for name, text in script.tables(ROWS).items():
        assert f"<!-- {name} -->\n{text}\n<!-- end of {name} -->" in SECTION, name


def test_every_arm_has_three_trainings_and_the_same_runs():
    for arm in ("learned", "own", "heard", "shared"):
        for cell in script.CELLS:
            mine = script.of(ROWS, cell.name, arm)
            assert [row["seed"] for row in mine] == [0, 1, 2]
            for row in mine:
                assert np.shape(row["row_mm"]) == (cell.most_runs, cell.robots)
                assert np.shape(row["path_mm"]) == (cell.most_runs, cell.robots)
                assert len(row["failed"]) == cell.most_runs
    assert min(script.PROBE_RUNS) == 0
    assert max(script.PROBE_RUNS) == script.FIRST_TABLE_SEED


def test_growth_is_the_factor_of_a_geometric_row():
    errors = 3.0 * 1.2 ** np.arange(6.0) * np.ones((2, 4, 1))
    errors[:, :, 0] = 100.0  # the leader does not count
    np.testing.assert_allclose(script.growth(errors), 1.2)


def shares(disturbance, sees):
    return script.of(ROWS, f"probe, {disturbance}", sees)[0]["explained"]


def test_the_predecessor_shows_hardly_anything_of_the_next_error():
    for place in (0, 1):
        assert shares("slip", "shared")[place] < shares("slip", "own")[place]
        more = shares("patches", "shared")[place] - shares("patches", "own")[place]
        assert 0 <= more < 0.02


def test_messages_of_two_numbers_pay_in_every_row():
    for cell in NAMES:
        hop, relayed = (apart(cell, arm, "base", PATH) for arm in ("hop", "relayed"))
        assert relayed.high < 0
        assert hop.high < 0
        assert relayed.median < hop.median


def test_what_the_messages_gain_and_cost():
    slip, patches, row = NAMES
    for cell, words in (
        (slip, "{} in place of {} mm from"),
        (patches, "{} in place of {} mm under"),
    ):
        found = [f"{median(cell, arm, PATH):.1f}" for arm in ("relayed", "base")]
        assert words.format(*found) in TEXT
    found = [f"{median(row, arm, PATH):.1f}" for arm in ("relayed", "base")]
    assert "and {} in place of {} mm in the row of ten".format(*found) in TEXT
    gained = sorted(-apart(cell, "hop", "base", PATH).median for cell in NAMES)
    assert f"`hop` gains {gained[0]:.1f} to {gained[-1]:.1f} mm" in TEXT
    for cell, arm in ((slip, "hop"), (row, "hop"), (row, "relayed")):
        assert apart(cell, arm, "base", OWN).low > 0
    lost = {(row["cell"], row["arm"]): sum(row["failed"]) for row in ROWS if "failed" in row}
    assert {key for key, count in lost.items() if count} == {(slip, "hop"), (slip, "relayed")}
    for arm in ("hop", "relayed"):
        only = script.of(ROWS, slip, arm)[0]
        assert sum(only["failed"]) == 1
        assert only["row_mm"][only["failed"].index(1)][-1] == pytest.approx(240, abs=5)


def test_the_learned_message_is_the_relayed_one():
    searches = [row for row in ROWS if row["cell"] == "training" and row["arm"] == "learned"]
    assert [row["seed"] for row in searches] == [0, 1, 2]
    weights = [value for row in searches for value in row["weights"]]
    assert f"at weights of {min(weights):.2f} to {max(weights):.2f}" in TEXT
    for row in searches:
        assert len(row["score_mm"]) == script.TRIALS == 60
        assert row["score_mm"][-1] < 0.6 * row["score_mm"][0]
    for cell in NAMES:
        assert apart(cell, "learned", "base", PATH).high < 0
        found = apart(cell, "learned", "relayed", PATH)
        assert found.low < 0 < found.high
        assert abs(found.median) < (0.1 if cell in NAMES[:2] else 0.3)
    runs = [row for row in ROWS if row["arm"] == "learned" and "failed" in row]
    lost = [one for row in runs for one in row["failed"]]
    assert (len(lost), sum(lost)) == (210, 0)


def test_all_that_the_predecessor_observes_gains_nothing_clear():
    found = [apart(cell, "shared", "heard", OWN) for cell in NAMES]
    assert all(one.low < 0 < one.high for one in found)
    found = [apart(cell, "shared", "heard", PATH) for cell in NAMES]
    assert all(one.low < 0 < one.high for one in found)


def test_one_slip():
    moved = {arm: script.of(ROWS, "kick", arm)[0]["moved_mm"] for arm in script.arms_in(ROWS)}
    for arm in ("base", "own", "heard", "shared"):
        ratio = moved[arm][-1] / moved[arm][2]
        assert 0.8 <= ratio < 0.95
        assert 0.97 <= ratio ** (1 / 7) <= 0.99
    assert moved["hop"][2] / moved["base"][2] == pytest.approx(2 / 3, abs=0.03)
    assert moved["hop"][-1] / moved["hop"][2] > 0.95
    last = (moved["relayed"][-1], moved["base"][-1])
    assert "moves by {:.1f} in place of {:.1f} mm".format(*last) in TEXT


def test_costs():
    minutes = [row["minutes"] for row in ROWS if row["cell"] == "training"]
    assert f"took {min(minutes):.1f} to {max(minutes):.1f} minutes" in TEXT


def test_the_message_of_the_predecessor_gains_nothing_clear():
    slip = NAMES[0]
    for cell in NAMES:
        one = apart(cell, "heard", "own", OWN)
        assert one.low < 0 < one.high
    farther = apart(slip, "heard", "own", PATH)
    assert farther.low > 0
    assert f"by {farther.median:.1f} mm (second table)" in TEXT


def test_growth_along_the_row_does_not_differ_clearly():
    for cell in NAMES:
        for measure in (OWN_GROWTH, PATH_GROWTH):
            ends = []
            for arm in ("own", "heard", "shared"):
                found = script.measured(ROWS, cell, arm, measure)
                ends.append(script.difference(found, np.zeros((1, found.shape[1]))))
                assert measure == PATH_GROWTH or ends[-1].median < 1.055
            assert max(one.low for one in ends) < min(one.high for one in ends)


def test_where_shared_has_the_smaller_medians_and_the_less_precise_leader():
    slip, patches, row = NAMES
    for cell in (slip, patches):
        assert 0.05 < -apart(cell, "shared", "heard", OWN).median < 0.2
    assert apart(row, "shared", "heard", OWN).median > 0
    assert -min(apart(cell, "shared", "heard", OWN).low for cell in NAMES) == pytest.approx(
        0.3, abs=0.05
    )
    for cell in NAMES:
        leaders = [
            np.nanmedian(script.errors_mm(ROWS, cell, arm, "row_mm")[:, :, 0])
            for arm in ("shared", "heard")
        ]
        assert leaders[0] > leaders[1]
