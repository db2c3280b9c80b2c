"""The video wrappers of both libraries; they need moviepy, of the extra ``view``."""

from pathlib import Path

import gymnasium
import pytest
from pettingzoo.utils import wrappers

import tlf_env

pytest.importorskip("moviepy")

STEPS = 25
FPS = 50.0  # one frame a control period: a video runs at the speed of the robots


def written(folder: Path) -> tuple[int, float, tuple[int, int]]:
    """Frames, frames per second and size (px) of the one video in a folder."""
    import imageio_ffmpeg

    (path,) = folder.iterdir()
    assert path.suffix == ".mp4"
    frames, _ = imageio_ffmpeg.count_frames_and_secs(str(path))
    reader = imageio_ffmpeg.read_frames(str(path))
    header = next(reader)
    reader.close()
    return frames, header["fps"], tuple(header["size"])


def test_gymnasium_records_a_frame_of_the_start_and_of_every_step(tmp_path: Path) -> None:
    folder = tmp_path / "videos"  # not there yet
    made = gymnasium.make("tlf_env/Infinity-v0", render_mode="rgb_array", horizon_s=STEPS / FPS)
    env = gymnasium.wrappers.RecordVideo(made, str(folder), disable_logger=True)
    env.reset(seed=0)
    height, width, _ = made.render().shape
    for _ in range(STEPS):
        env.step(0 * env.action_space.sample())
    env.close()
    assert written(folder) == (STEPS + 1, FPS, (width, height))


@pytest.mark.skipif(
    not hasattr(wrappers, "RecordVideoParallel"), reason="PettingZoo records videos from 1.27 on"
)
def test_pettingzoo_records_a_frame_of_the_start_and_of_every_step(tmp_path: Path) -> None:
    folder = tmp_path / "videos"  # not there yet
    made = tlf_env.parallel_env("flower", render_mode="rgb_array", horizon_s=STEPS / FPS)
    env = wrappers.RecordVideoParallel(made, str(folder))
    env.reset(seed=0)
    height, width, _ = made.render().shape
    while env.agents:
        env.step({agent: 0 * env.action_space(agent).sample() for agent in env.agents})
    env.close()
    assert written(folder) == (STEPS + 1, FPS, (width, height))
