"""Policies take their entries by name, so they outlive an observation with more entries or another order."""

import json
from pathlib import Path

import numpy as np
import pytest

from baselines import ReferencePolicy, load_policy
from baselines.policies.card import write_policy
from baselines.policies.columns import find_columns, find_scaled_columns
from baselines.policies.laws.textbook import FeedbackLinearisation, PurePursuit
from baselines.policies.learned import shipped_policies
from baselines.policies.network import Network
from baselines.policies.registry import fit_policy, make_policy
from baselines.runs.run import run_policy
from tlf_env.task import observation
from tlf_env.task.observation import Entry, sensor_entries, tracking_entries
from tlf_env.task.scenario import DEFAULT_PREVIEW_S, load_scenario

ROWS = 40
CARD = {
    "algorithm": "PPO",
    "training": {},
    "seeds": {},
    "versions": {},
    "scores": {},
    "command": "pytest",
}


def written(folder: Path, scenario, entries: int) -> str:
    """A small policy with random weights, trained on the scenario."""
    network = Network(hidden=(8,), activation="tanh", head="gaussian")
    rng = np.random.default_rng(0)
    tensors = {
        name: rng.normal(size=shape).astype(np.float32)
        for name, shape in network.shapes(entries).items()
    }
    path = folder / "small.safetensors"
    write_policy(path, network, tensors, scenario, **CARD)
    return str(path)


def observations(seed: int = 0) -> dict[str, np.ndarray]:
    """Rows of today's observation, by entry."""
    rng = np.random.default_rng(seed)
    return {
        name: rng.normal(size=ROWS).astype(np.float32) for name in tracking_entries((0.2, 0.5, 1.0))
    }


def rows_of(seen: dict[str, np.ndarray], preview_s=DEFAULT_PREVIEW_S) -> np.ndarray:
    """The rows in the order of the observation; an unknown entry gets noise."""
    noise = np.random.default_rng(9)
    return np.stack(
        [
            seen[name] if name in seen else noise.normal(size=ROWS).astype(np.float32)
            for name in tracking_entries(preview_s)
        ],
        axis=-1,
    )


def shuffled(entries: dict[str, Entry]) -> dict[str, Entry]:
    """The entries in another order, with two more in the middle."""
    names = list(np.random.default_rng(1).permutation(list(entries)))
    middle = len(names) // 2
    more = {name: Entry("new", "1", 3.0) for name in ("new_a", "new_b")}
    return (
        {name: entries[name] for name in names[:middle]}
        | more
        | {name: entries[name] for name in names[middle:]}
    )


@pytest.fixture
def later_observation(monkeypatch):
    """An observation with two more entries in the middle, and all of them shuffled."""

    def extend() -> None:
        monkeypatch.setattr(observation, "TRACKING_ENTRIES", shuffled(observation.TRACKING_ENTRIES))

    return extend


def policies():
    made = {name: (lambda name=name: load_policy(name)) for name in shipped_policies()}
    made |= {f"reference:{g}": (lambda g=g: ReferencePolicy(g)) for g in ("printed", "tuned")}
    return made | {cls.__name__: cls for cls in (PurePursuit, FeedbackLinearisation)}


@pytest.mark.parametrize("name", policies())
def test_a_policy_acts_alike_with_more_entries_in_another_order(name, later_observation):
    make, seen = policies()[name], observations()
    learned = name in shipped_policies()
    before = make()
    wanted, _ = before.predict(rows_of(seen))
    drawn, _ = before.predict(rows_of(seen), deterministic=False)
    later_observation()
    policy = make()
    now = rows_of(seen)
    assert now.shape[1] == len(tracking_entries(DEFAULT_PREVIEW_S))
    np.testing.assert_array_equal(policy.predict(now)[0], wanted)
    if learned:
        np.testing.assert_array_equal(policy.predict(now, deterministic=False)[0], drawn)
    for i in (0, ROWS - 1):
        np.testing.assert_array_equal(policy.predict(now[i])[0], wanted[i])


