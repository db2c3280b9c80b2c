"""Learned policies from safetensors: the arithmetic, the files, the fit to a scenario, the export."""

import hashlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file, save

from baselines import load_policy
from baselines.cli import main
from baselines.policies import learned
from baselines.policies.card import read_policy, write_policy
from baselines.policies.network import Network
from baselines.policies.registry import fit_policy, make_policy, policy_hash
from baselines.runs.run import run_policy
from tlf_env.onboard.limiters import Limiter, load_limiter
from tlf_env.task.observation import tracking_entries
from tlf_env.task.scenario import load_scenario

SHORT = {"horizon_s": 0.4}
TWIST = load_scenario(**SHORT)
RESIDUAL = load_scenario(action="residual", residual_base="printed", preview_s=(0.5,), **SHORT)
ENTRIES = len(tracking_entries(TWIST.preview_s))
NOTES = {
    "algorithm": "PPO",
    "training": {"gamma": 0.99, "steps": 1000},
    "seeds": {"learner": [0]},
    "versions": {"python": "3"},
    "scores": {"return": 1.5},
    "command": "python train.py",
}
MLP = Network(hidden=(64, 64), activation="tanh", head="gaussian")
NETWORKS = {
    "tanh": MLP,
    "relu": Network(hidden=(32,), activation="relu", head="gaussian"),
    "linear": Network(hidden=(), activation="tanh", head="gaussian"),
    "squashed": Network(hidden=(48, 16), activation="relu", head="squashed_gaussian"),
    "tanh of the mean": Network(hidden=(24,), activation="relu", head="tanh"),
    "normalised": Network(hidden=(64, 64), activation="tanh", head="gaussian", normalised=True),
    "lstm": Network(hidden=(16,), activation="tanh", lstm=24, head="gaussian", normalised=True),
}


def random_tensors(network, entries=ENTRIES, seed=0):
    rng = np.random.default_rng(seed)
    tensors = {}
    for name, shape in network.shapes(entries).items():
        values = rng.normal(size=shape) / np.sqrt(shape[-1] if len(shape) > 1 else 1)
        if name in ("normalise.var", "normalise.epsilon", "normalise.clip"):
            values = 1 + np.abs(values)
        kind = np.float64 if name.startswith("normalise") else np.float32
        tensors[name] = np.asarray(values, dtype=kind)
    return tensors


def written(folder, network=MLP, scenario=TWIST, name="policy", tensors=None):
    path = Path(folder) / f"{name}.safetensors"
    entries = len(tracking_entries(scenario.preview_s))
    tensors = random_tensors(network, entries) if tensors is None else tensors
    write_policy(path, network, tensors, scenario, **NOTES)
    return path


def observations(rows, seed=1):
    return np.random.default_rng(seed).normal(size=(rows, ENTRIES)).astype(np.float32)


def straightforward(network, t, rows, state, start):
    """The same in float64 and in plain NumPy; returns mean, log σ and state."""
    x = np.asarray(rows, dtype=np.float64)
    t = {name: tensor.astype(np.float64) for name, tensor in t.items()}
    if network.normalised:
        spread = np.sqrt(t["normalise.var"] + t["normalise.epsilon"])
        x = np.clip((x - t["normalise.mean"]) / spread, -t["normalise.clip"], t["normalise.clip"])
    if network.lstm:
        h, c = (part * ~start[:, None] for part in state)
        gates = t["lstm.weight_ih"] @ x.T + t["lstm.weight_hh"] @ h.T
        gates += (t["lstm.bias_ih"] + t["lstm.bias_hh"])[:, None]
        entering, kept, cell, out = np.split(gates.T, 4, axis=1)
        c = c / (1 + np.exp(-kept)) + np.tanh(cell) / (1 + np.exp(-entering))
        x = np.tanh(c) / (1 + np.exp(-out))
        state = x, c
    activation = np.tanh if network.activation == "tanh" else lambda x: np.where(x > 0, x, 0)
    for i in range(len(network.hidden)):
        x = activation(x @ t[f"hidden.{i}.weight"].T + t[f"hidden.{i}.bias"])
    mean = x @ t["mean.weight"].T + t["mean.bias"]
    if network.head == "gaussian":
        return mean, np.broadcast_to(t["log_std"], mean.shape), state
    if network.head == "tanh":
        return mean, None, state
    return mean, x @ t["log_std.weight"].T + t["log_std.bias"], state


