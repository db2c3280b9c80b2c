"""Videos of runs, and the video wrappers of both libraries; they need moviepy, of the extra ``view``."""

from __future__ import annotations

import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from pettingzoo.utils import wrappers

import tlf_env
from baselines import cli
from baselines.commands.run import Wanted, run_command
from baselines.policies.registry import fit_policy
from baselines.runs.jobs import alone_in
from baselines.runs.recorded_film import film_of
from baselines.runs.run import run_policy
from baselines.runs.video import FORMATS, Film, check_video, status, write_video
from tlf_env.task.scenario import load_scenario

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


# --- videos of runs


def size_of(path: Path) -> tuple[int, float, tuple[int, int]]:
    """Frames, frames per second and size (px) of a video."""
    if path.suffix == ".gif":
        image = pytest.importorskip("PIL.Image").open(path)
        durations = []
        for k in range(image.n_frames):
            image.seek(k)
            durations.append(image.info["duration"])
        return image.n_frames, 1000 * len(durations) / sum(durations), image.size
    import imageio_ffmpeg

    frames, _ = imageio_ffmpeg.count_frames_and_secs(str(path))
    reader = imageio_ffmpeg.read_frames(str(path))
    header = next(reader)
    reader.close()
    return frames, header["fps"], tuple(header["size"])


def filmed(*policies: str, fps: float = 25.0, speed: float = 1.0, horizon_s: float = 2.0):
    films, records = [], []
    for name in policies:
        fitted = fit_policy(
            name, load_scenario("infinity", disturbance="slip", horizon_s=horizon_s)
        )
        films.append(Film(fps, speed))
        records.append(run_policy(fitted.scenario, fitted.policy, 0, watch=films[-1]))
    return films, records


@pytest.mark.parametrize("ending", FORMATS)
def test_a_run_writes_a_video_and_is_otherwise_the_same(
    ending: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["run", "infinity", "--disturbance", "slip", "--horizon-s", "2", "--no-figures"]
    video = tmp_path / "films" / f"run{ending}"
    cli.app([*words, "--out", str(tmp_path / "plain")], standalone_mode=False)
    more = ["--video", str(video), "--video-fps", "12.5", "--video-speed", "2"]
    cli.app([*words, "--out", str(tmp_path / "filmed"), *more], standalone_mode=False)
    assert str(video) in capsys.readouterr().out.replace("\n", "")
    frames, fps, size = size_of(video)
    assert (frames, size) == (13, (960, 720))  # 2 s in 1 s, and the start
    assert fps == pytest.approx(12.5, rel=0.03)
    plain, other = (np.load(tmp_path / name / "trajectory.npz") for name in ("plain", "filmed"))
    assert set(plain.files) == set(other.files)
    for name in plain.files:
        assert np.array_equal(plain[name], other[name], equal_nan=plain[name].dtype.kind == "f")
    assert [path.name for path in video.parent.iterdir()] == [video.name]


@pytest.mark.parametrize(("fps", "speed"), [(60.0, 1.0), (25.0, 1.0), (10.0, 4.0), (50.0, 0.5)])
def test_a_film_has_a_scene_for_every_frame(fps: float, speed: float) -> None:
    (film,), _ = filmed("reference", fps=fps, speed=speed)
    wanted_s = np.arange(len(film.scenes)) * speed / fps
    assert len(film.scenes) == int(2.0 / speed * fps + 1e-9) + 1
    assert np.abs(wanted_s - [scene.t_s for scene in film.scenes]).max() <= 0.01 + 1e-9


def test_films_stand_side_by_side_with_captions(tmp_path: Path) -> None:
    films, _ = filmed("reference:consistent", "reference", fps=10.0)
    films[1].scenes = films[1].scenes[:5]  # it keeps its last picture
    done: list[tuple[int, int]] = []
    path = write_video(
        films,
        tmp_path / "both.mp4",
        captions=("one", "other"),
        size_px=(320, 240),
        theme="dark",
        progress=lambda *at: done.append(at),
    )
    assert size_of(path) == (21, 10.0, (642, 240 + 58))
    assert done[-1] == (21, 21)


def test_what_killed_writers_have_left_is_removed(tmp_path: Path) -> None:
    """The folder of one that still writes stays, and so do those of other videos."""
    names = (".own.gif.abandon1", ".own.gif.inuse_12", ".other.gif.abandon1")
    for name in names:
        (tmp_path / name).mkdir()
        (tmp_path / name / "video.gif").write_bytes(b"GIF")
    (film,), _ = filmed("reference:linearised", fps=10.0, horizon_s=0.2)
    with alone_in(tmp_path / names[1]):
        write_video([film], tmp_path / "own.gif")
    found = {path.name for path in tmp_path.iterdir()}
    assert found == {"own.gif", *names[1:]}


def test_the_status_says_how_the_robots_do() -> None:
    (film,), _ = filmed("reference", horizon_s=0.1)
    scene = film.scenes[-1]
    assert status(scene)[1] is False
    lost = scene._replace(lost=np.array([False, True, True]), touched=np.array([True, True, False]))
    assert status(lost) == ("robots 1, 2 lost, robot 0 touched", True)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--video", "run.avi"], "must end in .mp4 or .gif"),
        (["--video", "run"], "must end in .mp4 or .gif"),
        (["--video", "run.mp4", "--video-fps", "0"], "frames per second 0 must be 1 to 100"),
        (["--video", "run.mp4", "--video-speed", "-1"], "speed -1 must be 0.01 to 100"),
    ],
)
def test_a_video_that_cannot_be_is_refused_in_one_line(
    more: list[str],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["tlf", "run", "infinity", *more])
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    assert stopped.value.code == cli.BAD_INPUT
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert message in lines[0]
    assert not list(tmp_path.iterdir())


