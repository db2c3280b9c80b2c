"""Range sensors: distances by geometry, noise and rate, and that nothing else depends on them."""

from __future__ import annotations

import copy
import math
import pickle
from typing import Any

import gymnasium
import numpy as np
import pymunk
import pytest
import yaml
from helpers import digest, play, untimed
from hypothesis import assume, given
from hypothesis import strategies as st

import tlf_env
from baselines import load_policy
from baselines.policies.card import write_policy
from baselines.policies.network import Network
from baselines.policies.registry import fit_policy, make_policy
from tlf_env.physics.ranging import way_to
from tlf_env.physics.world import Capsule
from tlf_env.task.observation import sensor_entries, tracking_entries
from tlf_env.task.scenario import load_scenario, scenario_warnings

COUNT, RANGE_MM = 16, 1000.0
RADIUS_MM, BEHIND_MM = 110.0, 30.0  # of the outline
EXACT = {"dtype": "float64", "disturbance": "none", "end_on": ()}
HORIZON_S = 10.0
PLANTS = ("pymunk", "batch", "kinematic", "chipmunk")
RECTANGLE = [[-80.0, -90.0], [80.0, -90.0], [80.0, 60.0], [-80.0, 60.0]]


def environment(rays=None, **fields):
    given_rays = {"count": COUNT} if rays is None else rays
    return tlf_env.parallel_env(
        "infinity", rays=given_rays, **{"horizon_s": HORIZON_S} | EXACT | fields
    )


def pose(x=0.0, y=0.0, theta=0.0):
    """Start pose of c that puts the outline's centre at (x, y)."""
    return x - BEHIND_MM * math.sin(theta), y + BEHIND_MM * math.cos(theta), theta


def readings_mm(observations, rays):
    """Readings (robot, ray) in an observation of every robot."""
    rows = np.stack(list(observations.values())) if isinstance(observations, dict) else observations
    return rows[..., rows.shape[-1] - rays.count :] * rays.range_mm


def measured(env, poses, seed=0):
    """Readings at a start, (robot, ray), mm."""
    observations, _ = env.reset(seed=seed, options={"poses": poses})
    return readings_mm(observations, env.scenario.rays)


def wall(distance_mm, thickness_mm=0.0):
    """A long wall across the way ahead of a robot at the origin with heading 0."""
    return {
        "walls": [
            {
                "points_mm": [[-1e5, distance_mm], [1e5, distance_mm]],
                "thickness_mm": thickness_mm,
            }
        ]
    }


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("theta", [0.0, 0.3, -1.2])
def test_a_wall_is_seen_at_its_distance_over_the_cosine(plant, theta):
    env = environment(robots=1, plant=plant, world=wall(400.0, thickness_mm=20.0))
    found = measured(env, [pose(theta=theta)])[0]
    angles = theta + 2 * math.pi * np.arange(COUNT) / COUNT
    with np.errstate(divide="ignore"):
        wanted = np.where(np.cos(angles) > 0, 390.0 / np.cos(angles), np.inf)
    np.testing.assert_allclose(found, np.minimum(wanted, RANGE_MM), atol=1e-6)
    assert (found < RANGE_MM).any()
    assert (found == RANGE_MM).any()


@pytest.mark.parametrize("first", [0.0, 0.1, math.pi / 2])
def test_ray_0_points_to_the_first_angle_and_the_rest_follow_counter_clockwise(first):
    left = {
        "obstacles": [{"shape": {"type": "circle", "radius_mm": 50.0}, "x_mm": -500, "y_mm": 0}]
    }
    env = environment(
        {"count": 8, "first_angle_rad": first}, robots=1, world=left
    )  # counter-clockwise from +y is −x
    found = measured(env, [pose()])[0]
    aside = 500.0 * np.sin(first + 2 * math.pi * np.arange(8) / 8 - math.pi / 2)
    ahead = 500.0 * np.cos(first + 2 * math.pi * np.arange(8) / 8 - math.pi / 2)
    hit = (np.abs(aside) < 50.0) & (ahead > 0)
    depth = np.sqrt(np.where(hit, 50.0**2 - aside**2, 0.0))
    np.testing.assert_allclose(found, np.where(hit, ahead - depth, RANGE_MM), atol=1e-6)
    assert hit.sum() == 1