@pytest.mark.parametrize("kind", NETWORKS)
def test_actions_are_those_of_the_network(kind, tmp_path):
    network = NETWORKS[kind]
    policy = load_policy(written(tmp_path, network))
    tensors, rows = random_tensors(network), 7
    state = None
    expected_state = (np.zeros((rows, network.lstm or 0)),) * 2
    for step in range(5):
        seen = observations(rows, seed=step)
        start = np.arange(rows) == step
        mean, _, expected_state = straightforward(network, tensors, seen, expected_state, start)
        action, state = policy.predict(seen, state, start)
        expected = np.tanh(mean) if network.head != "gaussian" else np.clip(mean, -1, 1)
        assert action.dtype == np.float32
        np.testing.assert_allclose(action, expected, atol=1e-6, rtol=0)
    if network.lstm:
        for part, wanted in zip(state, expected_state, strict=True):
            assert part.shape == (1, rows, network.lstm)
            np.testing.assert_allclose(part[0], wanted, atol=1e-6, rtol=0)
    else:
        assert state is None


@pytest.mark.parametrize("kind", NETWORKS)
def test_a_row_has_the_same_bits_alone_and_in_any_batch(kind, tmp_path):
    policy = load_policy(written(tmp_path, NETWORKS[kind]))
    seen = observations(150)
    whole, state = policy.predict(seen, None)
    again, _ = policy.predict(seen[::-1], None)
    np.testing.assert_array_equal(again[::-1], whole)
    for first, rows in [(0, 1), (3, 3), (17, 5), (100, 50), (149, 1)]:
        part = slice(first, first + rows)
        np.testing.assert_array_equal(policy.predict(seen[part])[0], whole[part])
        if state is not None:
            cut = tuple(kept[:, part] for kept in state)
            np.testing.assert_array_equal(
                policy.predict(seen[part], cut)[0], policy.predict(seen, state)[0][part]
            )
    single, state = policy.predict(seen[8])
    assert single.shape == (2,)
    np.testing.assert_array_equal(single, whole[8])
    if state is not None:
        assert state[0].shape == (1, 1, NETWORKS[kind].lstm)
        assert policy.predict(seen[8], state, np.array([False]))[0].shape == (2,)
        assert policy.predict(seen[8], state, True)[0].tolist() == single.tolist()


def test_the_state_that_is_handed_in_stays_as_it_is(tmp_path):
    policy = load_policy(written(tmp_path, NETWORKS["lstm"]))
    _, state = policy.predict(observations(4))
    before = [part.copy() for part in state]
    policy.predict(observations(4), state, np.ones(4, dtype=bool))
    for part, then in zip(state, before, strict=True):
        np.testing.assert_array_equal(part, then)
    with pytest.raises(ValueError, match=r"the state must be h and c of the shape \(1, 3, 24\)"):
        policy.predict(observations(3), state)


