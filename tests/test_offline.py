"""Learning from data sets alone: TD3+BC's losses, its data, and a training that resumes bit for bit."""

from __future__ import annotations

import importlib
import json
import re
import signal
from pathlib import Path

import numpy as np
import pytest
import yaml

from baselines import load_policy
from baselines.data.episodes import RobotEpisode, entry_names
from baselines.data.files import About, fitting_rows, read_rows, write_parquet
from baselines.training.config import OfflineConfig, load_config
from tlf_env.task.scenario import load_scenario

pytest.importorskip("pyarrow")

DOCS = Path(__file__).resolve().parents[1] / "docs"

FIELDS = {"action": "tracking_twist", "horizon_s": 2.0, "time_gap_s": 1.0, "preview_s": [0.5]}
SCENARIO = load_scenario("infinity", plant="batch", **FIELDS)
ENTRIES = entry_names(SCENARIO)
CONFIG = {
    "algorithm": "TD3BC",
    "offline": {"data": "data.parquet"},
    "robot_steps": 2400,
    "scenario": FIELDS,
    "tasks": {"infinity": {}},
    "network": {"hidden": [16]},
    "settings": {"batch_size": 8, "learning_rate": 0.001},
    "final_learning_rate_share": 0.1,
    "checkpoint_every": 800,
    "evaluation": {
        "every": 1200,
        "seeds": [10_000, 10_001],
        "disturbances": ["nominal"],
        "horizon_s": 1.0,
    },
}


def episode(
    steps: int, *, terminated: bool = False, robot: int = 0, seed: int = 3, **others: object
) -> RobotEpisode:
    """Observation k of an episode has the value k/100 everywhere, and a sine of k/10 follows as action."""
    number = np.arange(steps + 1, dtype=np.float32)
    actions = 0.5 * np.sin(number[:-1, np.newaxis] / 10 + np.arange(2, dtype=np.float32))
    return RobotEpisode(
        task="infinity",
        disturbance="nominal",
        seed=seed,
        robot=robot,
        observations=np.repeat(number[:, np.newaxis] / 100, len(ENTRIES), axis=1),
        actions=actions.astype(np.float32),
        rewards=number[:-1].astype(np.float64),
        terminated=terminated,
        truncated=not terminated,
    )._replace(**others)


def data_file(path: Path, *episodes: RobotEpisode, **others: object) -> Path:
    about = About(
        policy="from-nothing",
        action="tracking_twist",
        observation="tracking",
        entries=ENTRIES,
        control_period_s=0.02,
        scenario=str(SCENARIO),
        versions={"python": "3"},
    )
    write_parquet(episodes or [episode(60), episode(40)], about._replace(**others), path)
    return path


