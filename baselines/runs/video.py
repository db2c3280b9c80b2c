"""Videos of runs: scenes that are kept while a run goes, and their pictures as MP4 or GIF, side by side."""

from __future__ import annotations

import glob
import math
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from baselines.runs.jobs import alone_in
from tlf_env.common.errors import install_command, is_one_of, shown, suggestion
from tlf_env.engine.formation import Formation
from tlf_env.rendering.looks import THEMES, Theme
from tlf_env.rendering.renderer import DESIGN_SIZE_PX, Renderer, import_pygame, stage_of
from tlf_env.rendering.scene import Scene, scene_of

FORMATS = (".mp4", ".gif")
FPS, MOST_FPS = 25.0, 100.0
SPEEDS = (0.01, 100.0)  # least and most, of real time
SIDE_BY_SIDE_PX = (480, 400)  # of each picture of several
CAPTION_PX, CAPTION_TEXT_PX, STATUS_TEXT_PX, EDGE_PX = 58, 28, 22, 12
LINE_PX = 2  # between pictures
TEXT = 0.8  # least size of the pictures' own text, relative to the usual
MOST_COLUMNS = 3
GIF_COLOURS = 96
SAMPLES = 8  # pictures that the colours of a GIF are taken from
TICK_MS = 10  # durations in a GIF are multiples of it
QUALITY = ("-crf", "18", "-preset", "veryfast", "-movflags", "+faststart")


class Film:
    """The scenes of a run that a video shows: call it with the formation at the start and after every step.

    ``run_policy(..., watch=film)`` does so. It only reads.

    Parameters
    ----------
    fps
        Frames per second of the video.
    speed
        Of the video, relative to real time: at 2 a run of 60 s takes 30 s.

    Raises
    ------
    ValueError
        for values out of their range.
    """

    def __init__(self, fps: float = FPS, speed: float = 1.0) -> None:
        if not 1.0 <= fps <= MOST_FPS:
            raise ValueError(f"frames per second {fps:g} must be 1 to {MOST_FPS:g}")
        if not SPEEDS[0] <= speed <= SPEEDS[1]:
            raise ValueError(f"speed {speed:g} must be {SPEEDS[0]:g} to {SPEEDS[1]:g}")
        self.fps, self.speed = fps, speed
        self.scenes: list[Scene] = []  # one for each frame
        self._stage: dict[str, Any] = {}
        self._frames = 0  # up to the present step

    def __call__(self, formation: Formation) -> None:
        """Keep the present scene if a frame shows it: that of the nearest control step."""
        if not self.scenes:
            self._stage = stage_of(formation)
        frames = self.frames_at(formation.time_s, formation.scenario.control_period_s)
        if frames:
            self.scenes += [scene_of(formation)] * frames

    def frames_at(self, t_s: float, period_s: float) -> int:
        """How many frames more show the control step at a time, asked for the steps one after the other."""
        before = self._frames
        while self._frames * self.speed / self.fps < t_s + period_s / 2 - 1e-9:
            self._frames += 1
        return self._frames - before

    def keep(self, scenes: Sequence[Scene], **stage: Any) -> None:
        """Keep scenes that were recorded before, one for each frame.

        Parameters
        ----------
        stage
            What the renderer has to know, as of :func:`~tlf_env.rendering.renderer.stage_of`.
        """
        self.scenes, self._stage = list(scenes), stage

    def renderer(self, size_px: tuple[int, int], **options: Any) -> Renderer:
        """What draws the pictures.

        Raises
        ------
        ValueError
            without a scene.
        """
        if not self.scenes:
            raise ValueError("a film without scenes has no video")
        return Renderer(**self._stage, mode="rgb_array", size_px=size_px, **options)


def check_video(path: Path) -> None:
    """Check that a video can be written under a name: its format, and the packages for it.

    Raises
    ------
    ValueError
        in one line.
    """
    ending = path.suffix.lower()
    if ending not in FORMATS:
        near = suggestion(ending, FORMATS)
        raise ValueError(f"video {path} must end in {' or '.join(FORMATS)}{near}")
    if path.is_dir():
        raise ValueError(f"video {path} is a folder")
    try:
        import_pygame()
        _writer_of(ending)
    except ImportError as error:
        raise ValueError(f"a video needs pygame and moviepy: {install_command('view')}") from error