@pytest.mark.parametrize("kind", ["tanh", "squashed"])
def test_draws_follow_the_gaussian_and_repeat(kind, tmp_path):
    network = NETWORKS[kind]
    tensors = random_tensors(network)
    for name in tensors:
        if name.startswith(("log_std", "mean")):
            tensors[name] = np.zeros_like(tensors[name])
    tensors["log_std.bias" if kind == "squashed" else "log_std"] -= np.float32(2)
    path = written(tmp_path, network, tensors=tensors)
    seen = np.repeat(observations(1), 20_000, axis=0)
    first, again, other = (
        load_policy(path, seed=seed).predict(seen, deterministic=False)[0] for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    drawn = np.arctanh(first) if kind == "squashed" else first
    np.testing.assert_allclose(drawn.mean(axis=0), 0, atol=0.005)
    np.testing.assert_allclose(drawn.std(axis=0), np.exp(-2), rtol=0.02)
    assert load_policy(path).predict(seen)[0].max() == 0


@pytest.mark.parametrize("shape", [(ENTRIES + 1,), (3, ENTRIES - 1), (1, 3, ENTRIES), ()])
def test_an_observation_of_another_shape_is_reported(shape, tmp_path):
    with pytest.raises(ValueError, match=f"takes tracking observations of {ENTRIES} entries"):
        load_policy(written(tmp_path)).predict(np.zeros(shape))


def test_the_files_are_complete_and_reproducible(tmp_path):
    first, second = written(tmp_path, name="a"), written(tmp_path, name="b")
    assert first.read_bytes() == second.read_bytes()
    card = read_policy(first).card
    assert card.model_dump() == read_policy(second).card.model_dump()
    assert list(card.entries) == list(tracking_entries(TWIST.preview_s))
    assert card.scenario["trajectory"]["type"] == "lissajous"
    assert card.weights_sha256 == hashlib.sha256(first.read_bytes()).hexdigest()
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "a.json", "a.safetensors", "b.json", "b.safetensors",
    ]  # fmt: skip


def test_arrays_of_any_layout_are_written_as_they_are(tmp_path):
    tensors = random_tensors(MLP)
    crooked = {name: np.asfortranarray(tensor) for name, tensor in tensors.items()}
    path = written(tmp_path, tensors=crooked)
    for name, tensor in load_file(path).items():
        np.testing.assert_array_equal(tensor, tensors[name])


def change_card(path, change):
    place = path.with_suffix(".json")
    card = json.loads(place.read_text())
    place.write_text(json.dumps(change(card)))


def replace_weights(path, tensors):
    """Other weights, and their hash in the card."""
    data = save(tensors)
    path.write_bytes(data)
    change_card(path, lambda card: card | {"weights_sha256": hashlib.sha256(data).hexdigest()})


def refusal(path):
    with pytest.raises(ValueError, match=r"^[^\n]+$") as caught:
        load_policy(path)
    message = str(caught.value)
    assert len(message) < 500
    return message


def test_missing_files_are_reported(tmp_path):
    path = written(tmp_path)
    path.with_suffix(".json").unlink()
    assert "needs its card: cannot read" in refusal(path)
    path.unlink()
    assert refusal(path).startswith(f"cannot read {path}: No such file")


def test_an_unknown_name_is_reported_with_the_known_ones(tmp_path, monkeypatch):
    monkeypatch.setattr(learned, "SHIPPED", tmp_path)
    assert "there is none yet" in refusal("no_such")
    written(tmp_path, name="follower")
    assert "shipped (follower)" in refusal("no_such")
    assert load_policy("follower").card.algorithm == "PPO"
    with pytest.raises(ValueError, match=r"follower, FILE\.safetensors, module:factory, FILE\.zip"):
        make_policy("no_such", TWIST)
    run_policy(TWIST, make_policy("follower", TWIST))


@pytest.mark.parametrize("rest", [0, 5, 100, -1])
def test_truncated_weights_are_reported(rest, tmp_path):
    path = written(tmp_path)
    path.write_bytes(path.read_bytes()[:rest])
    assert "is not a complete safetensors file" in refusal(path)


@pytest.mark.parametrize("data", [b"PK\x03\x04 a zip", b"\x80\x04\x95 a pickle" * 9, b"{}"])
def test_a_file_of_another_format_is_reported(data, tmp_path):
    path = written(tmp_path)
    path.write_bytes(data)
    assert "is not a complete safetensors file" in refusal(path)