def without(path: Path, rows: list[int] | None = None, **changes: object) -> Path:
    """The file without some rows, or with other columns; None takes a column away."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.read_table(path)
    about = table.schema.metadata
    table = table.filter(pa.array([k not in (rows or []) for k in range(len(table))]))
    for name, value in changes.items():
        table = table.drop_columns([name])
        if value is not None:
            table = table.append_column(name, pa.array([value] * len(table)))
    pq.write_table(table.replace_schema_metadata(about), path)
    return path


class TestData:
    """What is read from a file."""

    def test_a_step_has_the_observation_after_it_and_says_how_it_ended(self, tmp_path):
        path = data_file(tmp_path / "data.parquet", episode(3, terminated=True), episode(2))
        rows = fitting_rows(path, SCENARIO)
        np.testing.assert_allclose(rows.observations[:, 0], [0, 0.01, 0.02, 0, 0.01])
        np.testing.assert_allclose(rows.next_observations[:, 0], [0.01, 0.02, 0.03, 0.01, 0.02])
        assert rows.last.tolist() == [False, False, True, False, True]
        assert rows.terminated.tolist() == [False, False, True, False, False]
        assert rows.rewards.tolist() == [0, 1, 2, 0, 1]
        assert (rows.tasks, rows.disturbances, rows.seeds) == (("infinity",), ("nominal",), (3,))

    @pytest.mark.parametrize(
        ("changed", "said"),
        [
            (lambda path: data_file(path, action="twist"), "'twist' actions; the scenario has"),
            (
                lambda path: without(data_file(path), observation_e_1=None),
                "has no column observation_e_1",
            ),
            (lambda path: data_file(path, entries=ENTRIES[1:]), "observations and"),
            (
                lambda path: data_file(path, scenario=f"{SCENARIO}tracking_fade_mm: 3.0\n"),
                "has actions with tracking_fade_mm 3.0; the scenario has 10.0",
            ),
            (
                lambda path: data_file(path, scenario=f"{SCENARIO}action_range: [90.0, 1.0]\n"),
                "has actions with action_scales (90.0, 1.0); the scenario has (100.0, 1.0)",
            ),
            (lambda path: data_file(path, scenario="[1"), "is no data set of `tlf export`"),
            (lambda path: without(data_file(path), reward=None), "has no column reward"),
            (lambda path: without(data_file(path), robot=None), "has no column robot"),
            (lambda path: without(data_file(path), list(range(102))), "has no step"),
            (
                lambda path: without(data_file(path), [60]),
                "episode 0, robot 0, step 59 has no row with its last observation behind it",
            ),
            (
                lambda path: without(data_file(path), [101]),
                "episode 1, robot 0, step 39 has no row with its last observation behind it",
            ),
            (
                lambda path: without(data_file(path), [7]),
                "episode 0, robot 0, step 6 has no row with its next step behind it",
            ),
            (
                lambda path: without(data_file(path), reward=float("nan")),
                "holds rewards that are not finite",
            ),
            (lambda path: without(data_file(path), action_1=2.0), "holds an action of 2"),
        ],
    )
    def test_a_file_that_does_not_fit_is_refused_in_one_line(self, changed, said, tmp_path):
        with pytest.raises(ValueError, match=re.escape(said)) as error:
            fitting_rows(changed(tmp_path / "data.parquet"), SCENARIO)
        assert "data.parquet" in str(error.value)
        assert "\n" not in str(error.value)

    def test_a_file_says_which_noise_was_added(self, tmp_path):
        assert read_rows(data_file(tmp_path / "a.parquet", noise=0.3)).about.noise == 0.3
        rows = read_rows(data_file(tmp_path / "b.parquet"))
        assert rows.origin()["noise"] == 0.0
        assert json.loads(json.dumps(rows.origin()))["seeds"] == [3, 4]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"offline": None}, "TD3BC, and no other algorithm, needs offline; got none with TD3BC"),
        ({"algorithm": "SAC"}, "needs offline; got one with SAC"),
        ({"offline": {"data": []}}, "offline.data"),
        ({"offline": {"data": "x", "alpha": -1}}, "offline.alpha: Input should be greater than"),
        (
            {"network": {"history": {"observations": 2}}},
            "offline needs a network without history",
        ),
        ({"imitation": {}}, "imitation needs algorithm PPO, got TD3BC"),
    ],
)
def test_a_wrong_config_is_reported_in_one_line(changes: dict, said: str):
    with pytest.raises(ValueError, match=re.escape(said)) as error:
        load_config({**CONFIG, **changes})
    assert "\n" not in str(error.value)


def test_data_may_lie_beside_the_training(tmp_path):
    data_file(tmp_path / "data.parquet")
    path = tmp_path / "own.yaml"
    path.write_text(json.dumps({**CONFIG, "offline": {"data": ["data.parquet", "far.parquet"]}}))
    offline = load_config(path).offline
    assert offline is not None
    assert offline.files == (str(tmp_path / "data.parquet"), "far.parquet")


class TestLearning:
    """What needs stable-baselines3 and torch."""

    @pytest.fixture(autouse=True)
    def _packages(self):
        pytest.importorskip("stable_baselines3")

    def made(self, folder: Path, *episodes: RobotEpisode, **changes: object):
        from baselines.training.model import make_envs, make_model

        path = data_file(folder / "data.parquet", *episodes)
        given = {**CONFIG, **changes}
        config = load_config({**given, "offline": {**given["offline"], "data": str(path)}})
        return make_model(config, make_envs(config, 1), 0)

    def test_the_value_counts_as_the_paper_says(self, tmp_path):
        """λ = α / mean |Q|, which has no gradient of its own."""
        import torch

        model = self.made(tmp_path, offline={"alpha": 2.5})
        seen = torch.randn(4, len(ENTRIES))
        meant = torch.rand(4, 2) - 0.5
        with torch.no_grad():
            for one in model.critic.parameters():
                one.mul_(3.0)
            actions = model.actor(seen)
            values = model.critic.q1_forward(seen, actions)
        share = 2.5 / values.abs().mean()
        wanted = torch.square(actions - meant).mean() - share * values.mean()
        loss = model.actor_loss(seen, meant)
        torch.testing.assert_close(loss.detach(), wanted)
        model.actor.zero_grad()
        loss.backward()
        found = [one.grad.clone() for one in model.actor.parameters()]
        model.actor.zero_grad()
        distance = torch.square(model.actor(seen) - meant).mean()
        (distance - share * model.critic.q1_forward(seen, model.actor(seen)).mean()).backward()
        for mine, theirs in zip(found, model.actor.parameters(), strict=True):
            torch.testing.assert_close(mine, theirs.grad)

    def test_without_the_value_it_imitates(self, tmp_path):
        """With α = 0 the critic has no influence, and the actions come near the data's."""
        import torch

        model = self.made(
            tmp_path,
            offline={"alpha": 0.0},
            network={"hidden": [64]},
            settings={"batch_size": 16, "learning_rate": 0.005},
        )
        seen, meant = torch.randn(8, len(ENTRIES)), torch.rand(8, 2)
        loss = model.actor_loss(seen, meant)
        with torch.no_grad():
            for one in model.critic.parameters():
                one.mul_(5.0)
        assert model.actor_loss(seen, meant) == loss
        rows = read_rows(tmp_path / "data.parquet")
        given = model.get_vec_normalize_env().normalize_obs(rows.observations)

        def error() -> float:
            actions, _ = model.predict(given, deterministic=True)
            return float(np.square(actions - rows.actions).mean())

        before = error()
        torch.set_num_threads(1)
        model.learn(300 * 16)
        assert error() < 0.3 * before
        assert (model._n_updates, model.num_timesteps) == (300, 300 * 16)

    def test_a_larger_alpha_leads_to_actions_of_larger_value(self, tmp_path):
        """One action in all of the data, rewards for another: α decides how far the actions move."""
        import torch

        rng = np.random.default_rng(0)
        actions = rng.uniform(-0.5, 0.5, (400, 2)).astype(np.float32)
        one = episode(400, actions=actions, rewards=actions[:, 0].astype(np.float64))
        means = []
        torch.set_num_threads(1)
        for alpha in (0.0, 2.5):
            model = self.made(
                tmp_path,
                one,
                offline={"alpha": alpha},
                settings={"batch_size": 64, "gamma": 0.0, "learning_rate": 0.01},
            )
            model.learn(300 * 64)
            seen = model.get_vec_normalize_env().normalize_obs(one.observations)
            means.append(model.predict(seen, deterministic=True)[0][:, 0].mean())
        assert abs(means[0]) < 0.15
        assert means[1] > means[0] + 0.2

    def test_values_go_on_where_an_episode_is_truncated(self, tmp_path):
        import torch

        model = self.made(tmp_path, episode(3, terminated=True), episode(2))
        buffer = model.replay_buffer
        rows = buffer._get_samples(np.arange(5))
        assert rows.dones.flatten().tolist() == [0, 0, 1, 0, 0]
        assert rows.rewards.flatten().tolist() == [0, 1, 2, 0, 1]
        with torch.no_grad():
            for one in model.critic_target.parameters():
                one.zero_()
            for network in model.critic_target.q_networks:
                network[-1].bias.fill_(10.0)
        gamma = model.gamma
        wanted = [10 * gamma, 1 + 10 * gamma, 2.0, 10 * gamma, 1 + 10 * gamma]
        np.testing.assert_allclose(model.targets(rows).flatten(), wanted, rtol=1e-6)

    def test_an_interrupted_training_continues_to_the_same_policy(self, tmp_path):
        """Bit for bit; its file acts as the model, and its card says which data it had."""
        from safetensors.numpy import load_file

        from baselines.training.train import CHECKPOINT_FILE, POLICY_FILE, train

        path = data_file(tmp_path / "data.parquet")
        config = load_config({**CONFIG, "offline": {"data": str(path)}})
        whole = train(config, 3, tmp_path / "whole")
        stops = []

        def interrupt(done: int, total: int) -> None:
            stops.append(done)
            if len(stops) in (1, 2):
                signal.raise_signal(signal.SIGINT)

        parts = tmp_path / "parts"
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                train(config, 3, parts, progress=interrupt)
        again = train(config, 3, parts)
        for curve in (whole, again):
            for name in ("wall_time_s", "processor_time_s", "evaluated_at_s"):
                del curve[name]
        assert whole == again
        assert [one["robot_steps"] for one in whole["evaluations"]] == [0, 1600, 2400]
        assert (parts / POLICY_FILE).read_bytes() == (tmp_path / "whole" / POLICY_FILE).read_bytes()
        mine, theirs = (load_file(tmp_path / one / CHECKPOINT_FILE) for one in ("parts", "whole"))
        assert mine.keys() == theirs.keys()
        for name, tensor in theirs.items():
            assert mine[name].tobytes() == tensor.tobytes(), name
        assert not any(name.startswith("memory") for name in theirs)  # the data stay in their file
        card = load_policy(parts / POLICY_FILE).card
        (data,) = card.training["data"]
        assert data["sha256"] == read_rows(path).sha256
        assert (data["policy"], data["seeds"]) == ("from-nothing", [3, 4])
        assert card.seeds["episodes"] == (3, 4)
        assert card.algorithm == "TD3BC"

        data_file(path, episode(50))
        with pytest.raises(ValueError, match="holds a training with a different 'data'"):
            train(config, 3, parts)

    @pytest.mark.parametrize("normalise", [True, False])
    def test_the_exported_policy_acts_as_the_model(self, normalise, tmp_path):
        from baselines.training.export import export_policy
        from baselines.training.history import ModelPolicy

        model = self.made(tmp_path, offline={"normalise": normalise})
        model.learn(100 * 16)
        path = tmp_path / "policy.safetensors"
        export_policy(model, path, SCENARIO, training={}, seeds={"learner": [0]})
        policy = load_policy(path)
        assert policy.card.network.head == "tanh"
        assert policy.card.network.normalised == normalise
        seen = np.random.default_rng(0).normal(size=(9, len(ENTRIES))).astype(np.float32)
        wanted, _ = ModelPolicy(model).predict(seen, deterministic=True)
        np.testing.assert_allclose(policy.predict(seen)[0], wanted, atol=1e-5)
        drawn, _ = policy.predict(seen, deterministic=False)
        np.testing.assert_array_equal(drawn, policy.predict(seen)[0])  # it has nothing to draw

    @pytest.mark.parametrize(
        ("one", "said"),
        [
            (episode(5, seed=20_000), "seeds 20000 to 20000 must lie within 0 to 9999"),
            (episode(5, disturbance="swell"), "'swell' is for tests only"),
            (episode(5, disturbance="pushes"), "'pushes' chooses between trained policies"),
            (episode(5, task="stop_and_go"), "'stop_and_go' is for tests only"),
        ],
    )
    def test_data_that_may_not_train_are_refused(self, one, said, tmp_path):
        with pytest.raises(ValueError, match=re.escape(said)) as error:
            self.made(tmp_path, one)
        assert "data.parquet" in str(error.value)

    def test_settings_of_other_algorithms_are_refused(self, tmp_path):
        with pytest.raises(ValueError, match=r"settings\.buffer_size is not one of batch_size"):
            self.made(tmp_path, settings={"buffer_size": 10})