@pytest.mark.parametrize("plant", PLANTS)
def test_robots_see_each_others_outlines_and_never_their_own(plant):
    env = environment(robots=2, plant=plant)
    found = measured(env, [pose(), pose(y=-700.0, theta=math.pi / 2)])
    assert found[1, COUNT * 3 // 4] == pytest.approx(700.0 - RADIUS_MM, abs=1e-6)
    assert found[0, COUNT // 2] == pytest.approx(700.0 - RADIUS_MM, abs=1e-6)
    assert (found == RANGE_MM).sum() == 2 * COUNT - 2
    assert (measured(environment(robots=1, plant=plant), [pose()]) == RANGE_MM).all()


def test_robots_with_corners_see_the_border_of_each_other():
    env = environment(robots=[{}, {"outline_polygon_mm": RECTANGLE}], start_spacing_mm=400.0)
    found = measured(env, [(0.0, 0.0, 0.0), (0.0, -700.0, 0.0)])
    centre_y = -700.0 - env.scenario.robot_models[1].outline_offset_mm
    assert found[0, COUNT // 2] == pytest.approx(-BEHIND_MM + 700.0 - 60.0, abs=1e-6)
    assert found[1, 0] == pytest.approx(-BEHIND_MM - RADIUS_MM - centre_y, abs=1e-6)
    assert (found == RANGE_MM).sum() == 2 * COUNT - 2


def test_nothing_in_range_reads_the_range():
    env = environment({"count": 5, "range_mm": 300.0}, robots=1, world=wall(400.0))
    observations, _ = env.reset(seed=0, options={"poses": [pose()]})
    assert (observations["robot_0"][-5:] == 1.0).all()
    env = environment({"count": 5, "range_mm": 500.0}, robots=1, world=wall(400.0))
    observations, _ = env.reset(seed=0, options={"poses": [pose()]})
    assert observations["robot_0"][-5] == pytest.approx(0.8, abs=1e-9)


places = st.floats(-500.0, 500.0)


@untimed
@given(places, places, places, places, st.sampled_from([0.0, 5.0, 80.0]), places, places, st.data())
def test_a_way_ends_on_the_border_and_nowhere_before(x_1, y_1, x_2, y_2, radius, x, y, data):
    """Against steps along the ray, with the distance from the axis."""
    angle = data.draw(st.floats(0.0, 2 * math.pi))
    ray = np.array([math.cos(angle), math.sin(angle)])
    first, along = np.array([x_1, y_1]), np.array([x_2 - x_1, y_2 - y_1])

    def gap(way):
        point = np.array([x, y]) + np.multiply.outer(way, ray) - first
        length_2 = along @ along
        share = np.clip(point @ along / length_2, 0, 1) if length_2 > 0 else np.zeros(len(point))
        return np.hypot(*(point - np.multiply.outer(share, along)).T) - radius

    assume(math.hypot(*along) == 0 or math.hypot(*along) > 1e-3)
    found = way_to(Capsule(x_1, y_1, x_2, y_2, radius), x, y, *ray.tolist())
    steps = np.arange(0.0, 3000.0, 2.0)
    if found == 0.0:
        assert gap(np.zeros(1))[0] <= 1e-6
    elif math.isinf(found):
        assert (gap(steps) > -0.1).all()
    else:
        assert abs(gap(np.array([found]))[0]) < 1e-5
        assert (gap(steps[steps < found]) > -1e-5).all()


def test_a_point_beside_the_end_of_a_thick_wall_sees_the_end_first():
    """There pymunk's own query gives where the ray leaves the wall."""
    capsule = Capsule(0.0, 0.0, 1000.0, 0.0, 10.0)
    angle = 0.02
    found = way_to(capsule, -50.0, 2.0, math.cos(angle), math.sin(angle))
    assert 39.0 < found < 41.0
    assert way_to(capsule, -50.0, 2.0, -1.0, 0.0) == math.inf
    assert way_to(capsule, 500.0, 9.0, 0.0, 1.0) == 0.0


def test_no_ray_slips_through_a_corner():
    corner = {
        "obstacles": [
            {
                "shape": {"type": "box", "width_mm": 100.0, "length_mm": 100.0},
                "x_mm": 300.0 * math.cos(angle),
                "y_mm": 300.0 * math.sin(angle),
                "angle_rad": angle + math.pi / 4,
            }
            for angle in 2 * math.pi * np.arange(8) / 8
        ]
    }
    found = measured(environment({"count": 8}, robots=1, world=corner), [pose()])[0]
    np.testing.assert_allclose(found, 300.0 - 50.0 * math.sqrt(2), atol=1e-3)


def crowded(rng):
    """A world with every kind of thing; walls are thin, for pymunk's own query."""

    def place():
        while True:
            x, y = rng.uniform(-1000, 1000, 2)
            if min(math.hypot(x, y), math.hypot(x - 150, y + 300)) > 350:
                return {"x_mm": x, "y_mm": y}

    def shape():
        return [
            {"type": "circle", "radius_mm": rng.uniform(20, 80)},
            {"type": "box", "width_mm": rng.uniform(20, 120), "length_mm": rng.uniform(20, 120)},
            {"type": "polygon", "points_mm": [[-40, -30], [50, -20], [0, 60]]},
        ][rng.integers(3)]

    def turned():
        return {"shape": shape(), **place(), "angle_rad": rng.uniform(0, 6)}

    ends = [list(place().values()) for _ in range(2)]
    return {
        "walls": [{"points_mm": [[-900, -1200], [900, -1200]], "thickness_mm": 0.0}],
        "obstacles": [turned() for _ in range(4)],
        "pushables": [turned() | {"mass_kg": 1.0} for _ in range(3)],
        "moving": [{"shape": shape(), "points_mm": ends, "speed_mm_s": 300.0}],
    }


@pytest.mark.parametrize("outline", [None, RECTANGLE])
@pytest.mark.parametrize("seed", range(4))
def test_readings_are_those_of_pymunks_own_queries(seed, outline):
    rng = np.random.default_rng(seed)
    fields = {} if outline is None else {"robot": {"outline_polygon_mm": outline}}
    env = environment(
        {"count": 64, "range_mm": 1500.0}, robots=2, world=crowded(rng), horizon_s=10.0, **fields
    )
    measured(env, [pose(), pose(x=150.0, y=-300.0, theta=1.0)])
    own = pymunk.Body(2.0, 2000.0)
    own.position, own.angle = (-300.0, 250.0), 0.7
    env.space.add(own, pymunk.Poly.create_box(own, (60, 90)))
    env.space.add(pymunk.Segment(env.space.static_body, (200, 350), (350, 100), 0.0))
    for _ in range(20):
        action = dict.fromkeys(env.agents, np.array([0.05, 0.1]))
        observations, *_ = env.step(action)
    space = env.space
    for robot, body in enumerate(env.robot_bodies.values()):
        for shape in body.shapes:
            shape.filter = pymunk.ShapeFilter(categories=0)
        motion = env.formation.named("motion")
        ahead = env.formation.named("body").outline_ahead[robot]
        x, y, theta = (float(field[robot]) for field in (motion.x, motion.y, motion.theta))
        centre = np.array([x - ahead * math.sin(theta), y + ahead * math.cos(theta)])
        angles = theta + 2 * math.pi * np.arange(64) / 64
        hits = [
            space.segment_query_first(
                tuple(centre), tuple(centre + 1500.0 * np.array(way)), 0.0, pymunk.ShapeFilter()
            )
            for way in zip(-np.sin(angles), np.cos(angles), strict=True)
        ]
        wanted = [1500.0 if hit is None else 1500.0 * hit.alpha for hit in hits]
        found = readings_mm(observations, env.scenario.rays)[robot]
        np.testing.assert_allclose(found, wanted, atol=1e-4)
        assert len(set(np.round(wanted, 3))) > 20
        for shape in body.shapes:
            shape.filter = pymunk.ShapeFilter()


def test_a_sensor_shape_and_a_load_on_the_own_body_are_not_seen():
    env = environment({"count": 4}, robots=2)
    poses = [pose(), pose(y=-700.0)]
    without = measured(env, poses)
    trigger = pymunk.Circle(env.space.static_body, 50.0, (0.0, 500.0))
    trigger.sensor = True
    load = pymunk.Circle(env.robot_bodies["robot_0"], 150.0)
    env.space.add(trigger, load)
    found = measured(env, poses)
    np.testing.assert_array_equal(found[0], without[0])
    assert found[1, 0] < without[1, 0] - 10.0
    trigger.sensor = False
    assert measured(env, poses)[0, 0] == pytest.approx(450.0, abs=1e-6)


BOX = {"type": "box", "width_mm": 150.0, "length_mm": 150.0}
SOMEWHERE = {
    "walls": [{"points_mm": [[-6000, 3900], [8000, 3900]]}],
    "pushables": [
        {"shape": BOX, "x_mm": 2300.0, "y_mm": 3000.0, "mass_kg": 0.5},
        {"shape": BOX, "x_mm": 2300.0, "y_mm": 3155.0, "mass_kg": 0.5},
    ],
    "moving": [
        {
            "shape": {"type": "circle", "radius_mm": 100.0},
            "points_mm": [[1500, 2800], [2600, 2800]],
            "speed_mm_s": 300.0,
            "random_start": True,
        }
    ],
}


@pytest.mark.parametrize(
    "fields",
    [
        {"world": SOMEWHERE},
        {"world": SOMEWHERE, "robot": {"outline_polygon_mm": RECTANGLE}, "start_spacing_mm": 400.0},
        {"disturbance": "combined-medium", "plant": "batch"},
        {"observation": "sensor", "disturbance": "noise"},
        {"plant": "kinematic"},
        {"plant": "chipmunk", "world": SOMEWHERE},
        {"action": "residual"},
    ],
    ids=str,
)
def test_rays_change_no_bit_of_anything_else(fields):
    runs = []
    for rays in (None, {"count": 7, "noise_std_mm": 20.0, "period_s": 0.04}):
        env = tlf_env.parallel_env("infinity", rays=rays, horizon_s=5.0, end_on=(), **fields)
        start = env.reset(seed=3)
        cut = 0 if rays is None else 7
        rng = np.random.default_rng(0)
        seen = [(start[0], start[1])]
        for _ in range(150):
            push = {agent: rng.uniform(0.0, 0.8, 2) for agent in env.agents}
            seen.append(env.step(push))
        runs.append(
            digest(
                [
                    ({a: row[: len(row) - cut] for a, row in step[0].items()}, *step[1:])
                    for step in seen
                ]
            )
        )
        states = digest(env.state())
        runs[-1] += states
        if rays:
            taken = readings_mm(seen[-1][0], env.scenario.rays)
            assert (taken < RANGE_MM).any()
    assert runs[0] == runs[1]


def test_noise_is_white_with_its_standard_deviation_and_of_its_own_stream():
    quiet = environment({"count": 50}, robots=1, world=wall(400.0))
    noisy = environment({"count": 50, "noise_std_mm": 30.0}, robots=1, world=wall(400.0))
    true, found = [], []
    for env, rows in ((quiet, true), (noisy, found)):
        observations, _ = env.reset(seed=5, options={"poses": [pose()]})
        for _ in range(300):
            observations, *_ = env.step({"robot_0": np.zeros(2)})
            rows.append(readings_mm(observations, env.scenario.rays)[0])
    true, found = np.array(true), np.array(found)
    seen = (true > 200) & (true < 850)
    error = np.where(seen, found - true, np.nan)[:, seen.all(axis=0)]
    count = error.size
    assert count > 4000
    assert abs(error.mean()) < 4 * 30.0 / math.sqrt(count)
    assert error.std() == pytest.approx(30.0, abs=4 * 30.0 / math.sqrt(2 * count))
    later = np.corrcoef(error[:-1].ravel(), error[1:].ravel())[0, 1]
    beside = np.corrcoef(error[:, :-1].ravel(), error[:, 1:].ravel())[0, 1]
    assert max(abs(later), abs(beside)) < 4 / math.sqrt(count)
    assert found.max() == RANGE_MM


def test_noise_depends_on_seed_robot_episode_and_step_but_not_on_the_number_of_rays():
    def noise(count, seed=0, **fields):
        env = environment(
            {"count": count, "noise_std_mm": 1.0, "range_mm": 1e4},
            robots=1,
            world={"walls": [{"points_mm": [[-500, -500], [500, -500], [500, 500], [-500, 500]],
                              "closed": True}]},
            **fields,
        )  # fmt: skip
        start = measured(env, [pose()], seed)[0]
        observations, *_ = env.step({"robot_0": np.zeros(2)})
        then = readings_mm(observations, env.scenario.rays)[0]
        observations, _ = env.reset(options={"poses": [pose()]})
        return start, then, readings_mm(observations, env.scenario.rays)[0]

    start, then, episode = noise(8)
    assert (start != then).all()
    assert (start != episode).all()
    assert (start != noise(8, seed=1)[0]).all()
    assert noise(4)[0][0] == start[0]
    env = environment({"count": 2, "noise_std_mm": 50.0, "range_mm": 1e4}, robots=2)
    found = measured(env, [pose(), pose(y=-700.0)])
    assert 1e4 - found[0, 0] != 1e4 - found[1, 1]


def test_noise_stays_within_zero_and_the_range():
    env = environment({"count": 360, "noise_std_mm": 1e4}, robots=1, world=wall(400.0))
    found = measured(env, [pose()])[0]
    assert set(found) >= {0.0, RANGE_MM}
    assert ((found >= 0) & (found <= RANGE_MM)).all()


@pytest.mark.parametrize("plant", PLANTS)
def test_between_two_readings_the_last_holds(plant):
    rays = {"count": 4, "noise_std_mm": 1.0, "range_mm": 5000.0, "period_s": 0.06}
    env = environment(rays, robots=1, plant=plant, world=wall(3000.0))
    observations, _ = env.reset(seed=0, options={"poses": [pose()]})
    rows = [observations["robot_0"][-4]]
    for _ in range(12):
        observations, *_ = env.step({"robot_0": np.array([0.5, 0.0])})
        rows.append(observations["robot_0"][-4])
    fresh = [k for k in range(1, 13) if rows[k] != rows[k - 1]]
    assert fresh == [3, 6, 9, 12]
    every = environment({**rays, "period_s": None}, robots=1, plant=plant, world=wall(3000.0))
    observations, _ = every.reset(seed=0, options={"poses": [pose()]})
    for _ in range(12):
        observations, *_ = every.step({"robot_0": np.array([0.5, 0.0])})
    assert observations["robot_0"][-4] == rows[12]


def test_zero_noise_draws_nothing():
    world = wall(400.0)
    one, other = (
        measured(environment(rays, robots=1, world=world), [pose(theta=0.2)], seed)
        for seed, rays in ((0, {"count": 9}), (1, {"count": 9, "noise_std_mm": 0.0}))
    )
    assert (one == other).all()


@pytest.mark.parametrize("observation", ["tracking", "sensor"])
def test_both_observations_end_in_the_rays(observation):
    rays = {"count": 3, "range_mm": 700.0}
    plain = tlf_env.parallel_env("infinity", observation=observation)
    env = tlf_env.parallel_env("infinity", observation=observation, rays=rays)
    model = env.scenario.rays
    entries = (
        tracking_entries(env.scenario.preview_s, model)
        if observation == "tracking"
        else sensor_entries(env.scenario.substeps, model)
    )
    assert list(entries)[-3:] == ["ray_0", "ray_1", "ray_2"]
    assert entries["ray_2"].scale == 700.0
    seen, _ = env.reset(seed=0)
    for agent in env.agents:
        space = env.observation_space(agent)
        assert space.shape == (len(entries),)
        assert space.contains(seen[agent])
        np.testing.assert_array_equal(seen[agent][:-3], plain.reset(seed=0)[0][agent])
    assert seen["robot_1"][-3] == np.float32((300.0 - RADIUS_MM) / 700.0)


def test_a_copy_and_a_pickle_go_on_bit_for_bit():
    rays = {"count": 8, "noise_std_mm": 5.0, "period_s": 0.06}
    env = environment(rays, world=SOMEWHERE)
    observations, _ = env.reset(seed=0)
    play(env, observations, 40, lambda env, _: dict.fromkeys(env.agents, np.array([0.4, 0.1])))
    others = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]

    def push(env: Any, _: Any) -> dict[str, np.ndarray]:
        return dict.fromkeys(env.agents, np.array([0.4, -0.1]))

    results = [digest(play(one, observations, 60, push)) for one in (env, *others)]
    assert results[0] == results[1] == results[2]


def test_a_batch_has_the_bits_of_single_environments():
    fields = {
        "rays": {"count": 12, "noise_std_mm": 3.0, "range_mm": 2000.0, "period_s": 0.04},
        "world": "slalom_posts",
        "horizon_s": HORIZON_S,
        "end_on": (),
    }
    plant = tlf_env.BatchPlant("infinity", 9, plant="batch", threads=2, **fields)
    plant.reset(seed=4)
    rng = np.random.default_rng(0)
    actions = rng.uniform(0.0, 0.3, (40, 9, 3, 2)).astype(np.float32)
    rows = [plant.observations.copy()]
    for action in actions:
        plant.step(action)
        rows.append(plant.observations.copy())
    for k, kind in ((0, "pymunk"), (5, "batch")):
        env = tlf_env.parallel_env("infinity", plant=kind, **fields)
        observations, _ = env.reset(seed=4 + k)
        for step in range(41):
            np.testing.assert_array_equal(np.stack(list(observations.values())), rows[step][k])
            if step < 40:
                given_to = zip(env.agents, actions[step, k], strict=True)
                observations, *_ = env.step(dict(given_to))
    assert (rows[-1][..., -12:] < 1.0).any()


def test_a_range_within_the_outline_gives_a_warning():
    said = "rays.range_mm 110 is at most outline_radius_mm 110"
    lines = scenario_warnings(load_scenario("infinity", rays={"range_mm": 110.0}))
    assert any(line.startswith(said) for line in lines)
    assert not scenario_warnings(load_scenario("infinity", rays={"range_mm": 111.0}))


def test_gymnasium_has_the_rays():
    fields = {"rays": {"count": 4}, "horizon_s": HORIZON_S}
    single = gymnasium.make("tlf_env/Infinity-v0", learner="robot_1", **fields)
    vector = gymnasium.make_vec(
        "tlf_env/Infinity-v0",
        num_envs=2,
        vectorization_mode="vector_entry_point",
        learner="robot_1",
        plant="batch",
        **fields,
    )
    width = len(tracking_entries((0.5, 1.0))) + 4
    assert single.observation_space.shape == (width,)
    assert vector.single_observation_space.shape == (width,)
    alone, _ = single.reset(seed=1)
    np.testing.assert_array_equal(vector.reset(seed=1)[0][0], alone)
    assert alone[-4] == np.float32((300.0 - RADIUS_MM) / RANGE_MM)


@pytest.mark.parametrize(
    "name", ["reference:consistent", "residual", "pure_pursuit", "feedback_linearisation"]
)
def test_policies_without_rays_act_as_without_them(name):
    runs = []
    for rays in (None, {"count": 6}):
        policy, scenario, asked = fit_policy(name, load_scenario("infinity", rays=rays))
        assert "rays" not in asked
        env = tlf_env.parallel_env(scenario)
        observations, _ = env.reset(seed=0)
        taken = []
        for _ in range(30):
            actions = policy.predict(np.stack(list(observations.values())))[0]
            taken.append(actions)
            observations, *_ = env.step(dict(zip(env.agents, actions, strict=True)))
        runs.append(np.array(taken))
    np.testing.assert_array_equal(runs[0], runs[1])


def test_a_policy_that_takes_rays_asks_for_them_and_refuses_others(tmp_path):
    trained = load_scenario("infinity", rays={"count": 6, "range_mm": 500.0})
    width = len(tracking_entries(trained.preview_s, trained.rays))
    network = Network(hidden=(4,), activation="tanh", head="gaussian")
    tensors = {name: np.ones(shape, "f4") for name, shape in network.shapes(width).items()}
    path = tmp_path / "seeing.safetensors"
    made = ("training", "seeds", "versions", "scores")
    write_policy(
        path, network, tensors, trained, algorithm="PPO", command="x", **{name: {} for name in made}
    )
    assert load_policy(path).predict(np.zeros((1, width)))[0].shape == (1, 2)
    _, fitted, asked = fit_policy(str(path), load_scenario("infinity"))
    assert fitted.rays == trained.rays
    assert set(asked) == {"rays"}
    for rays in (None, {"count": 12, "range_mm": 500.0}, {"count": 6, "range_mm": 400.0}):
        with pytest.raises(ValueError, match=r"trained with rays Rays\(count=6.* the scenario has"):
            make_policy(str(path), load_scenario("infinity", rays=rays))


WRONG = [
    ({"count": 0}, r"rays\.count: Input should be greater than or equal to 1, got 0"),
    ({"count": 361}, r"rays\.count: Input should be less than or equal to 360, got 361"),
    ({"count": 2.5}, r"rays\.count: Input should be a whole number, got 2\.5"),
    ({"range_mm": 0.0}, r"rays\.range_mm: Input should be greater than 0, got 0"),
    ({"noise_std_mm": -1.0}, r"rays\.noise_std_mm: .*greater than or equal to 0, got -1"),
    ({"first_angle_rad": math.inf}, r"rays\.first_angle_rad: Input should be a finite number"),
    ({"period_s": 0.03}, r"rays\.period_s 0\.03 must be a multiple of control_period_s 0\.02"),
    ({"period_s": 0.001}, r"rays\.period_s 0\.001 must be a multiple"),
    ({"period_s": 1e9}, r"rays\.period_s 1000000000\.0 must be a multiple .* at most 10000000"),
    ({"number": 3}, r"rays\.number: unknown key"),
    (16, r"rays: Input should be a mapping, got 16"),
]


@pytest.mark.parametrize(("rays", "said"), WRONG, ids=str)
def test_wrong_values_are_refused_in_one_line_at_every_door(rays, said, tmp_path):
    file = tmp_path / "mine.yaml"
    base = load_scenario("infinity").model_dump(mode="json")
    file.write_text(yaml.safe_dump({"trajectory": base["trajectory"], "rays": rays}))
    doors = [
        lambda: load_scenario("infinity", rays=rays),
        lambda: load_scenario(file),
        lambda: tlf_env.parallel_env("infinity", rays=rays),
        lambda: gymnasium.make("tlf_env/Infinity-v0", rays=rays),
        lambda: tlf_env.BatchPlant("infinity", 2, plant="batch", rays=rays),
    ]
    for door in doors:
        with pytest.raises(ValueError, match=said) as caught:
            door()
        assert "\n" not in str(caught.value)


def test_the_environments_of_stable_baselines_have_the_rays():
    sb3 = pytest.importorskip("baselines.sb3", exc_type=ImportError)
    rays = {"count": 4}
    envs = sb3.FormationVecEnv("infinity", formations=2, rays=rays, seed=1)
    alone, _ = tlf_env.parallel_env("infinity", plant="batch", rays=rays).reset(seed=1)
    np.testing.assert_array_equal(envs.reset()[1], alone["robot_1"])
    tasks = {
        "a": [load_scenario("infinity", rays=rays)],
        "b": [load_scenario("flower")],
    }
    with pytest.raises(ValueError, match="has rays None, the first task"):
        sb3.FormationVecEnv(tasks, formations=2)