def test_other_weights_than_the_cards_are_reported(tmp_path):
    path = written(tmp_path)
    path.write_bytes(written(tmp_path, tensors=random_tensors(MLP, seed=9), name="b").read_bytes())
    assert "is not the file that policy.json describes: its sha256 is" in refusal(path)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"mean.bias": None}, "tensor 'mean.bias' is missing"),
        ({"extra": np.zeros(2, np.float32)}, "the card's network has no tensor 'extra'"),
        ({"mean.bias": np.zeros(3, np.float32)}, "'mean.bias' has the shape (3,)"),
        ({"hidden.1.weight": np.zeros((64, 63), np.float32)}, "has the shape (64, 63)"),
        ({"mean.bias": np.zeros(2)}, "is float64; it must be float32"),
        ({"mean.bias": np.array([0, np.nan], np.float32)}, "not finite"),
        ({"log_std": np.array([0, np.inf], np.float32)}, "not finite"),
    ],
)
def test_tensors_that_do_not_fit_the_network_are_reported(change, said, tmp_path):
    path = written(tmp_path)
    tensors = {k: v for k, v in (random_tensors(MLP) | change).items() if v is not None}
    replace_weights(path, tensors)
    assert said in refusal(path)


@pytest.mark.parametrize("name", ["normalise.var", "normalise.clip"])
def test_an_impossible_normalisation_is_reported(name, tmp_path):
    network = NETWORKS["normalised"]
    path = written(tmp_path, network)
    tensors = random_tensors(network)
    replace_weights(path, tensors | {name: np.asarray(-tensors[name])})
    assert f"tensor {name!r} holds a number below 0" in refusal(path)
    nothing = {
        name: np.zeros_like(tensors[name]) for name in ("normalise.var", "normalise.epsilon")
    }
    replace_weights(path, tensors | nothing)
    assert "must be above 0" in refusal(path)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"surprise": 1}, "surprise: unknown key"),
        ({"format_version": 2}, "format_version"),
        ({"control_period_s": "0.02"}, "control_period_s"),
        ({"control_period_s": -1}, "control_period_s"),
        ({"action": "fly"}, "action"),
        ({"entries": ["e_1"]}, "entries"),
        ({"preview_s": 0.5}, "preview_s"),
        ({"weights_sha256": "abc"}, "weights_sha256"),
        ({"network": {"hidden": [4], "activation": "gelu", "head": "gaussian"}}, "activation"),
        ({"network": {"hidden": [-4], "activation": "tanh", "head": "gaussian"}}, "hidden"),
        ({"action": "residual"}, "residual_base goes with the action 'residual'"),
        ({"residual_base": "consistent"}, "residual_base goes with the action 'residual'"),
        ({"action": "residual", "residual_base": "x", "estimator": None}, "estimator must be"),
    ],
)
def test_an_invalid_card_is_reported(change, said, tmp_path):
    path = written(tmp_path)
    change_card(path, lambda card: card | change)
    assert said in refusal(path)


@pytest.mark.parametrize("key", ["algorithm", "entries", "weights_sha256", "seeds"])
def test_a_card_with_a_missing_field_is_reported(key, tmp_path):
    path = written(tmp_path)
    change_card(path, lambda card: {k: v for k, v in card.items() if k != key})
    assert f"{key}: Field required" in refusal(path)


@pytest.mark.parametrize("text", ["", "{", "[1]", "\x00", '"text"'])
def test_a_card_that_is_not_a_json_object_is_reported(text, tmp_path):
    path = written(tmp_path)
    path.with_suffix(".json").write_text(text)
    assert "policy.json" in refusal(path)