@pytest.mark.parametrize("name", shipped_policies())
@pytest.mark.parametrize("preview_s", [(0.2, 0.5, 1.0), (1.0, 0.5), (0.5, 0.2, 1.0)])
def test_a_shipped_policy_takes_its_previews_from_more_in_any_order(name, preview_s):
    seen = observations()
    wanted, _ = load_policy(name).predict(rows_of(seen))
    scenario = load_scenario(preview_s=preview_s)
    policy, fitted, overrides = fit_policy(name, scenario)
    assert "preview_s" not in overrides
    assert fitted.preview_s == preview_s
    np.testing.assert_array_equal(policy.predict(rows_of(seen, preview_s))[0], wanted)
    with pytest.raises(ValueError, match=f"observations of {len(tracking_entries(preview_s))} ent"):
        policy.predict(np.zeros((ROWS, 7)))


def test_a_run_with_a_further_preview_is_the_same_run():
    records = [
        run_policy(fitted.scenario, fitted.policy, 10_000)
        for preview_s in (DEFAULT_PREVIEW_S, (0.5, 0.7, 1.0))
        for fitted in [fit_policy("residual", load_scenario(horizon_s=2.0, preview_s=preview_s))]
    ]
    for name, column in records[0].columns.items():
        np.testing.assert_array_equal(records[1][name], column)


def test_a_policy_asks_for_its_previews_only_if_the_scenario_lacks_one(tmp_path):
    trained = load_scenario(preview_s=(0.3, 0.5))
    path = written(tmp_path, trained, len(tracking_entries((0.3, 0.5))))
    policy, scenario, overrides = fit_policy(path, load_scenario())
    assert overrides == {"preview_s": [0.3, 0.5]}
    assert scenario.preview_s == (0.3, 0.5)
    assert policy.predict(np.zeros((2, len(tracking_entries((0.3, 0.5))))))[0].shape == (2, 2)
    with pytest.raises(
        ValueError, match=r"trained with preview_s \(0.3, 0.5\), the scenario has \(0.5, 1.0\)"
    ):
        fit_policy(path, load_scenario(preview_s=(0.5, 1.0)))


def test_an_entry_that_is_gone_or_has_another_scale_is_named(monkeypatch):
    scenario = fit_policy("from-nothing", load_scenario()).scenario
    entries = dict(observation.TRACKING_ENTRIES)
    rows = np.zeros((1, len(tracking_entries(DEFAULT_PREVIEW_S))))
    coarse = entries["slip_2"]._replace(scale=2.0)
    for changed, said in (
        (
            {name: entry for name, entry in entries.items() if name != "e_2"},
            "lacks the entry 'e_2'",
        ),
        (
            entries | {"slip_2": coarse},
            "the entry 'slip_2' with scale 1, the observation has scale 2",
        ),
    ):
        monkeypatch.setattr(observation, "TRACKING_ENTRIES", changed)
        refused = f"policy 'from-nothing' does not fit the scenario.*{said}"
        with pytest.raises(ValueError, match=refused):
            make_policy("from-nothing", scenario)
        with pytest.raises(ValueError, match=said):
            load_policy("from-nothing").predict(rows)


def test_a_new_card_names_the_entries_in_the_scenarios_order(tmp_path, later_observation):
    later_observation()
    scenario = load_scenario(preview_s=(1.0, 0.5))
    names = list(tracking_entries((1.0, 0.5)))
    path = written(tmp_path, scenario, len(names))
    card = json.loads(Path(path).with_suffix(".json").read_text())
    assert list(card["entries"]) == names
    policy = load_policy(path)
    policy.predict(np.zeros((1, len(names))))
    assert policy._columns.leading


def test_samples_of_another_number_are_refused(tmp_path):
    """Their names carry numbers, oldest first, so the same name would be another time."""
    fields = {"observation": "sensor", "preview_s": ()}
    path = written(tmp_path, load_scenario(**fields), len(sensor_entries(20)))
    assert make_policy(path, load_scenario(**fields)).predict(np.zeros((1, 92)))[0].shape == (1, 2)
    with pytest.raises(ValueError, match="trained with 20 samples in an observation, the scenario"):
        make_policy(path, load_scenario(physics_period_s=0.0005, **fields))


def test_columns_are_found_by_name():
    found = find_columns(["b", "a"], ["x", "a", "b"])
    assert (found.places.tolist(), found.width, found.leading) == ([2, 1], 3, False)
    assert found.take(np.array([[7, 8, 9]])).tolist() == [[9, 8]]
    leading = find_scaled_columns({"x": 1.0}, {"x": 1.0, "a": 2.0})
    assert leading.leading
    assert leading.take(np.array([[7, 8]])).tolist() == [[7]]
