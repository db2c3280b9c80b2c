"""The video wrappers of both libraries; they need moviepy."""

import gymnasium
import pytest

import tlf_env

pytest.importorskip("moviepy")


def test_gymnasium_records_a_video(tmp_path):
    made = gymnasium.make("tlf_env/Infinity-v0", render_mode="rgb_array", horizon_s=1.0)
    env = gymnasium.wrappers.RecordVideo(made, str(tmp_path), disable_logger=True)
    env.reset(seed=0)
    for _ in range(50):
        env.step(0 * env.action_space.sample())
    env.close()
    assert [path.suffix for path in tmp_path.iterdir()] == [".mp4"]


def test_pettingzoo_records_a_video(tmp_path):
    from pettingzoo.utils.wrappers import RecordVideoParallel

    made = tlf_env.parallel_env("flower", render_mode="rgb_array", horizon_s=1.0)
    env = RecordVideoParallel(made, str(tmp_path))
    env.reset(seed=0)
    while env.agents:
        env.step({agent: 0 * env.action_space(agent).sample() for agent in env.agents})
    env.close()
    assert [path.suffix for path in tmp_path.iterdir()] == [".mp4"]
