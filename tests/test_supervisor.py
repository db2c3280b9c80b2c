"""The neighbour that a robot hears, and the supervisor: entries, law, limiter files, and rows of robots."""

from __future__ import annotations

import math

import gymnasium
import numpy as np
import pytest
import yaml
from helpers import untimed
from hypothesis import given
from hypothesis import strategies as st

import tlf_env
from baselines import load_policy
from baselines.policies.card import write_policy
from baselines.policies.entries import AskedFields, entries_of
from baselines.policies.network import Network
from baselines.policies.registry import fit_policy, make_policy, policy_hash
from baselines.policies.systems import load_limiter
from baselines.runs.run import run_policy, run_seeds
from baselines.tuning.start import named_start
from tlf_env.engine.formation import Formation
from tlf_env.onboard.observer import Message, dead_reckoned
from tlf_env.onboard.supervisor import (
    CORRECTION_MM,
    INSTANTS,
    Neighbour,
    Path,
    Supervisor,
    curvature,
    least_distance,
    ramped_way,
    straight_approach,
    supervised_twist,
    supervisor_row,
)
from tlf_env.task.observation import NEIGHBOUR_ENTRIES, tracking_entries
from tlf_env.task.scenario import load_scenario

PLANTS = ("pymunk", "batch", "kinematic", "chipmunk")
EXACT = {"dtype": "float64", "estimator": "truth", "disturbance": "none", "end_on": ()}
PLACES = [(0.0, 0.0, 0.3), (900.0, -300.0, 1.2), (-400.0, 700.0, -2.0), (1500.0, 600.0, 2.9)]
SCALES = np.array([entry.scale for entry in NEIGHBOUR_ENTRIES.values()])
LAW = "feedback_linearisation:bounded+ekf-slip"
SUPERVISOR = Supervisor()
ROW = supervisor_row(SUPERVISOR)
SLOW_ROW = supervisor_row(Supervisor(clearing_mm_s=0.0))
NONE_AHEAD = Message(0.0, 1e6, 0.0, 0.0, 0.0)


def heard_by(observation: np.ndarray) -> np.ndarray:
    """The neighbour's entries at the end of observations, in physical units."""
    return observation[..., -len(SCALES) :] * SCALES


def row_of(robots: int = 4, range_mm: float = 3000.0, **fields):
    return tlf_env.parallel_env(
        "infinity",
        robots=robots,
        neighbour={"range_mm": range_mm},
        horizon_s=10.0,
        **EXACT | fields,
    )


# What is heard


@pytest.mark.parametrize("plant", PLANTS)
def test_the_entries_are_the_true_geometry(plant):
    env = row_of(plant=plant)
    seen, infos = env.reset(seed=0, options={"poses": PLACES})
    actions = {agent: np.array([0.1 + 0.1 * i, 0.05 * i]) for i, agent in enumerate(env.agents)}
    for _ in range(26):
        places = np.array(
            [[infos[a][key] for key in ("x_mm", "y_mm", "theta_rad")] for a in env.agents]
        )
        for i, agent in enumerate(env.agents):
            found = heard_by(seen[agent])
            others = range(i - 1) if i else ()
            if not others:
                assert (found == 0.0).all()
                continue
            j = min(others, key=lambda k: math.hypot(*(places[k] - places[i])[:2]))
            d_x, d_y, turn = places[j] - places[i]
            sin, cos = math.sin(places[i, 2]), math.cos(places[i, 2])
            place = [cos * d_y - sin * d_x, cos * d_x + sin * d_y]
            np.testing.assert_allclose(found[:3], [1.0, *place], atol=1e-6)
            np.testing.assert_allclose(found[3:5], [math.sin(turn), math.cos(turn)], atol=1e-9)
        seen, *_, infos = env.step(actions)
    moving = heard_by(seen["robot_2"])[5:]
    np.testing.assert_allclose(moving, [100.0, 0.0], atol=15.0)


