"""What the commands share: ranges of seeds, failed runs, the recorded command, ``python -m baselines``."""

import subprocess
import sys

import numpy as np
import pytest

from baselines import ReferencePolicy
from baselines.runs.files import summary, write_mat, write_record
from baselines.runs.outcome import failed
from baselines.runs.provenance import command_line, installed_versions, versions
from baselines.runs.run import SEEDS_PER_BLOCK, run_policy, run_seeds, seed_blocks
from baselines.runs.seed_ranges import (
    CHOOSING_SEEDS,
    FIRST_TABLE_SEED,
    TRAINING_SEEDS,
    check_seeds,
)
from baselines.tables import metrics_table
from tlf_env.physics.world import MovingObstacle
from tlf_env.task.scenario import load_scenario


def test_the_ranges_of_seeds_follow_each_other():
    assert TRAINING_SEEDS[1] == CHOOSING_SEEDS[0]
    assert CHOOSING_SEEDS[1] == FIRST_TABLE_SEED


@pytest.mark.parametrize("allowed", [TRAINING_SEEDS, CHOOSING_SEEDS])
def test_a_range_of_seeds_must_lie_within_its_use(allowed):
    first, end = allowed
    check_seeds("seeds", allowed, allowed)
    check_seeds("seeds", (end - 1, end), allowed)
    with pytest.raises(ValueError, match=rf"^my seeds {end - 1} to {end} must lie within"):
        check_seeds("my seeds", (end - 1, end + 1), allowed)
    with pytest.raises(ValueError, match=r"20000 and above are for tables$"):
        check_seeds("seeds", (first - 1, end), allowed)
    with pytest.raises(ValueError, match=rf"seeds {first}:{first} must be FIRST:END"):
        check_seeds("seeds", (first, first), allowed)


@pytest.mark.parametrize(("lost", "touched"), [(False, False), (True, False), (False, True)])
def test_a_run_fails_if_a_robot_is_lost_or_touched(lost, touched):
    fine = {"lost": False, "touched": False}
    assert failed([fine, {"lost": lost, "touched": touched}, fine]) == (lost or touched)


def test_a_record_and_its_line_fail_alike():
    class Still:
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return 0 * observation[:, :2], state

    for horizon_s, fails in ((0.1, False), (10.0, True)):
        record = run_policy(load_scenario(horizon_s=horizon_s), Still())
        robots = record.metrics()
        assert failed(robots) == failed([robot._asdict() for robot in robots]) == fails


def test_blocks_hold_all_seeds_in_their_order():
    seeds = list(range(2 * SEEDS_PER_BLOCK + 3))
    blocks = list(seed_blocks(seeds))
    assert [len(block) for block in blocks] == [SEEDS_PER_BLOCK, SEEDS_PER_BLOCK, 3]
    assert [seed for block in blocks for seed in block] == seeds
    assert list(seed_blocks([])) == []


def test_the_recorded_command_leaves_out_where_it_ran():
    words = "bench --out here --seeds 1:2 --processes=3 --ray auto --workers 2 --no-figures"
    assert command_line(words.split()) == "tlf bench --seeds 1:2 --no-figures"


def test_only_installed_packages_have_a_version():
    assert list(installed_versions(("no-such-package", "numpy"))) == ["numpy"]
    assert list(versions())[:3] == ["python", "tlf-env", "numpy"]


