"""Many formations at once: each is the single environment, bit for bit, until robots touch."""

import json
from typing import Any

import numpy as np
import pytest
from helpers import PAPERS
from stack_policy import StackPolicy

import tlf_env
from baselines import ReferencePolicy
from baselines.runs.run import run_policy, run_seeds
from tlf_env import BatchPlant
from tlf_env.common.presets import preset_names
from tlf_env.engine.formation import Formation
from tlf_env.task.info import EndReason
from tlf_env.task.scenario import load_scenario

DISTURBANCES = preset_names("disturbance")
POLICY = ReferencePolicy("consistent")  # keeps no distance: neighbours touch
SHORT: dict[str, Any] = {"time_gap_s": 1.0, "horizon_s": 4.0, "end_on": ()}
# Neighbours a few millimetres apart, on a floor that slips: half of the seeds touch at once.
CROWDED: dict[str, Any] = {
    "disturbance": "slip",
    "start_spacing_mm": 250.0,
    **PAPERS,
}


def acted(plant: BatchPlant) -> np.ndarray:
    """The reference's actions."""
    rows = plant.observations.reshape(-1, plant.observations.shape[-1])
    return POLICY.predict(rows)[0].reshape(plant.arrays.actions.shape)


def driven(plant: BatchPlant, steps: int) -> np.ndarray:
    """Motions (step, lane, robot, field) of a closed loop."""
    out = []
    for _ in range(steps):
        plant.step(acted(plant))
        out.append(plant.arrays.rows("motion").T.copy())
    return np.array(out)