def test_a_robot_is_heard_up_to_the_range_and_no_farther():
    away_mm = math.hypot(*np.subtract(PLACES[2][:2], PLACES[0][:2]))
    for range_mm, is_heard in ((away_mm + 1e-6, True), (away_mm - 1e-6, False)):
        seen, _ = row_of(3, range_mm).reset(seed=0, options={"poses": PLACES[:3]})
        assert heard_by(seen["robot_2"])[0] == is_heard
        assert heard_by(seen["robot_2"]).any() == is_heard
        assert np.isfinite(seen["robot_2"]).all()


def test_the_entries_come_after_the_previews_and_before_the_rays():
    names = list(tracking_entries((0.5,), load_scenario(rays={"count": 2}).rays, Neighbour()))
    assert names[-9:] == [*NEIGHBOUR_ENTRIES, "ray_0", "ray_1"]
    assert names[:-9] == list(tracking_entries((0.5,)))
    with_rays = row_of(rays={"count": 2}).reset(seed=0, options={"poses": PLACES})[0]["robot_3"]
    without = row_of().reset(seed=0, options={"poses": PLACES})[0]["robot_3"]
    np.testing.assert_array_equal(with_rays[:-2], without)


def test_hearing_changes_no_other_entry_and_no_motion():
    fields = {"robots": 4, "horizon_s": 6.0, "plant": "batch", "disturbance": "slip"}
    scenarios = [load_scenario("infinity", neighbour=one, **fields) for one in (None, {})]
    fitted = [fit_policy(LAW, one) for one in scenarios]
    runs = [run_policy(one.scenario, one.policy, 0) for one in fitted]
    for column, values in runs[0].columns.items():
        np.testing.assert_array_equal(values, runs[1][column], err_msg=column)
    seen = [tlf_env.parallel_env(one).reset(seed=0)[0]["robot_3"] for one in scenarios]
    np.testing.assert_array_equal(seen[1][: -len(SCALES)], seen[0])


def driven(steps: int, **disturbance):
    """A row of four driven with changing twists: its formation, and the neighbour's entries of robot 3."""
    fields = EXACT | {"disturbance": {"radio": disturbance}}
    formation = Formation(
        load_scenario(
            "infinity", robots=4, neighbour={"range_mm": 5000.0}, horizon_s=10.0, **fields
        )
    )
    formation.reset(seed=1)
    rows = []
    for step in range(steps):
        twist = 0.2 + 0.1 * np.sin(0.3 * step + np.arange(4))
        formation.arrays.actions[0] = np.stack([twist, twist - 0.2], axis=-1)
        formation.step()
        rows.append(formation.arrays.observations[0, 3].copy())
    return formation, np.array(rows)


def test_a_lost_message_is_continued_from_the_last_one():
    """If all are lost, from that of the start, at rest."""
    formation, rows = driven(20, dropout=0.999)
    messages = formation.arrays.messages
    assert formation.arrays.dropped[1:21, 1, 0].all()
    assert not np.array_equal(rows[-1], rows[0])
    np.testing.assert_array_equal(messages[:, 20, 1, 0], messages[:, 0, 1, 0])
    x, y, theta = (float(messages[k, 0, 1, 0]) for k in range(3))
    own_x, own_y, own = formation.arrays.named("estimate")[:3]
    d_x, d_y, turn = x - own_x[3, 0], y - own_y[3, 0], theta - own[3, 0]
    sin, cos = math.sin(own[3, 0]), math.cos(own[3, 0])
    wanted = [
        1.0,
        cos * d_y - sin * d_x,
        cos * d_x + sin * d_y,
        math.sin(turn),
        math.cos(turn),
        0,
        0,
    ]
    np.testing.assert_allclose(heard_by(rows[-1]), wanted, atol=1e-9)


