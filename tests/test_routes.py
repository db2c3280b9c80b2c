"""Two routes to the same motion: the stack on board, and the stack in a policy that sees sensors only."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers import PAPERS
from stack_policy import StackPolicy

import tlf_env
from baselines import ReferencePolicy
from tlf_env.envs.parallel import FormationParallelEnv
from tlf_env.task.info import Info
from tlf_env.task.observation import Tracking, sensor_entries, tracking_entries

X, Y, THETA = (Info._fields.index(name) for name in ("x_mm", "y_mm", "theta_rad"))
FIX_SD_MM = 0.2**0.5
FIELDS: dict[str, Any] = {
    **PAPERS,
    "control_period_s": 0.001,
    "disturbance": "none",
    "end_on": (),
}

every_dtype = pytest.mark.parametrize(
    ("dtype", "within_mm"), [("float32", 0.01), ("float64", 1e-6)]
)


class Driven:
    """An environment and the policy that drives it, all rows of a step in one call."""

    def __init__(
        self, env: FormationParallelEnv, policy: Any, seed: int = 0, state: Any = None
    ) -> None:
        self.env, self._policy, self.state = env, policy, state
        self._start = np.ones(len(env.possible_agents), dtype=np.bool_)
        self.seen, _ = env.reset(seed=seed)

    def step(self) -> None:
        rows = np.stack([self.seen[agent] for agent in self.env.agents])
        actions, self.state = self._policy.predict(rows, self.state, self._start)
        self._start = np.zeros_like(self._start)
        self.seen, *_ = self.env.step(dict(zip(self.env.agents, actions, strict=True)))

    @property
    def poses(self) -> np.ndarray:
        """True (x, y, θ) of every robot."""
        return self.env.formation.arrays.infos[0][:, [X, Y, THETA]]


def on_board(task: str, **options: Any) -> Driven:
    options = FIELDS | options
    return Driven(tlf_env.parallel_env(task, **options), ReferencePolicy("consistent"))


def in_the_policy(task: str, **options: Any) -> Driven:
    options = FIELDS | options
    env = tlf_env.parallel_env(task, action="torque", observation="sensor", **options)
    return Driven(env, StackPolicy(env.scenario))


def largest_distance(a: Driven, b: Driven, seconds: float) -> np.ndarray:
    """Of every robot, over the run, mm."""
    largest = np.zeros(len(a.poses))
    for _ in range(round(seconds / a.env.scenario.control_period_s)):
        a.step()
        b.step()
        apart = np.hypot(*(a.poses - b.poses)[:, :2].T)
        largest = np.maximum(largest, apart)
    return largest


# On board, and in the policy


@every_dtype
@pytest.mark.parametrize("task", ["infinity", "flower"])
def test_both_routes_drive_the_same_way(task: str, dtype: str, within_mm: float) -> None:
    board, policy = on_board(task, dtype=dtype), in_the_policy(task, dtype=dtype)
    start = board.poses.copy()
    assert largest_distance(board, policy, seconds=10.0).max() < within_mm
    assert np.hypot(*(board.poses - start)[:, :2].T).min() > 100.0


def test_both_routes_drive_unlike_robots_the_same_way() -> None:
    other = {"axle_width_mm": 180, "wheel_radius_mm": 55, "wheel_inertia_kg_mm2": 78}
    board, policy = (
        route("infinity", dtype="float64", robots=[{}, other])
        for route in (on_board, in_the_policy)
    )
    assert largest_distance(board, policy, seconds=5.0).max() < 1e-6


@every_dtype
@pytest.mark.parametrize("task", ["infinity", "flower"])
@pytest.mark.slow
def test_both_routes_drive_the_same_way_to_the_end(task: str, dtype: str, within_mm: float) -> None:
    board, policy = on_board(task, dtype=dtype), in_the_policy(task, dtype=dtype)
    largest = largest_distance(board, policy, board.env.scenario.horizon_s)
    print(f"{task}, {dtype}: largest distance of each robot {largest} mm")
    assert largest.max() < within_mm
    assert board.env.formation.arrays.infos[0][:, 0].max() < 20.0  # position error: none is lost


def test_both_routes_agree_under_noise_too() -> None:
    board, policy = (
        route("infinity", dtype="float64", disturbance="nominal")
        for route in (on_board, in_the_policy)
    )
    assert largest_distance(board, policy, seconds=3.0).max() < 1e-6


def test_a_stack_starts_anew_where_an_episode_starts() -> None:
    env = tlf_env.parallel_env(
        "infinity", action="torque", observation="sensor", control_period_s=0.001, **PAPERS
    )
    policy = StackPolicy(env.scenario)
    poses, state = [], None
    for _ in range(2):
        driven = Driven(env, policy, seed=1, state=state)  # the second inherits the first's memory
        for _ in range(50):
            driven.step()
        state = driven.state
        poses.append(driven.poses.copy())
    np.testing.assert_array_equal(poses[0], poses[1])


@pytest.mark.parametrize("plant", ["pymunk", "kinematic"])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("gains", ["consistent", "printed"])
def test_a_residual_of_zero_is_the_reference_bitwise(plant: str, dtype: str, gains: str) -> None:
    options: dict[str, Any] = {"plant": plant, "dtype": dtype, "end_on": ()}
    reference = Driven(tlf_env.parallel_env("infinity", **options), ReferencePolicy(gains))
    residual = tlf_env.parallel_env("infinity", action="residual", residual_base=gains, **options)
    residual.reset(seed=0)
    still = {agent: np.zeros(2, dtype) for agent in residual.agents}
    entries = [i for i, name in enumerate(Tracking._fields) if not name.startswith("last_action")]
    for _ in range(400):
        reference.step()
        residual.step(still)
        a, b = reference.env.formation.arrays, residual.formation.arrays
        np.testing.assert_array_equal(a.rows("motion"), b.rows("motion"))
        np.testing.assert_array_equal(a.observations[..., entries], b.observations[..., entries])


# What `sensor` says


def physical(env: FormationParallelEnv, seen: dict[str, np.ndarray]) -> list[dict[str, float]]:
    """Each robot's observation in physical units, by the names of its entries."""
    scenario = env.scenario
    entries = (
        sensor_entries(scenario.substeps)
        if scenario.observation == "sensor"
        else tracking_entries(scenario.preview_s)
    )
    return [
        {
            name: value * entry.scale
            for (name, entry), value in zip(entries.items(), row.tolist(), strict=True)
        }
        for row in seen.values()
    ]


