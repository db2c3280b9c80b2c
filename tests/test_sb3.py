"""stable-baselines3 on the batch plant. Skipped where it is not installed (``make test-learning`` has it)."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import gymnasium
import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnvWrapper, VecMonitor, VecNormalize

import tlf_env
from baselines.sb3 import CHEAP_INFOS, FormationVecEnv
from tlf_env import EndReason
from tlf_env.task.info import INFO_KEYS

ROOT = Path(__file__).parent.parent
SHORT = {"horizon_s": 2.0, "time_gap_s": 1.0, "preview_s": (0.5,), "action": "twist"}
ROUGH = {**SHORT, "disturbance": "combined-hard", "lost_beyond_mm": 150.0}
SMALL = {"n_steps": 32, "batch_size": 96, "n_epochs": 2, "device": "cpu"}


def environment(formations: int = 4, **changes) -> FormationVecEnv:
    return FormationVecEnv("infinity", formations, **{**ROUGH, **changes})


def actions(rows: int, steps: int) -> np.ndarray:
    return np.random.default_rng(3).uniform(-0.5, 0.5, (steps, rows, 2)).astype(np.float32)


def test_every_robot_is_that_of_the_parallel_environment():
    """Observations, rewards, ends and what ended them, over several episodes of each formation."""
    env = environment(3)
    env.seed(11)
    seen = env.reset()
    alone = [tlf_env.parallel_env("infinity", plant="batch", **ROUGH) for _ in range(3)]
    theirs = [one.reset(seed=11 + k)[0] for k, one in enumerate(alone)]
    ended = 0
    for action in actions(9, 300):
        assert np.array_equal(seen, np.concatenate([list(obs.values()) for obs in theirs]))
        seen, rewards, dones, infos = env.step(action)
        for k, one in enumerate(alone):
            agents = list(one.agents)
            given = dict(zip(agents, action[3 * k : 3 * k + 3], strict=True))
            theirs[k], reward, terminated, truncated, info = one.step(given)
            for i, agent in enumerate(agents):
                row = 3 * k + i
                assert rewards[row] == np.float32(reward[agent])
                assert dones[row] == (terminated[agent] or truncated[agent])
                if dones[row]:
                    assert infos[row]["TimeLimit.truncated"] == truncated[agent]
                    assert np.array_equal(infos[row]["terminal_observation"], theirs[k][agent])
                assert {key: infos[row][key] for key in CHEAP_INFOS} == {
                    key: info[agent][key] for key in CHEAP_INFOS
                }
            if not one.agents:
                ended += 1
                theirs[k] = one.reset()[0]
    assert ended > 9


def test_tasks_of_different_size_share_one_environment():
    tasks = {
        "infinity": ["infinity", {**tlf_env.load_scenario("infinity").model_dump(), "name": "x"}],
        "flower": "flower",
    }
    env = FormationVecEnv(tasks, 5, mixture=False, horizon_s=2.0)
    assert env.num_envs == 3 * 3 + 2 * 5
    assert env.place(0) == (0, 0, 0)
    assert env.place(8) == (0, 2, 2)
    assert env.place(9) == (1, 0, 0)
    assert env.place(18) == (1, 1, 4)
    assert env.seed(5) == [5] * 3 + [6] * 3 + [7] * 3 + [8] * 5 + [9] * 5
    seen = env.reset()
    alone = tlf_env.parallel_env("flower", plant="batch", horizon_s=2.0)
    assert np.array_equal(seen[9:14], np.stack(list(alone.reset(seed=8)[0].values())))
    assert env.get_attr("scenario", [9])[0].name == "flower"


@pytest.mark.parametrize("of", [{"base": "infinity"}, {"trajectory": "infinity", "robots": 3}])
def test_a_scenario_that_is_a_mapping_is_one_task(of):
    env = FormationVecEnv({**of, "horizon_s": 2.0, "end_on": ()}, 1)
    assert env.num_envs == 3
    assert env.get_attr("scenario", [0])[0].horizon_s == 2.0


def test_the_interface_of_vec_env():
    env = environment(2)
    env.seed(0)
    env.reset()
    assert env.get_attr("render_mode") == [None] * 6
    assert [place.robot for place in env.get_attr("place")] == [0, 1, 2, 0, 1, 2]
    env.set_attr("colour", "red", [1, 2])
    assert env.get_attr("colour", [1, 2]) == ["red", "red"]
    with pytest.raises(AttributeError, match="no attribute 'colour'"):
        env.get_attr("colour", 0)
    assert len(env.env_method("state")) == 6
    assert env.env_method("state", indices=4)[0].shape == (12,)
    assert env.env_is_wrapped(VecMonitor) == [False] * 6
    with pytest.raises(ValueError, match=r"\(6, 2\) finite numbers"):
        env.step(np.full((6, 2), np.nan))
    with pytest.raises(ValueError, match=r"\(6, 2\) finite numbers"):
        env.step(np.zeros((5, 2)))
    with pytest.raises(ValueError, match=r"\(6, 2\) finite numbers"):
        env.step(np.full((6, 2), "0.5"))


@pytest.mark.parametrize("infos", [True, False, ("end", "reward_fine"), CHEAP_INFOS])
def test_infos_have_the_same_keys_in_every_step(infos):
    env = environment(2, infos=infos)
    wanted = (
        {True: set(INFO_KEYS), False: set()}.get(infos) if isinstance(infos, bool) else set(infos)
    )
    env.seed(0)
    env.reset()
    assert {frozenset(info) for info in env.reset_infos} == {frozenset(wanted)}
    ended = 0
    last = {"terminal_observation", "TimeLimit.truncated", "episode"}
    for action in actions(6, 150):
        _, _, dones, found = env.step(action)
        ended += dones.sum()
        for done, info in zip(dones, found, strict=True):
            assert set(info) == (wanted | last if done else wanted)
    assert ended > 5


def test_an_episode_has_its_return_and_length_and_its_end_is_counted():
    """As a monitor sums them, and the shares are those of the last 100 episodes."""
    plain, watched = environment(2), VecMonitor(environment(2))
    assert set(plain.end_shares().values()) == {0.0}
    for env in (plain, watched):
        env.seed(0)
        env.reset()
    ends = []
    for action in actions(6, 150):
        infos = plain.step(action)[3]
        monitored = watched.step(action)[3]
        for info, other in zip(infos, monitored, strict=True):
            assert ("episode" in info) == ("episode" in other)
            if "episode" in info:
                assert info["episode"]["l"] == other["episode"]["l"]
                assert info["episode"]["r"] == pytest.approx(other["episode"]["r"], abs=1e-4)
                ends.append(info["end"])
    assert len(ends) > 5
    shares = plain.end_shares()
    for reason in EndReason:
        if reason is not EndReason.RUNNING:
            kept = ends[-100:]
            assert shares[reason.name.lower()] == pytest.approx(kept.count(reason) / len(kept))
    assert sum(shares.values()) == pytest.approx(1.0)
    plain.reset()
    begun = [info["episode"]["l"] for info in plain.step(np.zeros((6, 2)))[3] if "episode" in info]
    assert set(begun) <= {1}  # counted from the reset on


def test_learning_prints_the_mean_return_without_a_monitor():
    model = PPO("MlpPolicy", environment(), seed=0, **SMALL)
    model.learn(800)
    assert len(model.ep_info_buffer) > 0
    assert all(0 < one["l"] <= 100 for one in model.ep_info_buffer)


def test_the_monitor_logs_how_an_episode_ended():
    env = VecMonitor(environment(2), info_keywords=CHEAP_INFOS)
    env.seed(0)
    env.reset()
    logged = [
        info["episode"]
        for action in actions(6, 150)
        for info in env.step(action)[3]
        if "episode" in info
    ]
    assert {one["end"] for one in logged} == {EndReason.LOST, EndReason.OTHER_ROBOT}
    for one in logged:
        assert one["lost"] or one["end"] != EndReason.LOST
        assert one["position_error_mm"] > 0.0


def test_options_reach_the_next_reset_only():
    poses = [[0.0, -400.0 * i, 0.1 * i] for i in range(3)]
    options = {"phase_s": 7.3, "poses": poses}
    env, alone = environment(2), tlf_env.parallel_env("infinity", plant="batch", **ROUGH)
    env.seed(4)
    env.set_options(options)
    seen = env.reset()
    wanted = alone.reset(seed=5, options=options)[0]
    assert np.array_equal(seen[3:], list(wanted.values()))
    env.seed(4)
    assert np.array_equal(env.reset()[3:], list(alone.reset(seed=5)[0].values()))


def test_each_formation_may_have_its_own_options():
    poses = [[0.0, -400.0 * i, 0.1 * i] for i in range(3)]
    each = [{}, {"phase_s": 2.5}, {"poses": poses}]
    env, alone = environment(3), tlf_env.parallel_env("infinity", plant="batch", **ROUGH)
    env.seed(4)
    env.set_options([options for options in each for _ in range(3)])
    seen = env.reset()
    for k, options in enumerate(each):
        wanted = alone.reset(seed=4 + k, options=options)[0]
        assert np.array_equal(seen[3 * k : 3 * k + 3], list(wanted.values()))


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"phase": 1}, "reset option 'phase' is unknown; the options are poses, phase_s"),
        ({"phase_s": np.inf}, "phase_s must be a finite number"),
        ({"poses": np.zeros((2, 3))}, "poses must be 3 finite rows"),
        ([{}] * 5, "5 mappings for 6 robots"),
        ([{"phase_s": 1.0}] + [{}] * 5, "options differ between the robots of formation 0"),
        ("phase_s", "options must be a mapping"),
        ([1] * 6, "options must be a mapping"),
    ],
)
def test_impossible_options_are_refused_at_once(options, says):
    with pytest.raises(ValueError, match=says) as error:
        environment(2).set_options(options)
    assert "\n" not in str(error.value)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="Windows has no os.fork")
def test_a_forked_child_steps_after_two_threads_did():
    env = environment(64, threads=2)
    env.seed(0)
    env.reset()
    moves = actions(192, 2)
    env.step(moves[0])
    child = os.fork()
    if child == 0:
        signal.alarm(60)  # a child that hangs ends, and fails the test
        seen = env.step(moves[1])[0]
        os._exit(0 if np.isfinite(seen).all() else 1)
    assert os.waitpid(child, 0)[1] == 0


@pytest.mark.parametrize("formations", [2.5, "8", None, float("nan"), True, 0, -1])
def test_an_impossible_number_of_formations_is_named(formations):
    with pytest.raises(ValueError, match="formations"):
        FormationVecEnv("infinity", formations)


@pytest.mark.parametrize("seed", [-1, 2.5, "1", True])
def test_an_impossible_seed_is_named(seed):
    with pytest.raises(ValueError, match="seed"):
        environment(2, seed=seed)
    with pytest.raises(ValueError, match="seed"):
        environment(2).seed(seed)


@pytest.mark.parametrize("name", ["scenario", "place", "render_mode"])
def test_its_own_attributes_cannot_be_set(name):
    env = environment(2)
    with pytest.raises(AttributeError, match=f"{name} cannot be set"):
        env.set_attr(name, None)


def weights(seed: int) -> list[np.ndarray]:
    model = PPO("MlpPolicy", environment(), seed=seed, **SMALL)
    model.learn(600)
    return [tensor.detach().numpy().copy() for tensor in model.policy.parameters()]


def test_the_same_seed_gives_the_same_weights():
    one, same, other = weights(3), weights(3), weights(4)
    assert all(np.array_equal(a, b) for a, b in zip(one, same, strict=True))
    assert not all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


class Constant(VecEnvWrapper):
    """A reward of 1 in every step."""

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        seen, rewards, dones, infos = self.venv.step_wait()
        return seen, np.ones_like(rewards), dones, infos


def test_truncation_is_bootstrapped():
    """A reward of 1 for ever is worth 1/(1 − γ), however short the episodes are cut."""
    gamma = 0.9
    env = Constant(environment(16, lost_beyond_mm=1e6, horizon_s=1.0, end_on=()))
    settings = {**SMALL, "batch_size": 256, "n_epochs": 10, "n_steps": 64, "learning_rate": 3e-3}
    model = PPO("MlpPolicy", env, gamma=gamma, seed=0, **settings)
    model.learn(16 * 3 * 64 * 20)
    seen = env.reset()
    values = model.policy.predict_values(model.policy.obs_to_tensor(seen)[0]).detach().numpy()
    assert values.mean() == pytest.approx(1 / (1 - gamma), rel=0.05)


def test_normalise_monitor_and_evaluate(tmp_path):
    env = VecNormalize(VecMonitor(environment()), norm_reward=True)
    test = VecNormalize(VecMonitor(environment(2)), training=False, norm_reward=False)
    model = PPO("MlpPolicy", env, seed=0, **SMALL)
    callback = EvalCallback(
        test, n_eval_episodes=6, eval_freq=32, log_path=str(tmp_path), verbose=0
    )
    model.learn(800, callback=callback)
    found = np.load(tmp_path / "evaluations.npz")
    assert found["results"].shape[1] == 6
    assert (found["ep_lengths"] <= 100).all()
    assert len(model.ep_info_buffer) > 0
    mean, _ = evaluate_policy(model, env, n_eval_episodes=4)
    assert np.isfinite(mean)


# Learning from nothing, as the README shows it


def played(model: PPO, seeds: range) -> list[tuple[float, int]]:
    """Return and end of an episode of 60 s for each seed, deterministic."""
    env = gymnasium.make("tlf_env/Infinity-v0", horizon_s=60.0, infos=("end",))
    found = []
    for seed in seeds:
        seen, _ = env.reset(seed=seed)
        total, over = 0.0, False
        while not over:
            seen, reward, terminated, truncated, info = env.step(
                model.predict(seen, deterministic=True)[0]
            )
            total, over = total + float(reward), terminated or truncated
        found.append((total, int(info["end"])))
    return found


@pytest.mark.slow
def test_ppo_with_its_defaults_learns_from_nothing():
    """One robot that follows the default system. Before, it is lost; it takes two minutes."""
    model = PPO(
        "MlpPolicy", gymnasium.make("tlf_env/Infinity-v0", infos=False), seed=0, device="cpu"
    )
    seeds = range(10_000, 10_005)
    before = played(model, seeds)
    model.learn(200_000)
    after = played(model, seeds)
    assert {end for _, end in before} == {EndReason.LOST}
    assert {end for _, end in after} == {EndReason.HORIZON}
    assert min(one for one, _ in after) > 2.0 * max(one for one, _ in before)


def readme_snippet(steps: int) -> PPO:
    """The model of the README's snippet, after so many steps in place of its own."""
    blocks = (ROOT / "README.md").read_text("utf-8").split("```python\n")[1:]
    (source,) = (one.partition("```")[0] for one in blocks if "FormationVecEnv(" in one)
    assert source.count("learn(2_000_000)") == 1
    names: dict[str, PPO] = {}
    exec(source.replace("2_000_000", str(steps)), names)
    return names["model"]


def test_the_snippet_of_the_readme_prints_its_returns(capsys):
    readme_snippet(25_000)
    assert "ep_rew_mean" in capsys.readouterr().out


@pytest.mark.slow
def test_the_snippet_of_the_readme_learns_from_nothing():
    """With a quarter of its steps; it takes a minute. Before, no run reaches the horizon."""
    judge = FormationVecEnv("infinity", formations=10, horizon_s=60.0)

    def ends(model: PPO) -> set[int]:
        judge.seed(10_000)
        seen, found = judge.reset(), {}
        while len(found) < judge.num_envs:
            seen, _, dones, infos = judge.step(model.predict(seen, deterministic=True)[0])
            for i in np.flatnonzero(dones):
                found.setdefault(int(i), infos[i]["end"])
        return set(found.values())

    assert EndReason.HORIZON not in ends(PPO("MlpPolicy", judge, seed=0, device="cpu"))
    assert ends(readme_snippet(500_000)) == {EndReason.HORIZON}