def test_a_late_message_is_as_old_as_that_of_the_predecessor():
    formation, rows = driven(40, jitter_s=0.1)
    entries = list(tracking_entries(formation.scenario.preview_s, None, Neighbour()))
    scales = np.array(
        [entry.scale for entry in tracking_entries((0.5, 1.0), None, Neighbour()).values()]
    )
    ages = set()
    for step in range(10, 41):
        seen = dict(zip(entries, rows[step - 1] * scales, strict=True))
        for age in range(6):
            speeds = [
                formation.arrays.slot(formation.arrays.messages, step - age)[3, sender, 0]
                for sender in (2, 1)
            ]
            if seen["predecessor_u_1"] == pytest.approx(speeds[0], abs=1e-9):
                assert seen["neighbour_u_1"] == pytest.approx(speeds[1], abs=1e-9)
                ages.add(age)
                break
        else:
            pytest.fail("the predecessor's message is of no age that jitter allows")
    assert len(ages) > 2


# The doors


def test_every_door_takes_the_field():
    width = len(tracking_entries((0.5, 1.0))) + len(SCALES)
    fields = {"neighbour": {}, "robots": 4, "horizon_s": 10.0}
    poses = {"poses": PLACES}
    wanted = tlf_env.parallel_env("infinity", **fields).reset(seed=3, options=poses)[0]["robot_3"]
    assert wanted.shape == (width,)
    assert heard_by(wanted)[0] == 1.0
    single = gymnasium.make("tlf_env/Infinity-v0", learner="robot_3", **fields)
    np.testing.assert_array_equal(single.reset(seed=3, options=poses)[0], wanted)
    vector = gymnasium.make_vec(
        "tlf_env/Infinity-v0",
        num_envs=2,
        vectorization_mode="vector_entry_point",
        learner="robot_3",
        **fields,
    )
    np.testing.assert_array_equal(vector.reset(seed=3, options=poses)[0][0], wanted)
    plant = tlf_env.BatchPlant("infinity", 2, plant="batch", **fields)
    plant.reset(seed=3, options=poses)
    np.testing.assert_array_equal(plant.observations[0, 3], wanted)


def test_the_vector_environment_of_stable_baselines_takes_the_field():
    sb3 = pytest.importorskip("baselines.sb3", exc_type=ImportError)
    fields = {"robots": 4, "horizon_s": 10.0}
    env = sb3.FormationVecEnv("infinity", 1, neighbour={}, **fields)
    assert env.observation_space.shape == (len(tracking_entries((0.5, 1.0))) + len(SCALES),)
    tasks = {"a": [load_scenario(neighbour={}, **fields)], "b": [load_scenario(**fields)]}
    with pytest.raises(ValueError, match="neighbour None, the first task Neighbour"):
        sb3.FormationVecEnv(tasks, 2)


def test_a_batch_has_the_bits_of_a_single_environment():
    fields = {"neighbour": {}, "robots": 4, "horizon_s": 10.0, "disturbance": "radio", "end_on": ()}
    plant = tlf_env.BatchPlant("infinity", 3, plant="batch", **fields)
    env = tlf_env.parallel_env("infinity", **fields)
    plant.reset(seed=5)
    seen, _ = env.reset(seed=6)
    rng = np.random.default_rng(0)
    for _ in range(30):
        np.testing.assert_array_equal(np.stack(list(seen.values())), plant.observations[1])
        actions = rng.uniform(0.0, 0.4, (3, 4, 2)).astype(np.float32)
        plant.step(actions)
        seen, *_ = env.step(dict(zip(env.agents, actions[1], strict=True)))


WRONG = [
    ({"range_mm": 0.0}, r"neighbour\.range_mm: Input should be greater than 0, got 0"),
    ({"range_mm": 5001.0}, r"neighbour\.range_mm: .*less than or equal to 5000, got 5001"),
    ({"range_mm": math.inf}, r"neighbour\.range_mm: "),
    ({"range": 3.0}, r"neighbour\.range: unknown key"),
    (1000, r"neighbour: Input should be a mapping, got 1000"),
]