def write_video(
    films: Sequence[Film],
    path: Path,
    *,
    captions: Sequence[str] = (),
    size_px: tuple[int, int] | None = None,
    theme: str = "light",
    close_up: int | None = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write films side by side as one video; a film that ends earlier keeps its last picture.

    Nothing is shown on a display. The file appears under its name only when it is complete. What a killed
    writer of the same file has left is removed.

    Parameters
    ----------
    films
        At least one, all with the same ``fps`` and ``speed``.
    path
        ``.mp4`` or ``.gif``.
    captions
        A text above each picture, beside how the robots do; none: pictures alone, with their own text.
    size_px
        Width and height of each picture; 960 × 720 for a single one, smaller for several.
    theme
        ``light`` or ``dark``.
    close_up
        Number of the robot in the close-up; None: no close-up. Small pictures have none.
    progress
        Called with the frames done and their total.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    ValueError
        in one line, for a path, caption, theme or films that do not fit.
    """
    check_video(path)
    if not is_one_of(theme, THEMES):
        raise ValueError(
            f"theme {shown(theme)} is not one of {', '.join(THEMES)}{suggestion(theme, THEMES)}"
        )
    if not films or len({(film.fps, film.speed) for film in films}) > 1:
        raise ValueError("a video needs films of the same fps and speed")
    if captions and len(captions) != len(films):
        raise ValueError(f"{len(films)} films need as many captions, got {len(captions)}")
    size_px = size_px or (DESIGN_SIZE_PX if len(films) == 1 else SIDE_BY_SIDE_PX)
    total = max(len(film.scenes) for film in films)

    def frames(of: range, note: Callable[[int, int], None] | None = None) -> Iterator[np.ndarray]:
        page = _Page(films, captions, size_px, THEMES[theme], close_up)
        for number in range(total):
            picture = page.draw(number)
            if number in of:
                yield page.pixels(picture)
            if note is not None:
                note(number + 1, total)

    write = _writer_of(path.suffix.lower())
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_abandoned(path)
    with (
        tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder,
        alone_in(Path(folder)),
    ):
        unfinished = Path(folder) / f"video{path.suffix.lower()}"
        samples = range(0, total, max(total // SAMPLES, 1))
        write(unfinished, lambda: frames(samples), frames(range(total), progress), films[0].fps)
        unfinished.chmod(0o644)
        unfinished.replace(path)
    return path


def remove_abandoned(path: Path) -> None:
    """Remove the hidden folders of writers of a video that were killed: those that no process has locked."""
    for folder in path.parent.glob(f".{glob.escape(path.name)}.????????"):
        with suppress(ValueError, OSError), alone_in(folder):
            shutil.rmtree(folder)


Writer = Callable[[Path, Callable[[], Iterator[np.ndarray]], Iterator[np.ndarray], float], None]


def _writer_of(ending: str) -> Writer:
    """What writes a format: called with a path, some frames, all frames, and their number per second.

    Raises
    ------
    ImportError
        if the package for it is missing.
    """
    if ending == ".gif":
        import_module("PIL.Image")
        return _write_gif
    import_module("imageio_ffmpeg")
    return _write_mp4


def _write_mp4(
    path: Path, _: Callable[[], Iterator[np.ndarray]], frames: Iterator[np.ndarray], fps: float
) -> None:
    import imageio_ffmpeg

    writer = None
    for frame in frames:
        if writer is None:
            writer = imageio_ffmpeg.write_frames(
                str(path),
                (frame.shape[1], frame.shape[0]),
                fps=fps,
                codec="libx264",
                quality=None,
                macro_block_size=2,
                output_params=list(QUALITY),
                ffmpeg_log_level="error",
            )
            writer.send(None)
        writer.send(np.ascontiguousarray(frame))
    if writer is not None:
        writer.close()


def _write_gif(
    path: Path,
    samples: Callable[[], Iterator[np.ndarray]],
    frames: Iterator[np.ndarray],
    fps: float,
) -> None:
    """One table of colours for all frames, without dithering: what does not change costs nothing."""
    from PIL import Image

    plain = Image.Dither.NONE
    sheet = Image.fromarray(np.concatenate(list(samples())))
    table = sheet.quantize(GIF_COLOURS, method=Image.Quantize.MEDIANCUT, dither=plain)
    pictures = [Image.fromarray(frame).quantize(palette=table, dither=plain) for frame in frames]
    ends_ms = [round(1000 / fps * k / TICK_MS) * TICK_MS for k in range(len(pictures) + 1)]
    pictures[0].save(
        path,
        save_all=True,
        append_images=pictures[1:],
        duration=np.diff(ends_ms).tolist(),
        loop=0,
        optimize=True,
    )


class _Page:
    """The pictures of several films, with their captions."""

    def __init__(
        self,
        films: Sequence[Film],
        captions: Sequence[str],
        size_px: tuple[int, int],
        theme: Theme,
        close_up: int | None,
    ) -> None:
        self._pg = import_pygame()
        self._films, self._captions, self._theme = films, captions, theme
        self._renderers = [
            film.renderer(
                size_px, theme=theme, close_up=close_up, table=not captions, smallest_text=TEXT
            )
            for film in films
        ]
        self._painted: list[tuple[Scene, Any] | None] = [None] * len(films)
        self._head = CAPTION_PX if captions else 0
        columns = min(len(films), MOST_COLUMNS)
        rows = math.ceil(len(films) / columns)
        self._width, self._height = size_px[0] + LINE_PX, size_px[1] + self._head + LINE_PX
        self._columns = columns
        width, height = columns * self._width - LINE_PX, rows * self._height - LINE_PX
        self._surface = self._pg.Surface((width + width % 2, height + height % 2), 0, 32)
        self._fonts = [self._pg.font.Font(None, px) for px in (CAPTION_TEXT_PX, STATUS_TEXT_PX)]

    def draw(self, number: int) -> Any:
        """A frame, as a surface that the next one overwrites."""
        self._surface.fill(self._theme.path)
        for i, (film, renderer) in enumerate(zip(self._films, self._renderers, strict=True)):
            scene = film.scenes[min(number, len(film.scenes) - 1)]
            painted = self._painted[i]
            if painted is None or painted[0] is not scene:  # otherwise the picture is the same
                painted = self._painted[i] = scene, renderer.paint(scene)
            picture = painted[1]
            x, y = self._width * (i % self._columns), self._height * (i // self._columns)
            self._surface.blit(picture, (x, y + self._head))
            if self._captions:
                self._write(self._captions[i], scene, film.speed, (x, y), picture.get_width())
        return self._surface

    def _write(
        self, caption: str, scene: Scene, speed: float, at_px: tuple[int, int], width: int
    ) -> None:
        """Caption, time, and how the robots do."""
        theme, (large, small) = self._theme, self._fonts
        plate = self._pg.Rect(*at_px, width, self._head)
        self._surface.fill(theme.floor, plate)
        left, right = plate.left + EDGE_PX, plate.right - EDGE_PX
        top, bottom = plate.top + 9, plate.bottom - 6
        self._surface.blit(large.render(caption, True, theme.ink), (left, top))
        time = f"t = {scene.t_s:.1f} s"
        time = large.render(time, True, theme.ink)
        self._surface.blit(time, time.get_rect(topright=(right, top)))
        text, failed = status(scene)
        image = small.render(text, True, theme.alarm if failed else theme.ink)
        self._surface.blit(image, image.get_rect(bottomleft=(left, bottom)))
        if speed != 1.0:
            image = small.render(f"{speed:g} × real time", True, theme.ink)
            self._surface.blit(image, image.get_rect(bottomright=(right, bottom)))

    def pixels(self, surface: Any) -> np.ndarray:
        """A surface as an array ``(height, width, 3)``, uint8."""
        data = self._pg.image.tobytes(surface, "RGB")
        return np.frombuffer(data, np.uint8).reshape(surface.get_height(), surface.get_width(), 3)


def status(scene: Scene) -> tuple[str, bool]:
    """How the robots of a scene do, in words, and whether any is lost or has touched something."""
    lost = np.flatnonzero(scene.lost).tolist()
    touched = np.flatnonzero(scene.touched & ~scene.lost).tolist()
    texts = [
        f"{_robots(numbers)} {what}"
        for numbers, what in ((lost, "lost"), (touched, "touched"))
        if numbers
    ]
    if texts:
        return ", ".join(texts), True
    worst = float(np.nanmax(scene.position_error_mm)) if len(scene.position_error_mm) else 0.0
    return f"largest error {worst:.0f} mm", False


def _robots(numbers: Sequence[int]) -> str:
    return f"robot{'s' * (len(numbers) > 1)} {', '.join(map(str, numbers))}"