def test_nothing_is_written_of_a_policy_that_is_wrong(tmp_path):
    for tensors in ({}, random_tensors(MLP) | {"log_std": np.full(2, np.nan)}):
        with pytest.raises(ValueError, match="tensor"):
            written(tmp_path / "none", tensors=tensors)
    with pytest.raises(ValueError, match=r"must end in \.safetensors"):
        write_policy(tmp_path / "a.bin", MLP, random_tensors(MLP), TWIST, **NOTES)
    shown = NOTES | {"scores": {"return": float("nan")}}
    with pytest.raises(ValueError, match="JSON"):
        write_policy(tmp_path / "a.safetensors", MLP, random_tensors(MLP), TWIST, **shown)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"action": "residual"}, "with action 'twist', the scenario has 'residual'"),
        ({"observation": "sensor"}, "with observation 'tracking', the scenario has 'sensor'"),
        ({"preview_s": (0.5,)}, "with preview_s (0.5, 1.0), the scenario has (0.5,)"),
        ({"control_period_s": 0.01}, "with control_period_s 0.02, the scenario has 0.01"),
    ],
)
def test_a_policy_that_does_not_fit_is_reported_with_both_values(fields, said, tmp_path):
    path = str(written(tmp_path))
    scenario = load_scenario(**(SHORT | fields))
    for make in (make_policy, fit_policy):
        with pytest.raises(
            ValueError, match=r"^policy '.*policy\.safetensors' does not fit"
        ) as shown:
            make(path, scenario)
        assert said in str(shown.value)


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"residual_base": "consistent"}, "with residual_base 'printed', the scenario has 'consi"),
        ({"estimator": "truth"}, "with estimator 'ekf-gyro', the scenario has 'truth'"),
        ({"action": "twist"}, "with action 'residual', the scenario has 'twist'"),
    ],
)
def test_a_residual_needs_its_base_and_its_estimator(fields, said, tmp_path):
    path = str(written(tmp_path, scenario=RESIDUAL))
    with pytest.raises(ValueError, match="does not fit") as shown:
        fit_policy(path, load_scenario(**(SHORT | fields)))
    assert said in str(shown.value)


def test_another_action_takes_whatever_estimator_is_set(tmp_path):
    path = str(written(tmp_path))
    assert fit_policy(path, load_scenario(estimator="truth", **SHORT)).scenario.privileged


def test_an_entry_of_another_name_or_scale_is_reported(tmp_path):
    path = written(tmp_path)
    change_card(path, lambda card: card | {"entries": card["entries"] | {"e_2": 400.0}})
    with pytest.raises(
        ValueError, match=r"the entry 'e_2' with scale 400, the observation has scale 500"
    ):
        make_policy(str(path), TWIST)
    path = written(tmp_path)
    change_card(path, lambda card: card | {"action_scales": [1000.0, 4.0]})
    with pytest.raises(ValueError, match=r"action_scales \(1000.0, 4.0\), the scenario has"):
        make_policy(str(path), TWIST)


def test_fade_and_reach_of_a_residual_belong_to_the_policy(tmp_path):
    fading = load_scenario(RESIDUAL, residual_fade_mm=4.0, residual_reach_mm=90.0)
    path = str(written(tmp_path, scenario=fading))
    _, scenario, overrides = fit_policy(path, TWIST)
    assert (scenario.residual_fade_mm, scenario.residual_reach_mm) == (4.0, 90.0)
    assert overrides["residual_reach_mm"] == 90.0
    with pytest.raises(ValueError, match=r"residual_fade_mm 4.0, the scenario has 5.0"):
        make_policy(path, load_scenario(fading, residual_fade_mm=5.0))


def test_range_fade_and_limiter_of_an_action_belong_to_the_policy(tmp_path):
    """Also those that an action has where the scenario names none: what is usual may change."""
    narrow = load_scenario(TWIST, action="tracking_twist", action_range=(60.0, 0.5))
    path = str(written(tmp_path, scenario=narrow))
    fitted = fit_policy(path, TWIST)
    assert fitted.scenario.action_entries == narrow.action_entries
    assert fitted.scenario.limiter == narrow.action_limiter == load_limiter("approach")
    assert fitted.scenario.tracking_fade_mm == 10.0 == narrow.action_fade_mm
    with pytest.raises(ValueError, match=r"action_scales \(60.0, 0.5\), the scenario has"):
        make_policy(path, load_scenario(fitted.scenario, action_range=(60.0, 1.0)))
    with pytest.raises(ValueError, match=r"tracking_fade_mm 10.0, the scenario has 4.0"):
        make_policy(path, load_scenario(fitted.scenario, tracking_fade_mm=4.0))
    change_card(
        Path(path), lambda card: {k: v for k, v in card.items() if k != "tracking_fade_mm"}
    )  # a card from before there was this field
    assert fit_policy(path, TWIST).scenario.tracking_fade_mm == 0.0
    path = str(written(tmp_path, scenario=narrow))
    with pytest.raises(ValueError, match="it was trained with limiter"):
        make_policy(path, load_scenario(fitted.scenario, limiter="body"))
    free = str(written(tmp_path, scenario=load_scenario(narrow, limiter="none"), name="free"))
    assert fit_policy(free, TWIST).scenario.action_limiter == Limiter()
    assert "limiter" not in fit_policy(str(written(tmp_path, name="twist")), TWIST).overrides