def samples_of(env: FormationParallelEnv, seen: dict[str, np.ndarray]) -> np.ndarray:
    """(sample, robot, 4): fixes in the world (mm) and increments (rad), oldest first."""
    rows = physical(env, seen)
    return np.array(
        [
            [
                (
                    row[f"fix_x_{k}"] + row["start_x"],
                    row[f"fix_y_{k}"] + row["start_y"],
                    row[f"step_l_{k}"],
                    row[f"step_r_{k}"],
                )
                for row in rows
            ]
            for k in range(env.scenario.substeps)
        ]
    )


def test_sensor_has_every_fix_of_every_millisecond_once() -> None:
    options: dict[str, Any] = {
        "action": "torque",
        "observation": "sensor",
        "dtype": "float64",
        "end_on": (),
    }
    every_20_ms = tlf_env.parallel_env("infinity", control_period_s=0.02, **options)
    every_ms = tlf_env.parallel_env("infinity", control_period_s=0.001, **options)
    torque = {agent: np.array([0.8, 0.75]) for agent in every_ms.possible_agents}
    for env in (every_20_ms, every_ms):
        seen, _ = env.reset(seed=7)
        assert not samples_of(env, seen)[..., 2:].any()  # at the start there is no sample yet
    coarse, fine, kept = [], [], []
    for _ in range(50):
        seen, *_ = every_20_ms.step(torque)
        coarse.append(samples_of(every_20_ms, seen))
        kept.append(every_20_ms.formation.arrays.samples[..., 0].transpose(0, 2, 1).copy())
        for _ in range(20):
            seen, *_ = every_ms.step(torque)
            fine.append(samples_of(every_ms, seen))
    assert coarse[0].shape == (20, 3, 4)
    read = np.concatenate(coarse)
    np.testing.assert_allclose(read, np.concatenate(kept)[..., :4], atol=1e-9)
    np.testing.assert_allclose(read, np.concatenate(fine), atol=1e-9)
    for robot in range(3):
        assert len(np.unique(read[:, robot, 0])) == len(read)
    wheels = read[..., 2:].sum(axis=0)
    motions = every_20_ms.formation.arrays.rows("motion")[-2:, :, 0].T
    np.testing.assert_allclose(wheels, motions, atol=1e-9)