def test_films_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    (film,), _ = filmed("reference", horizon_s=0.1)
    path = tmp_path / "run.mp4"
    with pytest.raises(ValueError, match="same fps and speed"):
        write_video([film, Film(10.0)], path)
    with pytest.raises(ValueError, match="1 films need as many captions, got 2"):
        write_video([film], path, captions=("a", "b"))
    with pytest.raises(ValueError, match=r"theme 'drak' is not one of light, dark; did you mean"):
        write_video([film], path, theme="drak")
    with pytest.raises(ValueError, match="a film without scenes"):
        write_video([Film()], path)


def test_without_moviepy_a_video_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ValueError, match=r"pip install 'tlf-env\[view\]'"):
        check_video(tmp_path / "run.mp4")


@pytest.mark.parametrize(
    ("task", "fields"),
    [
        ("infinity", {"disturbance": "slip", "time_gap_s": 1.0}),
        ("warehouse", {}),
        ("circle", {"robots": 1}),
    ],
)
def test_a_film_of_a_record_is_that_of_the_run(task, fields):
    fitted = fit_policy("reference", load_scenario(task, horizon_s=2.5, **fields))
    kept = Film(20.0, 1.5)
    record = run_policy(fitted.scenario, fitted.policy, 0, watch=kept)
    made = film_of(record, 20.0, 1.5)
    assert len(made.scenes) == len(kept.scenes) > 20
    for found, wanted in zip(made.scenes, kept.scenes, strict=True):
        for name in found._fields:
            one, other = getattr(found, name), getattr(wanted, name)
            if name == "objects":
                assert places(one) == places(other)
            else:
                # angles of wheels are integrals of their recorded speeds
                room = 0.05 if name.startswith("wheel") else 1e-9
                assert np.allclose(one, other, rtol=1e-9, atol=room, equal_nan=True), name


def places(shapes) -> list[tuple]:
    """Kind, radius and corners of shapes, whatever their order."""
    return sorted(
        (one.kind, round(one.radius_mm, 6), sorted(np.round(one.corners_mm, 6).tolist()))
        for one in shapes
    )


def test_recorded_runs_become_one_video(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for policy, out in (("reference", "one"), ("reference:consistent", "other")):
        chosen = load_scenario("circle", horizon_s=1.0)
        run_command(chosen, policy, 0, {}, Wanted(out=Path(out), figures=False), trust=False)
    words = ["tlf", "compare", "one", "other", "--video", "films/both.mp4", "--video-fps", "10"]
    monkeypatch.setattr(sys, "argv", words)
    cli.main()
    assert "Video: films/both.mp4" in capsys.readouterr().out
    frames, fps, (width, height) = written(tmp_path / "films")
    assert (frames, fps) == (11, 10.0)
    assert width > 1.5 * height


def test_a_comparison_refuses_a_wrong_video_before_it_writes(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for more, says in (
        (["--video", "x.avi"], ".mp4"),
        (["--video", "x.mp4", "--video-fps", "0"], "frames"),
    ):
        monkeypatch.setattr(sys, "argv", ["tlf", "compare", "one", "other", *more])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        assert ended.value.code == cli.BAD_INPUT
        assert says in capsys.readouterr().err