def test_a_policy_gets_the_fields_that_it_asks_for_if_they_are_not_set(tmp_path):
    path = str(written(tmp_path, scenario=RESIDUAL))
    policy, scenario, overrides = fit_policy(path, TWIST)
    assert overrides == {"action": "residual", "residual_base": "printed"}  # TWIST has its preview
    assert scenario == load_scenario(TWIST, action="residual", residual_base="printed")
    assert policy.scenario_overrides["preview_s"] == (0.5,)
    same = fit_policy(path, RESIDUAL)
    assert (same.scenario, same.overrides) == (RESIDUAL, {})
    assert fit_policy("pure_pursuit", TWIST)[1:] == (TWIST, {})


def test_a_policy_asks_for_the_broadcasts_of_its_training(tmp_path):
    papers = load_scenario(TWIST, estimator="ekf", broadcast_smoothing_s=0.0)
    path = written(tmp_path, scenario=papers)
    asked = {"estimator": "ekf", "broadcast_smoothing_s": 0.0}
    assert fit_policy(str(path), TWIST).overrides == asked
    change_card(path, lambda card: {k: v for k, v in card.items() if k != "broadcast_smoothing_s"})
    assert (
        fit_policy(str(path), TWIST).overrides == asked
    )  # a card from before there was this field
    usual = written(tmp_path, scenario=load_scenario(TWIST, estimator="ekf"))
    assert fit_policy(str(usual), TWIST).overrides == {"estimator": "ekf"}


@pytest.mark.parametrize("name", ["residual", "from-nothing"])
def test_the_shipped_policies_run_on_the_filter_of_their_training(name):
    scenario = fit_policy(name, load_scenario(**SHORT)).scenario
    assert (scenario.estimator, scenario.smoothing_s) == ("ekf-gyro", 0.1)


def test_the_shipped_residual_is_refused_on_another_filter():
    with pytest.raises(ValueError, match="estimator 'ekf-gyro', the scenario has 'ekf'"):
        fit_policy("residual", load_scenario(estimator="ekf", **SHORT))


def test_a_card_names_no_code_that_is_run(tmp_path):
    path = written(tmp_path, scenario=RESIDUAL)
    change_card(path, lambda card: card | {"estimator": "os:system"})
    assert "estimator" not in load_policy(path).scenario_overrides
    with pytest.raises(ValueError, match="estimator 'os:system', the scenario has 'ekf-gyro'"):
        fit_policy(str(path), TWIST)


ASKING = """
import numpy as np

class Asking:
    scenario_overrides = {}

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros((len(observation), 2)), state

class Sensing(Asking):
    scenario_overrides = {"observation": "sensor", "action": "residual", "preview_s": ()}

class Greedy(Asking):
    scenario_overrides = {"disturbance": "none"}

class Odd(Asking):
    scenario_overrides = {"action": "fly"}
"""


@pytest.fixture
def asking(tmp_path, monkeypatch):
    (tmp_path / "asking.py").write_text(ASKING)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield
    sys.modules.pop("asking", None)


@pytest.mark.usefixtures("asking")
def test_a_custom_policy_may_ask_for_fields():
    assert fit_policy("asking:Asking", TWIST, trust=True).scenario is TWIST
    fitted = fit_policy("asking:Sensing", TWIST, trust=True)
    assert (fitted.scenario.observation, fitted.scenario.action) == ("sensor", "residual")
    assert fitted.overrides["preview_s"] == []
    assert (
        fit_policy("asking:Sensing", load_scenario(action="twist"), trust=True).scenario.action
        == "twist"
    )
    with pytest.raises(
        ValueError,
        match="must map fields of action, action_range, tracking_fade_mm, limiter, observation",
    ):
        fit_policy("asking:Greedy", TWIST, trust=True)
    with pytest.raises(
        ValueError, match="policy 'asking:Odd' asks for an invalid scenario: action: "
    ):
        fit_policy("asking:Odd", TWIST, trust=True)