@pytest.mark.parametrize(("neighbour", "said"), WRONG, ids=str)
def test_wrong_values_are_refused_in_one_line_at_every_door(neighbour, said, tmp_path):
    file = tmp_path / "mine.yaml"
    base = load_scenario("infinity").model_dump(mode="json")
    file.write_text(yaml.safe_dump({"trajectory": base["trajectory"], "neighbour": neighbour}))
    for door in (
        lambda: load_scenario(file),
        lambda: tlf_env.parallel_env("infinity", neighbour=neighbour),
        lambda: gymnasium.make("tlf_env/Infinity-v0", neighbour=neighbour),
        lambda: tlf_env.BatchPlant("infinity", 2, plant="batch", neighbour=neighbour),
    ):
        with pytest.raises(ValueError, match=rf"^[^\n]*{said}[^\n]*$"):
            door()


def test_the_observation_sensor_has_no_neighbour():
    with pytest.raises(ValueError, match="neighbour needs observation 'tracking'"):
        load_scenario("infinity", neighbour={}, observation="sensor")


def test_a_learned_policy_asks_for_its_neighbour(tmp_path):
    trained = load_scenario("infinity", neighbour={"range_mm": 1500.0})
    width = len(tracking_entries(trained.preview_s, None, trained.neighbour))
    network = Network(hidden=(4,), activation="tanh", head="gaussian")
    tensors = {name: np.ones(shape, "f4") for name, shape in network.shapes(width).items()}
    path = tmp_path / "hearing.safetensors"
    made = ("training", "seeds", "versions", "scores")
    write_policy(
        path, network, tensors, trained, algorithm="PPO", command="x", **{name: {} for name in made}
    )
    assert load_policy(path).predict(np.zeros((1, width)))[0].shape == (1, 2)
    _, fitted, asked = fit_policy(str(path), load_scenario("infinity"))
    assert fitted.neighbour == trained.neighbour
    assert set(asked) == {"neighbour"}
    with pytest.raises(
        ValueError, match=r"trained with neighbour Neighbour\(.*the scenario has None"
    ):
        make_policy(str(path), load_scenario("infinity"))


def test_a_competitions_entry_may_ask_for_it():
    asked = AskedFields(neighbour={"range_mm": 800.0}).model_dump(exclude_none=True)
    scenario = load_scenario("infinity", **asked)
    assert list(entries_of(scenario))[-len(SCALES) :] == list(NEIGHBOUR_ENTRIES)


# The law

speeds = st.floats(0.0, 400.0)
yaw_rates = st.floats(-0.8, 0.8)
far = st.floats(-1200.0, 1200.0)
headings = st.floats(-math.pi, math.pi)