def test_fixes_scatter_about_the_truth() -> None:
    env = tlf_env.parallel_env("infinity", action="torque", observation="sensor", dtype="float64")
    seen, infos = env.reset(seed=3)
    still = {agent: np.zeros(2) for agent in env.agents}
    off = []
    for _ in range(100):
        seen, _, _, _, infos = env.step(still)
        truth = [(info["x_mm"], info["y_mm"]) for info in infos.values()]
        off.append(samples_of(env, seen)[..., :2] - truth)
    errors = np.concatenate(off)  # robots stand: the truth of the step is that of every sample
    assert errors.std() == pytest.approx(FIX_SD_MM, rel=0.03)
    assert abs(errors.mean()) < 5 * FIX_SD_MM / errors.size**0.5
    across_robots = np.corrcoef(errors.reshape(len(errors), -1).T)
    assert np.abs(across_robots - np.eye(6)).max() < 0.12


def test_a_follower_hears_its_predecessor_as_it_was_one_gap_ago() -> None:
    env = tlf_env.parallel_env(
        "infinity",
        observation="sensor",
        dtype="float64",
        time_gap_s=0.4,
        preview_s=(0.2,),
        end_on=(),
        **PAPERS,
    )
    seen, infos = env.reset(seed=0)
    said = []  # (pose of the estimate, wheel odometry) of every robot at every step
    steps = tracking_entries(env.scenario.preview_s)
    scales = np.array([entry.scale for entry in steps.values()])
    u = [Tracking._fields.index(name) for name in ("odometry_u_1", "odometry_u_2")]
    turn = {agent: np.array([0.4, 0.1]) for agent in env.agents}
    for k in range(60):
        arrays = env.formation.arrays
        odometry = (arrays.observations[0] * scales)[:, u]
        said.append(np.hstack([arrays.rows("estimate")[:3, :, 0].T, odometry]))
        rows = physical(env, seen)
        old = said[max(k - 20, 0)]
        for r, row in enumerate(rows):
            heard = [
                row["message_x"] + row["start_x"],
                row["message_y"] + row["start_y"],
                np.arctan2(row["message_sin"], row["message_cos"]),
                row["message_u_1"],
                row["message_u_2"],
            ]
            if r > 0:
                np.testing.assert_allclose(heard, old[r - 1], atol=1e-9)
            else:
                reference = [infos["robot_0"][f"reference_{name}"] for name in ("x_mm", "y_mm")]
                np.testing.assert_allclose(heard[:2], reference, atol=1e-9)
            assert row["time"] == pytest.approx(k * 0.02)
            assert row["is_leader"] == float(r == 0)
        seen, _, _, _, infos = env.step(turn)
    assert said[-1][:, 3].min() > 50.0  # they do move


@pytest.mark.parametrize("task", ["infinity", "flower"])
def test_previews_are_the_later_references(task: str) -> None:
    env = tlf_env.parallel_env(
        task, dtype="float64", time_gap_s=1.0, preview_s=(0.0, 0.3, 1.0), end_on=()
    )
    driven = Driven(env, ReferencePolicy())
    predicted: dict[int, list[np.ndarray]] = {0: [], 15: [], 50: []}
    happened = []
    for _ in range(200):
        rows = physical(env, driven.seen)
        infos = env.formation.arrays.infos[0]
        reference = infos[:, [Info._fields.index(f"reference_{n}") for n in ("x_mm", "y_mm")]]
        heading = infos[:, Info._fields.index("reference_theta_rad")]
        twist = [[row["reference_u_1"], row["reference_u_2"]] for row in rows]
        happened.append(np.column_stack([reference, np.sin(heading), np.cos(heading), twist]))
        for steps, name in ((0, "0"), (15, "0.3"), (50, "1")):
            foreseen = []
            for r, row in enumerate(rows):
                x, y, theta = env.formation.arrays.rows("estimate")[:3, r, 0]
                forward, right = row[f"forward_in_{name}_s"], row[f"right_in_{name}_s"]
                turn = np.arctan2(row[f"sin_turn_in_{name}_s"], row[f"cos_turn_in_{name}_s"])
                foreseen.append(
                    (
                        x - forward * np.sin(theta) + right * np.cos(theta),
                        y + forward * np.cos(theta) + right * np.sin(theta),
                        np.sin(theta + turn),
                        np.cos(theta + turn),
                        row[f"u_1_in_{name}_s"],
                        row[f"u_2_in_{name}_s"],
                    )
                )
            predicted[steps].append(np.array(foreseen))
        driven.step()
    for steps, foreseen in predicted.items():
        end = len(happened) - steps
        np.testing.assert_allclose(foreseen[:end], happened[steps:], atol=1e-8)