def follow_alone(formation: Formation, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Motions (step, robot, field) and touched flags (step, robot) of one formation."""
    a, motions, touched = formation.arrays, [], []
    for _ in range(steps):
        a.actions[0] = POLICY.predict(a.observations[0])[0]
        formation.step()
        motions.append(a.rows("motion")[:, :, 0].T.copy())
        touched.append(a.touched[0].copy())
    return np.array(motions), np.array(touched)


def check_against_pymunk(scenario: Any, seeds: range, steps: int) -> int:
    """Motions equal until the first contact, which both mark alike; returns how many touched."""
    plant = BatchPlant(scenario, len(seeds), end_on=())
    plant.reset(seeds.start)
    motions, flags = [], []
    for _ in range(steps):
        plant.step(acted(plant))
        motions.append(plant.arrays.rows("motion").T.copy())
        flags.append(plant.touched.copy())
    contacts = 0
    alone = Formation(load_scenario(scenario, plant="pymunk", end_on=()))
    for lane, seed in enumerate(seeds):
        alone.reset(seed)
        expected, touched = follow_alone(alone, steps)
        mine = np.array([flag[lane] for flag in flags])
        ever = np.flatnonzero(touched.any(axis=1))
        first = ever[0] if ever.size else steps
        assert not mine[:first].any()
        for k in range(first):
            assert (motions[k][lane] == expected[k]).all(), (lane, k)
        if first < steps:
            contacts += 1
            assert (mine[first] & touched[first]).any()
    return contacts


@pytest.mark.parametrize("task", ["infinity", "flower"])
@pytest.mark.parametrize("disturbance", DISTURBANCES)
def test_it_is_the_pymunk_plant_until_robots_touch(task, disturbance):
    scenario = load_scenario(task, disturbance=disturbance)
    check_against_pymunk(scenario, range(3, 5), 500)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["infinity", "flower"])
@pytest.mark.parametrize("disturbance", DISTURBANCES)
def test_it_is_the_pymunk_plant_for_whole_episodes(task, disturbance):
    scenario = load_scenario(task, disturbance=disturbance)
    check_against_pymunk(scenario, range(20_000, 20_004), scenario.horizon_steps)


def test_the_first_touch_is_the_pymunk_plants():
    scenario = load_scenario("infinity", **CROWDED)
    assert check_against_pymunk(scenario, range(12), 100) == 6


def test_robots_pass_through_each_other():
    plant = BatchPlant("infinity", 1, robots=2, end_on=(), disturbance="none")
    plant.reset(0)
    towards = np.array([[[-0.3, 0.0], [0.3, 0.0]]])
    for _ in range(150):
        plant.step(towards)
    assert plant.touched.all()
    assert not plant.touched_now.any()
    leader, follower = plant.state()[0, :, :2]
    start = plant.arrays.rows("start")[:2, :, 0].T
    assert np.dot(leader - follower, start[0] - start[1]) < 0


@pytest.mark.parametrize("plant", ["batch", "kinematic"])
def test_formation_k_is_the_single_environment_seeded_so(plant):
    options = {**SHORT, "plant": plant, "disturbance": "combined-hard"}
    many = BatchPlant("infinity", 5, **options)
    many.reset(11)
    env = tlf_env.parallel_env("infinity", **options)
    seen = [many.observations.copy()]
    rewards, infos = [], []
    for _ in range(100):
        many.step(acted(many))
        seen.append(many.observations.copy())
        rewards.append(many.rewards.copy())
        infos.append(many.infos.copy())
    for k in range(5):
        observations, _ = env.reset(seed=11 + k)
        for step in range(100):
            rows = np.stack(list(observations.values()))
            assert (rows == seen[step][k]).all()
            actions = dict(zip(env.agents, POLICY.predict(rows)[0], strict=True))
            observations, reward, *_ = env.step(actions)
            assert list(reward.values()) == rewards[step][k].tolist()
            assert (env.formation.arrays.infos[0] == infos[step][k]).all()
        assert (env.formation.state() == many.state()[k]).all()


def test_neither_the_number_of_formations_nor_threads_change_a_bit():
    options = {**SHORT, "disturbance": "slip"}
    few, many = BatchPlant("infinity", 3, **options), BatchPlant("infinity", 150, **options)
    threaded = BatchPlant("infinity", 150, threads=3, **options)
    for plant in (few, many, threaded):
        plant.reset(5)
    expected = driven(few, 25)
    found = driven(many, 25)
    assert (found[:, :3] == expected).all()
    assert (driven(threaded, 25) == found).all()


def test_a_partial_reset_changes_nothing_elsewhere_and_begins_the_next_episode():
    options = {**SHORT, "disturbance": "combined-hard"}
    plant, other = BatchPlant("infinity", 4, **options), BatchPlant("infinity", 4, **options)
    env = tlf_env.parallel_env("infinity", **options)
    plant.reset(5)
    other.reset(5)
    driven(plant, 10)
    driven(other, 10)
    plant.reset(mask=np.array([False, True, False, False]))
    assert plant.step_counts.tolist() == [10, 0, 10, 10]
    assert plant.episodes.tolist() == [0, 1, 0, 0]
    env.reset(seed=6)
    observations, _ = env.reset()
    assert (plant.observations[1] == np.stack(list(observations.values()))).all()
    rest = [0, 2, 3]
    assert (driven(plant, 20)[:, rest] == driven(other, 20)[:, rest]).all()


def test_seeds_may_be_any_and_a_run_without_one_draws_its_own():
    plant = BatchPlant("infinity", 3, disturbance="start", **SHORT)
    plant.reset([7, 3, 7])
    starts = plant.arrays.rows("start").copy()
    assert (starts[..., 0] == starts[..., 2]).all()
    assert (starts[..., 0] != starts[..., 1]).any()
    fresh = BatchPlant("infinity", 2, **SHORT)
    fresh.reset()
    assert fresh.seeds[1] == fresh.seeds[0] + 1
    assert fresh.episodes.tolist() == [0, 0]
    fresh.reset()
    assert fresh.episodes.tolist() == [1, 1]


# --- ends ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("end_on", [("lost", "touched"), ("lost",), ()])
def test_ends_are_those_of_the_environment(end_on):
    options = {**SHORT, **CROWDED, "end_on": end_on, "lost_beyond_mm": 260.0, "plant": "batch"}
    plant = BatchPlant("infinity", 12, **options)
    plant.reset(0)
    env = tlf_env.parallel_env("infinity", **options)
    steps = [
        (plant.step(acted(plant)), plant.terminated, plant.truncated, plant.ends.copy())
        for _ in range(200)
    ]
    reasons = set()
    for k in range(12):
        observations, _ = env.reset(seed=k)
        for _, terminated, truncated, ends in steps:
            rows = POLICY.predict(np.stack(list(observations.values())))[0]
            agents = list(env.agents)
            observations, _, ended, cut, infos = env.step(dict(zip(agents, rows, strict=True)))
            assert list(ended.values()) == terminated[k].tolist()
            assert list(cut.values()) == truncated[k].tolist()
            ends_by_agent = [infos[agent]["end"] for agent in agents]
            assert ends_by_agent == ends[k].tolist()
            reasons |= set(ends_by_agent)
            if not env.agents:
                break
        assert not env.agents
    expected = {EndReason.RUNNING, EndReason.HORIZON}
    if end_on:
        expected = {EndReason[name.upper()] for name in end_on} | {EndReason.OTHER_ROBOT}
    assert expected <= reasons


def test_the_caller_resets_what_has_ended():
    plant = BatchPlant("infinity", 3, horizon_s=0.1, end_on=())
    plant.reset(0)
    driven(plant, 2)
    plant.reset(mask=np.array([False, True, False]))
    driven(plant, 3)
    assert plant.ended.tolist() == [True, False, True]
    with pytest.raises(RuntimeError, match=r"formation 0: call reset"):
        plant.step(acted(plant))
    assert plant.reset_finished().tolist() == [True, False, True]
    assert plant.episodes.tolist() == [1, 1, 1]
    assert plant.step_counts.tolist() == [0, 3, 0]
    plant.step(acted(plant))


# --- several scenarios -----------------------------------------------------------------------------


def variety() -> list[Any]:
    """Scenarios that differ in everything that may differ."""
    heavy = {"wheel_radius_mm": 60.0, "tyre": {"mu_static": 0.08}}
    patch = {"x_mm": 0.0, "y_mm": 0.0, "radius_mm": 3000.0, "friction_scale": 0.8}
    return [
        load_scenario("infinity", **SHORT, **changes)
        for changes in (
            {"disturbance": "radio"},
            {"disturbance": "actuator", "robot": heavy},
            {"disturbance": {"tyre": {"patches": [patch]}}, "ekf": {"alpha_1": 0.01}},
            {"disturbance": "slip", "wheel_loop": {"gain_Nmm_s": 120.0}},
            {"disturbance": "payload", "disturbance_level": 0.5},
        )
    ]


def test_every_formation_has_its_own_scenario():
    scenarios = variety()
    together = BatchPlant(scenarios, 2 * len(scenarios))
    together.reset(3)
    assert together.scenario_numbers.tolist() == [0, 1, 2, 3, 4] * 2
    found = driven(together, 60)
    for k in range(2 * len(scenarios)):
        alone = BatchPlant(scenarios[k % len(scenarios)], 1)
        alone.reset(3 + k)
        assert (driven(alone, 60)[:, 0] == found[:, k]).all()


def test_episodes_draw_their_scenario_from_a_mixture():
    scenarios = [load_scenario("infinity", disturbance=name, **SHORT) for name in ("none", "ice")]
    plant = BatchPlant(scenarios, 1000, mixture=[0.2, 0.8])
    plant.reset(0)
    first = plant.scenario_numbers.copy()
    assert first.mean() == pytest.approx(0.8, abs=0.05)
    levels = plant.applied[:, 0, 2]
    assert (levels == np.where(first == 1, 0.5, 1.0)).all()
    plant.reset()
    second = plant.scenario_numbers.copy()
    assert second.mean() == pytest.approx(0.8, abs=0.05)
    assert np.corrcoef(first, second)[0, 1] == pytest.approx(0, abs=0.15)
    plant.reset(0, mask=np.arange(1000) < 500)
    assert (plant.scenario_numbers == np.where(np.arange(1000) < 500, first, second)).all()
    even = BatchPlant(scenarios, 1000, mixture=True)
    even.reset(0)
    assert even.scenario_numbers.mean() == pytest.approx(0.5, abs=0.06)


def test_shares_of_a_mixture_change_with_the_next_episodes():
    scenarios = [
        load_scenario("infinity", disturbance=name, **SHORT) for name in ("none", "ice", "slip")
    ]
    plant = BatchPlant(scenarios, 300, mixture=[1, 0, 0])
    plant.reset(0)
    assert set(plant.scenario_numbers) == {0}
    plant.set_shares([0.1, 0.2, 0])
    assert set(plant.scenario_numbers) == {0}
    plant.reset()
    assert set(plant.scenario_numbers) == {0, 1}
    assert (plant.scenario_numbers == 1).mean() == pytest.approx(2 / 3, abs=0.1)
    made_so = BatchPlant(scenarios, 300, mixture=[0.1, 0.2, 0])
    made_so.reset(0)
    made_so.reset()
    assert np.array_equal(made_so.scenario_numbers, plant.scenario_numbers)
    with pytest.raises(ValueError, match="True or 3 shares"):
        plant.set_shares([1.0, 1.0])
    with pytest.raises(ValueError, match="mixture False must be True or 3 shares"):
        plant.set_shares(False)
    with pytest.raises(ValueError, match="shares need a plant with a mixture"):
        BatchPlant("infinity", 2).set_shares(True)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"robots": 4}, "robots is 4"),
        ({"action": "residual"}, "action is 'residual'"),
        ({"horizon_s": 2.0}, "horizon_s is 2.0"),
        (
            {"trajectory": {"type": "circle", "radius_mm": 900.0, "speed_mm_s": 200.0}},
            "trajectory is",
        ),
    ],
)
def test_scenarios_that_differ_elsewhere_are_refused(change, said):
    first = load_scenario("infinity", **SHORT)
    with pytest.raises(ValueError, match=f"scenario 1: {said}") as caught:
        BatchPlant([first, load_scenario(first, **change)], 2)
    assert "\n" not in str(caught.value)


# --- bad input -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"formations": 0}, "formations 0"),
        ({"threads": 0}, "threads 0"),
        ({"mixture": [0.5, 0.5]}, "mixture"),
        ({"mixture": [-1.0]}, "mixture"),
        ({"mixture": "a"}, "mixture 'a' must be True or 1 shares"),
        ({"mixture": [True]}, "mixture .True. must be"),
        ({"mixture": None}, "mixture None must be"),
        ({"mixture": np.array([[1.0], [2.0]])}, "mixture array.* must be"),
        ({"estimator": "mine:Filter"}, "estimator 'mine:Filter'"),
        ({"observer": "mine:Observer"}, "observer 'mine:Observer'"),
        ({"wheel_loop": "mine:Loop"}, "wheel_loop 'mine:Loop'"),
        ({"adversary": True}, "adversary"),
        ({"adversary": True, "plant": "kinematic"}, "adversary"),
    ],
)
def test_what_cannot_run_in_a_batch_is_named(options, said):
    options = {"formations": 1} | options
    with pytest.raises(ValueError, match=said) as caught:
        BatchPlant("infinity", **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("sources", "said"),
    [
        (["infinity", {"Int": 1}], "^scenario 1: .*Int"),
        (["infinity2", "infinity"], "^scenario 0: .*'infinity2'"),
        (["infinity2"], "^scenario 'infinity2'"),
    ],
)
def test_the_scenario_that_cannot_be_loaded_is_numbered(sources, said):
    with pytest.raises(ValueError, match=said) as caught:
        BatchPlant(sources, 3)
    assert "\n" not in str(caught.value)


def test_bad_actions_change_nothing():
    plant = BatchPlant("infinity", 3, disturbance="combined-hard", **SHORT)
    plant.reset(0)
    driven(plant, 3)
    before = [array.copy() for array in plant.arrays]
    actions = np.zeros((3, 3, 2))
    actions[1, 2, 0] = np.nan
    with pytest.raises(ValueError, match=r"formation 1, robot_2: the action must be finite"):
        plant.step(actions)
    with pytest.raises(ValueError, match=r"must have the shape \(3, 3, 2\)"):
        plant.step(np.zeros((3, 2)))
    for array, old in zip(plant.arrays, before, strict=True):
        np.testing.assert_array_equal(array, old)


def test_bad_seeds_and_masks_are_named():
    plant = BatchPlant("infinity", 2)
    with pytest.raises(RuntimeError, match="call reset"):
        plant.step(np.zeros((2, 3, 2)))
    for seed in (-1, 2**63 - 1, [1], [0, -1], 0.5):
        with pytest.raises(ValueError, match="seed"):
            plant.reset(seed)
    for mask in (np.ones(3, dtype=bool), np.ones(2), [[True], None], "yes"):
        with pytest.raises(ValueError, match="mask must be"):
            plant.reset(0, mask)


def test_a_start_that_cannot_be_is_reported_with_its_formation():
    plant = BatchPlant("infinity", 2, disturbance={"payload": {"mass_kg": 2.0, "behind_mm": 200.0}})
    with pytest.raises(ValueError, match=r"formation 0: payload of 2 kg"):
        plant.reset(0)


def test_memory_is_what_the_arrays_take():
    assert 20_000 < BatchPlant("infinity", 1).memory_per_formation_bytes < 200_000


# --- runs and tables -------------------------------------------------------------------------------


class OneFormationOnly:
    """Takes the three rows of one formation."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        if len(observation) != 3:
            raise ValueError("three robots")
        return POLICY.predict(observation)[0], state


@pytest.mark.parametrize("policy", [POLICY, OneFormationOnly()])
def test_runs_side_by_side_are_the_runs_one_by_one(policy):
    scenario = load_scenario("infinity", plant="batch", disturbance="slip", horizon_s=4.0)
    for seed, record in zip((4, 9), run_seeds(scenario, policy, (4, 9)), strict=True):
        alone = run_policy(scenario, policy, seed)
        assert record.metrics() == alone.metrics()
        for name, column in alone.columns.items():
            assert (record[name] == column).all(), name


def test_a_policy_with_a_memory_runs_side_by_side():
    scenario = load_scenario(
        "infinity",
        plant="batch",
        observation="sensor",
        action="torque",
        control_period_s=0.001,
        estimator="ekf",
        horizon_s=0.5,
    )
    records = run_seeds(scenario, StackPolicy(scenario), (0, 1))
    for seed, record in enumerate(records):
        alone = run_policy(scenario, StackPolicy(scenario), seed)
        assert (record["x_mm"] == alone["x_mm"]).all()


def test_the_benchs_lines_are_those_of_pymunk_up_to_contacts(tmp_path):
    pytest.importorskip("arch")
    from baselines.benchmark.bench import run_bench
    from baselines.benchmark.plan import Plan
    from baselines.benchmark.results import RUNS_FILE

    def plan(plant: str) -> Plan:
        return Plan(
            policies=("reference:consistent", "pure_pursuit"),
            tasks=("infinity",),
            disturbances=("nominal", "slip"),
            seeds=(20_000, 20_004),
            overrides=(("horizon_s", 4.0), ("plant", plant)),
        )

    alone = run_bench(plan("pymunk"), tmp_path / "pymunk").ordered()
    results = run_bench(plan("batch"), tmp_path / "batch")
    both = list(zip(alone, results.ordered(), strict=True))
    assert len(both) == 16
    free = [pair for pair in both if not pair[0]["contact"]]
    assert len(free) >= 8
    for one, other in both:
        assert one["contact"] == other["contact"]
        assert one["contact"] == any(robot["touched"] for robot in one["robots"])
    for one, other in free:
        hashes = {line.pop("scenario_hash") for line in (one, other)}
        assert len(hashes) == 2
        assert one == other
    # what is missing after an interruption is run in other blocks, and the lines are the same
    runs = tmp_path / "batch" / RUNS_FILE
    lines = runs.read_text().splitlines(keepends=True)
    runs.write_text("".join(lines[::3]))
    run_bench(plan("batch"), tmp_path / "batch", processes=2)
    assert sorted(lines) == sorted(runs.read_text().splitlines(keepends=True))
    assert all(json.loads(line)["contact"] in (True, False) for line in lines)