def centres(message: Message, ways: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Outline centres (time, 2) of a robot that has driven ways (mm) and turned (rad), by small steps."""
    theta = message.theta + turns
    step = np.diff(ways, prepend=0.0)
    middle = theta - np.diff(turns, prepend=0.0) / 2
    x, y = (
        message.x - np.cumsum(step * np.sin(middle)),
        message.y + np.cumsum(step * np.cos(middle)),
    )
    behind = SUPERVISOR.outline_offset_mm
    return np.stack([x + behind * np.sin(theta), y - behind * np.cos(theta)], axis=-1)


bends = st.floats(-0.003, 0.003)


@untimed
@given(speeds, speeds, bends, bends, far, far, headings, speeds, yaw_rates)
def test_the_least_distance_is_that_of_small_steps(
    speed, now, bend, later_bend, x, y, theta, u_1, u_2
):
    other = Message(x, y, theta, u_1, u_2)
    times = np.linspace(0.0, SUPERVISOR.horizon_s, 3001)
    ways = np.array([ramped_way(now, speed, SUPERVISOR.braking_mm_s2, t) for t in times])
    first = np.minimum(ways, CORRECTION_MM)
    turns = bend * first + later_bend * (ways - first)
    between = centres(other, u_1 * times, u_2 * times) - centres(
        Message(0.0, 0.0, 0.0, 0.0, 0.0), ways, turns
    )
    wanted = np.hypot(*between[times >= SUPERVISOR.horizon_s / INSTANTS - 1e-9].T).min()
    path = Path(bend, later_bend)
    assert least_distance(speed, now, path, other, ROW) == pytest.approx(wanted, abs=12.0)


@untimed
@given(far, far, far, far)
def test_a_straight_approach_is_the_closest_point_of_approach(x, y, d_x, d_y):
    shares = np.linspace(0.0, 1.0, 2001)
    wanted = np.hypot(x + shares * d_x, y + shares * d_y).min()
    assert straight_approach(x, y, d_x, d_y) == pytest.approx(wanted, abs=1.0)
    assert straight_approach(x, y, d_x, d_y) <= wanted + 1e-9


@untimed
@given(st.floats(1.0, 500.0), st.floats(0.0, 500.0), st.floats(0.1, 5.0))
def test_a_ramped_way_has_the_speeds_of_a_constant_deceleration(now, then, time):
    rate = 100.0
    speeds_then = np.clip(
        then, now - rate * np.linspace(0, time, 2001), now + rate * np.linspace(0, time, 2001)
    )
    wanted = np.trapezoid(speeds_then, dx=time / 2000)
    assert ramped_way(now, then, rate, time) == pytest.approx(wanted, abs=0.1)


@untimed
@given(st.floats(-100.0, 600.0), yaw_rates, speeds, bends, far, far, headings, speeds, yaw_rates)
def test_a_twist_is_left_or_reduced_alike_or_clears_straight_ahead(
    u_1, u_2, now, later_bend, x, y, turn, v_1, v_2
):
    other = Message(x, y, turn, v_1, v_2)
    path = Path(curvature(max(u_1, now), u_2), later_bend)
    kept = least_distance(u_1, now, path, other, ROW)
    found = supervised_twist(u_1, u_2, now, later_bend, other, NONE_AHEAD, ROW)
    slower = supervised_twist(u_1, u_2, now, later_bend, other, NONE_AHEAD, SLOW_ROW)
    assert slower[0] <= u_1
    if kept >= ROW.distance:
        assert found == slower == (u_1, u_2)
    elif found[0] > u_1:
        assert found[1] == 0.0
        assert found[0] <= SUPERVISOR.clearing_mm_s
        assert least_distance(found[0], now, Path(0.0, 0.0), other, ROW) >= kept
    elif found != (u_1, u_2):
        assert found[0] >= 0.0
        assert found == slower
        assert found[1] == pytest.approx(u_2 * found[0] / u_1, rel=1e-12)
        assert least_distance(found[0], now, path, other, ROW) >= min(ROW.distance, kept)


@untimed
@given(st.floats(10.0, 600.0), yaw_rates, bends, far, far, headings, speeds, yaw_rates)
def test_left_and_right_are_alike(u_1, u_2, bend, x, y, turn, v_1, v_2):
    other = Message(x, y, turn, v_1, v_2)
    found = supervised_twist(u_1, u_2, u_1, bend, other, NONE_AHEAD, ROW)
    mirrored = Message(-x, y, -turn, v_1, -v_2)
    again = supervised_twist(u_1, -u_2, u_1, -bend, mirrored, NONE_AHEAD, ROW)
    assert again == pytest.approx((found[0], -found[1]), abs=1e-6)


def test_a_robot_stops_before_one_that_stands_on_its_way():
    way, speed = 0.0, 400.0
    for _ in range(1500):
        standing = Message(0.0, 1500.0 - way, 0.0, 0.0, 0.0)
        wanted = supervised_twist(400.0, 0.0, speed, 0.0, standing, standing, ROW)[0]
        speed = max(speed - 2.0, min(wanted, speed + 2.0))
        way += 0.02 * speed
    assert speed < 1.0
    assert 1500.0 - way == pytest.approx(ROW.distance, abs=5.0)


def test_a_robot_in_the_middle_of_a_crossing_clears_it():
    """Another comes from the right in 2 s; standing would be hit, and so would slowing down."""
    coming = Message(800.0, 50.0, math.pi / 2, 400.0, 0.0)
    assert supervised_twist(20.0, 0.3, 150.0, 0.0, coming, NONE_AHEAD, ROW)[0] > 150.0
    assert supervised_twist(20.0, 0.3, 150.0, 0.0, coming, NONE_AHEAD, ROW)[1] == 0.0
    assert supervised_twist(20.0, 0.3, 150.0, 0.0, coming, NONE_AHEAD, SLOW_ROW)[0] <= 20.0
    blocked = Message(0.0, 300.0, 0.0, 0.0, 0.0)
    assert supervised_twist(20.0, 0.3, 150.0, 0.0, coming, blocked, ROW)[0] < 150.0


def test_the_other_robots_motion_is_dead_reckoned():
    """One that turns away is not met, though its tangent would be."""
    turning = Message(-500.0, 600.0, -math.pi / 2, 300.0, 0.9)
    straight = turning._replace(u_2=0.0)
    assert dead_reckoned(turning, 2.0).y > dead_reckoned(straight, 2.0).y + 200.0
    assert supervised_twist(300.0, 0.0, 300.0, 0.0, turning, NONE_AHEAD, ROW) == (300.0, 0.0)
    assert supervised_twist(300.0, 0.0, 300.0, 0.0, straight, NONE_AHEAD, ROW)[0] < 300.0


# The limiter


def limiter_file(folder, name="mine.yaml", **fields) -> str:
    path = folder / name
    path.write_text(yaml.safe_dump(fields))
    return str(path)


def test_the_preset_is_body_with_a_supervisor():
    body, supervised = load_limiter("body"), load_limiter("supervised")
    assert supervised.supervisor == Supervisor()
    assert supervised.model_copy(update={"supervisor": None}) == body


def test_a_limiter_takes_from_its_base_what_it_does_not_have(tmp_path):
    limiter_file(
        tmp_path, "first.yaml", limits={"yaw_rate_rad_s": 1.0, "cancel_slip": True}, lead_s=0.1
    )
    path = limiter_file(
        tmp_path, base="first.yaml", limits={"yaw_rate_rad_s": 2.0}, supervisor={"horizon_s": 2.0}
    )
    found = load_limiter(path)
    assert (found.limits.yaw_rate_rad_s, found.limits.cancel_slip, found.lead_s) == (2.0, True, 0.1)
    assert found.supervisor == Supervisor(horizon_s=2.0)


def test_the_hash_of_a_policy_covers_the_base(tmp_path):
    path = limiter_file(tmp_path, base="first.yaml", supervisor={})
    name, scenario, hashes = f"kanayama+ekf+{path}", load_scenario("infinity"), set()
    for lead_s in (0.02, 0.04):
        limiter_file(tmp_path, "first.yaml", lead_s=lead_s)
        hashes.add(policy_hash(name, fit_policy(name, scenario).policy))
    assert len(hashes) == 2


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"base": "bodi"}, "'bodi' is not one of approach, body"),
        ({"base": "no_such.yaml"}, "cannot read no_such.yaml"),
        ({"base": "supervised"}, "base 'supervised' has a base itself; one level is allowed"),
        ({"base": 3}, "base 3 must be a limiter's name or its file"),
        ({"supervisor": {"distance_mm": 0}}, r"supervisor\.distance_mm: "),
        ({"supervisor": {"clearing_mm_s": -1}}, r"supervisor\.clearing_mm_s: "),
        ({"supervisor": {"margin_mm": 1}}, r"supervisor\.margin_mm: unknown key"),
    ],
)
def test_a_bad_file_is_reported_in_one_line(tmp_path, fields, said):
    with pytest.raises(ValueError, match=rf"^[^\n]*{said}[^\n]*$"):
        load_limiter(limiter_file(tmp_path, **fields))


@pytest.mark.parametrize(
    "controller", ["kanayama:bounded", "reference:tuned", "sliding_mode:bounded"]
)
def test_a_supervised_system_asks_for_its_neighbour_and_needs_it(controller):
    name = f"{controller}+ekf-slip+supervised"
    scenario = load_scenario("infinity", robots=4)
    fitted = fit_policy(name, scenario)
    assert fitted.scenario.neighbour == Neighbour()
    assert set(fitted.overrides) == {"neighbour", "estimator", "broadcast_smoothing_s"}
    own = load_scenario("infinity", robots=4, neighbour={"range_mm": 900.0})
    assert fit_policy(name, own).scenario.neighbour == Neighbour(range_mm=900.0)
    path = {"type": "circle", "radius_mm": 800.0, "speed_mm_s": 200.0}
    refused = load_scenario({"trajectory": path, "neighbour": None})
    for given_to in (make_policy, fit_policy):
        with pytest.raises(ValueError, match="needs the scenario's field neighbour; it is None"):
            given_to(name, refused)


def test_a_search_may_start_from_a_law_with_a_supervisor():
    start = named_start("kanayama:bounded+ekf-slip+supervised").start
    assert start.limits_of_it == load_limiter("supervised")
    assert start.scenario_overrides["neighbour"] == Neighbour().model_dump()
    with pytest.raises(ValueError, match="a controller is searched without a supervisor"):
        named_start("reference:tuned+ekf-slip+supervised")


# Whole rows


@pytest.mark.parametrize("controller", ["feedback_linearisation:bounded", "reference:tuned"])
def test_nothing_changes_where_no_robot_comes_near(controller):
    scenario = load_scenario(
        "infinity", robots=5, horizon_s=20.0, plant="batch", disturbance="slip"
    )
    runs = []
    for limiter in ("body", "supervised"):
        policy, fitted, _ = fit_policy(f"{controller}+ekf-slip+{limiter}", scenario)
        runs.append(run_policy(fitted, policy, 10_000))
    for column, values in runs[0].columns.items():
        np.testing.assert_array_equal(values, runs[1][column], err_msg=column)


def test_nothing_changes_beyond_the_range():
    """Rows of eight touch with ``body``; out of range they do so with the supervisor, too, bit for bit."""
    scenario = load_scenario(
        "infinity", robots=8, horizon_s=40.0, plant="batch", neighbour={"range_mm": 1.0}
    )
    runs = [
        run_policy(scenario, fit_policy(f"{LAW}+{limiter}", scenario).policy, 10_000)
        for limiter in ("body", "supervised")
    ]
    assert runs[0].contact
    for column, values in runs[0].columns.items():
        np.testing.assert_array_equal(values, runs[1][column], err_msg=column)


@pytest.mark.parametrize(("source", "horizon_s"), [("infinity", 100.0), ("flower", 100.0)])
def test_a_row_of_eight_touches_none_and_closes_its_gaps_again(source, horizon_s):
    scenario = load_scenario(source, robots=8, horizon_s=horizon_s, plant="batch")
    policy, fitted, _ = fit_policy(f"{LAW}+supervised", scenario)
    for record in run_seeds(fitted, policy, range(10_000, 10_002), name="supervised"):
        assert not record.contact
        error = record["position_error_mm"]
        assert error.max() > 250.0  # it had to wait
        last = error[-round(5.0 / scenario.control_period_s) :]
        assert last.min(axis=0).max() < 20.0