@pytest.mark.parametrize("words", [["--help"], ["bench", "--help"]])
def test_the_package_is_the_command_line(words):
    command = [sys.executable, "-m", "baselines", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "Usage:" in done.stdout
    bad = subprocess.run(
        [*command[:3], "run", "no_such"], capture_output=True, text=True, check=False
    )
    assert bad.returncode == 2
    assert bad.stderr.startswith("tlf: scenario 'no_such'")


@pytest.mark.parametrize("count", [1, 2, 63, 64, 65, 72, 100, 127, 128, 129, 200])
def test_any_number_of_seeds_runs_side_by_side(count):
    """From 64 on, the engine's rows have unused places behind the last run."""
    scenario = load_scenario(
        "infinity", plant="batch", disturbance="slip", horizon_s=0.2, time_gap_s=0.1, preview_s=()
    )
    seeds = range(5, 5 + count)
    policy = ReferencePolicy(preview_s=())
    records = list(run_seeds(scenario, policy, seeds))
    assert [record.seed for record in records] == list(seeds)
    for record in (records[0], records[count // 2], records[-1]):
        alone = run_policy(scenario, policy, record.seed)
        assert record.metrics() == alone.metrics()
        for name, column in alone.columns.items():
            assert (record[name] == column).all(), name


# --- the world -------------------------------------------------------------------------------------

WALL = {"points_mm": [[-2000, 400], [2000, 400]]}
AHEAD = {
    "trajectory": {"type": "waypoints", "points": [[0, 0, 0], [1, 0, 100], [4, 0, 1000]]},
    "robots": 1,
    "horizon_s": 3.0,
    "disturbance": "none",
}


def run_ahead(world, **fields):
    return run_policy(load_scenario({**AHEAD, **fields, "world": world}), ReferencePolicy())


@pytest.mark.filterwarnings("ignore::tlf_env.task.warn.ReferenceWarning")
@pytest.mark.parametrize(
    ("world", "by"),
    [
        ({}, None),
        ({"walls": [WALL]}, "wall"),
        (
            {"obstacles": [{"shape": {"type": "circle", "radius_mm": 50}, "x_mm": 0, "y_mm": 400}]},
            "wall",
        ),
        (
            {
                "moving": [
                    {
                        "shape": {"type": "circle", "radius_mm": 50},
                        "points_mm": [[0, 400], [0, 390]],
                        "speed_mm_s": 1,
                    }
                ]
            },
            "obstacle",
        ),
        (
            {
                "pushables": [
                    {
                        "shape": {"type": "circle", "radius_mm": 50},
                        "x_mm": 0,
                        "y_mm": 400,
                        "mass_kg": 0.1,
                    }
                ]
            },
            None,
        ),
    ],
    ids=["nothing", "wall", "post", "moving", "pushed"],
)
def test_a_run_says_what_was_touched(world, by):
    record = run_ahead(world)
    (robot,) = record.metrics()
    assert (robot.touched, robot.touched_by) == (by is not None, by)
    assert record.contact == failed([robot]) == robot.touched
    assert summary(record)["robots"]["robot_0"]["touched_by"] == by
    (cell,) = metrics_table(record).columns[-1].cells
    parts = ["lost"] * robot.lost + [f"touched {by}"] * robot.touched
    assert cell == (", ".join(parts) or "held")


@pytest.mark.filterwarnings("ignore::tlf_env.task.warn.ReferenceWarning")
def test_runs_side_by_side_say_what_was_touched_too():
    fields = {**AHEAD, "plant": "batch", "horizon_s": 3.0, "preview_s": (), "robots": 2}
    scenario = load_scenario({**fields, "time_gap_s": 1.0, "world": {"walls": [WALL]}})
    policy = ReferencePolicy(preview_s=())
    for record in run_seeds(scenario, policy, range(3)):
        alone = run_policy(scenario, policy, record.seed)
        assert record.metrics() == alone.metrics()
        assert record.metrics()[0].touched_by == "wall"


MOVING = {
    "shape": {"type": "circle", "radius_mm": 50},
    "points_mm": [[600, 0], [600, 500]],
    "speed_mm_s": 100,
    "start_s": 1.0,
}
CRATE = {
    "shape": {"type": "box", "width_mm": 100, "length_mm": 100},
    "x_mm": 0,
    "y_mm": 200,
    "angle_rad": 0.5,
    "mass_kg": 0.1,
    "floor_friction": 0.1,
}


def test_a_record_has_the_poses_of_what_can_move(tmp_path):
    record = run_ahead({"moving": [MOVING], "pushables": [CRATE]})
    assert record.objects.shape == (len(record.t_s), 2, 3)
    pushed, moving = record.objects[:, 0], record.objects[:, 1]
    assert pushed[0].tolist() == [0.0, 200.0, 0.5]
    assert pushed[-1, 1] > 300.0
    course = MovingObstacle(**MOVING).course()
    wanted = [(*course.at(1.0 + t_s), 0.0) for t_s in record.t_s.tolist()]
    np.testing.assert_allclose(moving, wanted)
    write_record(record, tmp_path)
    with np.load(tmp_path / "trajectory.npz") as arrays:
        assert (arrays["objects"] == record.objects).all()
    write_mat(record, tmp_path)
    from scipy.io import loadmat

    assert (loadmat(tmp_path / "trajectory.mat")["objects"] == record.objects).all()


def test_without_things_that_move_a_record_is_as_before(tmp_path):
    record = run_ahead({"walls": [{"points_mm": [[900, 0], [900, 900]]}]})
    assert record.objects is None
    write_record(record, tmp_path)
    with np.load(tmp_path / "trajectory.npz") as arrays:
        assert set(arrays.files) == {
            "t_s",
            "leader_reference_mm",
            *record.columns,
            *record.signals,
            "lost_at_s",
            "touched_at_s",
            "touched_by",
        }