class TestPage:
    """What the documents say is what was measured."""

    @pytest.fixture
    def made(self, monkeypatch):
        pytest.importorskip("stable_baselines3")
        pytest.importorskip("matplotlib")
        monkeypatch.syspath_prepend(str(DOCS / "figures"))
        return importlib.import_module("make_offline")

    def test_it_has_the_tables_of_the_measured_runs(self, made):
        page = (DOCS / "learning.md").read_text("utf-8")
        kept = json.loads(made.RESULTS.read_text("utf-8"))
        for name, table in (
            ("offline trainings", made.trained_table(kept["trainings"])),
            ("offline", made.judged_table(kept["judged"])),
        ):
            assert f"<!-- {name} -->\n{table}\n<!-- end of {name} -->" in page

    def test_it_says_what_the_runs_show(self, made):
        rows = json.loads(made.RESULTS.read_text("utf-8"))["judged"]
        arms = (made.GOOD, made.MEDIOCRE, "imitation", "offline")
        for cell in {row["cell"] for row in rows}:
            held = {arm: made.held_mm(rows, cell, arm) for arm in arms}
            each = {arm: np.nanmedian(one, axis=1) for arm, one in held.items()}
            assert [len(each[arm]) for arm in arms] == [1, 1, 3, 3]
            assert {one.shape[1] for one in held.values()} == {100}
            middle = {arm: np.nanmedian(one) for arm, one in held.items()}
            found = made.difference(held["offline"], held["imitation"])
            assert found.low < 0.0 < found.high
            assert 2.0 * middle[made.GOOD] < middle["offline"]
            on_infinity = cell.startswith("infinity")
            assert (middle["offline"] < middle[made.MEDIOCRE]) == on_infinity
            assert (middle["imitation"] < middle[made.MEDIOCRE]) == on_infinity
            assert (middle["offline"] > middle["imitation"]) == (not on_infinity)
            if on_infinity:
                smaller = each["offline"] < each["imitation"]
                assert smaller.all() or cell.endswith("ice")
                assert found.median > -0.45

    def test_the_training_of_the_page_on_trainings_can_be_read(self):
        page = (DOCS / "training.md").read_text("utf-8")
        text = page.partition("## From data alone")[2].partition("```yaml\n")[2]
        config = load_config(yaml.safe_load(text.partition("```")[0]))
        assert config.offline is not None
        assert config.offline.alpha == OfflineConfig(data="x").alpha