def test_a_policy_with_another_action_gets_the_same_draws(tmp_path):
    scenario = load_scenario(disturbance="start", horizon_s=2.0)
    still = {name: 0 * tensor for name, tensor in random_tensors(MLP).items()}
    needs = load_scenario(scenario, action="residual")
    fitted = fit_policy(str(written(tmp_path, scenario=needs, tensors=still)), scenario)
    mine = run_policy(fitted.scenario, fitted.policy, 20_000)
    reference = run_policy(scenario, make_policy("reference", scenario), 20_000)
    np.testing.assert_array_equal(mine["x_mm"][0], reference["x_mm"][0])
    np.testing.assert_allclose(mine["x_mm"], reference["x_mm"], atol=0.1)


def test_the_hash_covers_weights_and_card(tmp_path):
    path = written(tmp_path)

    def digest():
        return policy_hash(str(path), load_policy(path))

    first = digest()
    change_card(path, lambda card: card | {"command": "another"})
    second = digest()
    replace_weights(path, random_tensors(MLP, seed=5))
    assert len({first, second, digest()}) == 3


def run_tlf(words, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["tlf", *words])
    main()


def test_run_gives_a_policy_the_fields_that_it_asks_for_and_reports_them(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    written(tmp_path, scenario=RESIDUAL)
    words = ["run", "infinity", "--policy", "policy.safetensors", "--horizon-s", "0.4"]
    words += ["--no-figures", "--out", "out"]
    run_tlf([*words, "--json"], monkeypatch)
    shown = capsys.readouterr()
    assert "policy.safetensors asks for action residual, residual_base printed" in shown.err
    assert json.loads(shown.out)["scenario"]["action"] == "residual"
    with pytest.raises(SystemExit) as end:
        run_tlf([*words, "--estimator", "truth"], monkeypatch)
    assert end.value.code == 2
    shown = capsys.readouterr().err
    assert "\n" not in shown.strip()
    assert "with estimator 'ekf-gyro', the scenario has 'truth'" in shown


def test_bench_compares_policies_that_act_otherwise(tmp_path, monkeypatch, capsys):
    pytest.importorskip("arch")
    monkeypatch.chdir(tmp_path)
    written(tmp_path, scenario=RESIDUAL)
    words = ["bench", "--policies", "reference:consistent,policy.safetensors"]
    words += ["--tasks", "infinity", "--disturbances", "nominal", "--seeds", "20000:20001"]
    words += ["--horizon-s", "0.4", "--no-figures", "--processes", "1", "--out", "out"]
    run_tlf(words, monkeypatch)
    capsys.readouterr()
    lines = [json.loads(line) for line in (tmp_path / "out/runs.jsonl").read_text().splitlines()]
    asked = {"action": "residual", "residual_base": "printed"}
    papers = {"estimator": "ekf", "broadcast_smoothing_s": 0.0}
    assert [line["overrides"] for line in lines] == [papers, asked]
    assert lines[0]["scenario_hash"] != lines[1]["scenario_hash"]
    table = (tmp_path / "out/leaderboard.md").read_text()
    assert "policy.safetensors (action residual; residual_base printed)" in table
    change_card(tmp_path / "policy.safetensors", lambda card: card | {"command": "another"})
    with pytest.raises(SystemExit) as end:
        run_tlf(words, monkeypatch)
    assert end.value.code == 2
    assert "a different 'policies' in plan.json" in capsys.readouterr().err


# Against the learning library itself.


@pytest.fixture(scope="module")
def learner():
    pytest.importorskip("stable_baselines3")
    import gymnasium

    return gymnasium.make("tlf_env/Infinity-v0", horizon_s=20.0)


MORE = {"training": {"steps": 0}, "seeds": {"learner": range(1)}, "command": "pytest"}


def model_of(kind, learner, **options):
    import stable_baselines3
    import torch

    torch.manual_seed(0)
    if kind == "RecurrentPPO":
        sb3_contrib = pytest.importorskip("sb3_contrib")
        few = {"n_steps": 8, "batch_size": 8}
        return sb3_contrib.RecurrentPPO("MlpLstmPolicy", learner, device="cpu", **few, **options)
    few = {"n_steps": 8, "batch_size": 8} if kind == "PPO" else {"buffer_size": 8}
    library = stable_baselines3
    if kind not in ("PPO", "SAC"):
        library = pytest.importorskip("sb3_contrib")
    return getattr(library, kind)("MlpPolicy", learner, device="cpu", **few, **options)


@pytest.mark.parametrize("kind", ["PPO", "SAC", "TQC", "CrossQ", "RecurrentPPO"])
def test_an_exported_model_acts_as_before(kind, learner, tmp_path):
    import torch

    from baselines.training.export import export_policy

    net = {"net_arch": [64, 64]} if kind in ("PPO", "RecurrentPPO") else {"net_arch": [256, 256]}
    model = model_of(kind, learner, policy_kwargs=net)
    for parameter in model.policy.parameters():
        parameter.data.mul_(2.0)  # away from the small actions of a new network
    for name, found in model.policy.named_buffers():  # CrossQ's running means and variances
        if name.endswith(("ra_mean", "ra_var")):
            found.copy_(torch.rand(found.shape) + 0.5)
    path = tmp_path / "model.safetensors"
    card = export_policy(model, path, load_scenario(horizon_s=20.0), scores={"return": 3}, **MORE)
    assert card.algorithm == kind
    assert "torch" in card.versions
    policy = load_policy(path)
    near = 1e-5 if kind == "CrossQ" else 2e-6  # its float32 numbers in between are larger
    mine, theirs = None, None
    for step in range(20):
        seen = observations(12, seed=step)
        start = np.arange(12) == step
        wanted, theirs = model.predict(seen, theirs, start, deterministic=True)
        action, mine = policy.predict(seen, mine, start)
        np.testing.assert_allclose(action, wanted, atol=near, rtol=0)
        if kind == "RecurrentPPO":
            for part, kept in zip(mine, theirs, strict=True):
                assert part.shape == kept.shape
                np.testing.assert_allclose(part, kept, atol=2e-6, rtol=0)
    wanted, _ = model.predict(observations(1)[0], deterministic=True)
    np.testing.assert_allclose(policy.predict(observations(1)[0])[0], wanted, atol=near, rtol=0)


def test_the_normalisation_is_exported(learner, tmp_path):
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    from baselines.training.export import export_policy

    envs = VecNormalize(DummyVecEnv([lambda: learner]), clip_obs=3.0)
    model = model_of("PPO", envs)
    model.learn(64)
    path = tmp_path / "model.safetensors"
    assert export_policy(model, path, load_scenario(), **MORE).network.normalised
    seen = observations(9)
    wanted, _ = model.predict(envs.normalize_obs(seen), deterministic=True)
    np.testing.assert_allclose(load_policy(path).predict(seen)[0], wanted, atol=2e-6, rtol=0)


def test_a_model_that_cannot_be_exported_is_reported(learner, tmp_path):
    import torch

    from baselines.training.export import export_policy

    for options, said in [
        ({"use_sde": True}, "gSDE"),
        ({"policy_kwargs": {"activation_fn": torch.nn.ELU}}, "hidden layers must be linear"),
    ]:
        model = model_of("PPO", learner, **options)
        with pytest.raises(ValueError, match=said):
            export_policy(model, tmp_path / "model.safetensors", load_scenario(), **MORE)
    model, other = model_of("PPO", learner), load_scenario(preview_s=(0.5,))
    with pytest.raises(ValueError, match="has the shape"):
        export_policy(model, tmp_path / "model.safetensors", other, **MORE)
    assert not list(tmp_path.iterdir())
