"""The live window: an episode in real time, with controls for the view, the time and the episode itself."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from baselines.live.session import MOST_LEVEL, MOST_PUSH_N, Session
from tlf_env.common.errors import is_one_of, shown, suggestion
from tlf_env.rendering.controls import (
    LEFT_BUTTON,
    RIGHT_BUTTON,
    TIME_KEYS,
    VIEW_KEYS,
    Controls,
    character,
)
from tlf_env.rendering.drawing import mixed
from tlf_env.rendering.looks import THEMES
from tlf_env.rendering.overlay import LINE_PX, Overlay
from tlf_env.rendering.renderer import Renderer, import_pygame, stage_of
from tlf_env.rendering.scene import patches_of, scene_of

SIZE_PX = (1180, 820)
SMALLEST_PX = (560, 420)
HEAD_PX, BAR_PX, EDGE_PX = 40, 48, 16
TITLE_TEXT_PX, BAR_TEXT_PX = 22, 20
SLIDER_PX, KNOB_PX = 170, 8
FPS = 60
MOST_BUSY_S = 0.03  # of a frame, for simulating; a slower computer shows a slower episode
MESSAGE_S = 6.0
PUSH_N_PER_MM = 0.01
REACH_RADII = 1.5  # of a robot's outline: how near the mouse must be to take it
LEVEL_STEP = 0.1
HELD = ("+", "=", "-", ".")  # keys that act again while they are held, beside up and down
MENU_ROOM_PX = 70  # of a list beside its rows
MOST_LINE = 66  # characters beside a name in a list

HAND_KEYS = (
    ("p", "policy"),
    ("t", "disturbance"),
    ("r", "start again"),
    ("n", "next seed"),
    ("right click", "slippery patch"),
    ("shift + drag", "push a robot"),
    ("k", "push the followed robot"),
    ("up, down, slider", "level of the disturbance"),
    ("F12", "picture of the window"),
    ("q, Esc", "close"),
)


class Menu(NamedTuple):
    """A list to choose from."""

    title: str
    lines: Mapping[str, str]  # name: what it is
    choose: Callable[[str], None]
    at: int  # the marked row

    def moved(self, by: int) -> Menu:
        """With another row marked."""
        return self._replace(at=(self.at + by) % len(self.lines))


class LiveWindow:
    """A window in which a session runs; made, it is open.

    Parameters
    ----------
    session
        What runs.
    policies, disturbances
        Names to switch to while it runs, each with a line.
    theme
        ``light`` or ``dark``.
    size_px
        Width and height of the window.

    Raises
    ------
    ValueError
        in one line: without pygame, without a display, for an unknown theme.
    """

    keys: tuple[tuple[str, str], ...] = HAND_KEYS
    renderer: Renderer
    menu: Menu | None

    def __init__(
        self,
        session: Session,
        *,
        policies: Mapping[str, str] | None = None,
        disturbances: Mapping[str, str] | None = None,
        theme: str = "light",
        size_px: tuple[int, int] = SIZE_PX,
    ) -> None:
        if not is_one_of(theme, THEMES):
            near = suggestion(theme, THEMES)
            raise ValueError(f"theme {shown(theme)} is not one of {', '.join(THEMES)}{near}")
        self.pg = open_display(size_px)
        self.session = session
        self.theme = THEMES[theme]
        self.controls = Controls(self.pg, origin_px=(0, HEAD_PX))
        self.overlay = Overlay(self.pg, self.theme)
        self.open, self.menu, self.message = True, None, ""
        self._menu_plate: Any = None
        self._policies, self._disturbances = dict(policies or {}), dict(disturbances or {})
        self._message_until = 0.0
        self._due = 0.0  # control steps
        self._rate = 1.0  # what is reached of the wanted speed
        self._pushing: int | None = None  # robot that is being pushed with the mouse
        self._sliding = self._shift = False
        self._down: set[int] = set()  # keys that are held
        self._slider = self.pg.Rect(0, 0, 0, 0)
        self._size_px = size_px
        self._caption = ""
        self.begin()

    # The loop

    def run(self) -> None:
        """Show the session until the window is closed."""
        clock = self.pg.time.Clock()
        elapsed_s = 0.0
        while self.open:
            self.frame(elapsed_s)
            elapsed_s = clock.tick(FPS) / 1000.0
        self.pg.display.quit()

    def frame(self, elapsed_s: float) -> None:
        """Take the events, simulate what is due after ``elapsed_s`` of real time, and draw."""
        for event in self.pg.event.get():
            self.take(event)
        if self.open:
            self.advance(elapsed_s)
            self.draw()

    def begin(self) -> None:
        """Make the renderer anew, with the camera as it was."""
        camera = self.renderer.camera if hasattr(self, "renderer") else None
        stage = {**stage_of(self.session.formation), **self.stage()}
        self.renderer = Renderer(
            **stage, mode="rgb_array", theme=self.theme, size_px=self._picture_size()
        )
        self.renderer.camera = camera or self.renderer.camera
        self._due = 0.0
        self.scene = scene_of(self.session.formation)
        self.renderer.paint(self.scene)

    def stage(self) -> dict[str, Any]:
        """What the renderer shows otherwise than the formation says."""
        return {}

    def advance(self, elapsed_s: float) -> None:
        """Simulate the control steps that are due."""
        session, controls = self.session, self.controls
        if controls.paused:
            steps, controls.steps = controls.steps, 0
        else:
            self._due += elapsed_s * controls.speed / session.scenario.control_period_s
            steps = int(self._due + 1e-9)
            self._due -= steps
        began, done = time.perf_counter(), 0
        while done < steps and not session.ended:
            if not self._attempt(session.step):
                controls.paused = True
                break
            done += 1
            if time.perf_counter() - began > MOST_BUSY_S and not controls.paused:
                break
        if steps and not controls.paused and not session.ended:
            self._rate += 0.1 * (done / steps - self._rate)
        if done:
            self.scene = scene_of(session.formation)
            self.after_steps()

    def after_steps(self) -> None:
        """Called after steps, before the picture."""

    # Events

    def take(self, event: Any) -> None:
        """Take an event of the window, the keys or the mouse."""
        pg = self.pg
        if self._repeats(event):
            return
        if event.type == pg.QUIT:
            self.open = False
        elif event.type in (pg.VIDEORESIZE, pg.WINDOWRESIZED, pg.WINDOWSIZECHANGED):
            self._resize()
        elif event.type in (pg.KEYDOWN, pg.KEYUP) and event.key in (pg.K_LSHIFT, pg.K_RSHIFT):
            self._shift = event.type == pg.KEYDOWN
        elif event.type == pg.WINDOWFOCUSLOST:
            self._shift = False
        elif event.type == pg.KEYDOWN and event.key == pg.K_F12:
            self.say(f"picture: {self.save_picture()}")
        elif self.menu is not None:
            self._take_in_menu(event, self.menu)
        elif event.type == pg.KEYDOWN:
            if not self.take_key(event):
                self.controls.take(event, self.renderer)
        elif not self._take_mouse(event):
            self.controls.take(event, self.renderer)

    def _repeats(self, event: Any) -> bool:
        """Whether an event is that of a key which is held and acts only once."""
        pg = self.pg
        if event.type == pg.WINDOWFOCUSLOST:
            self._down.clear()
        elif event.type == pg.KEYUP:
            self._down.discard(event.key)
        elif event.type == pg.KEYDOWN and event.key:
            held = event.key in self._down
            self._down.add(event.key)
            return held and event.key not in (pg.K_UP, pg.K_DOWN) and character(event) not in HELD
        return False

    def take_key(self, event: Any) -> bool:
        """Take a key that is pressed, if it is not one of the view's; whether it was."""
        pg = self.pg
        match character(event):
            case "p":
                self._open_menu("Policy", self._policies, self.session.policy, self._use_policy)
            case "t":
                name = self.session.asked.disturbance.name
                self._open_menu("Disturbance", self._disturbances, name, self._use_disturbance)
            case "r":
                self._restart(self.session.restart, "started again")
            case "n":
                self._restart(self.session.next_seed, "next seed, from the start")
            case "k":
                self._kick()
            case "q":
                self.open = False
            case _:
                if event.key == pg.K_ESCAPE:
                    self.open = False
                elif event.key in (pg.K_UP, pg.K_DOWN):
                    step = LEVEL_STEP if event.key == pg.K_UP else -LEVEL_STEP
                    self._set_level(self.session.level + step)
                else:
                    return False
        return True

    def _take_mouse(self, event: Any) -> bool:
        pg = self.pg
        if event.type == pg.MOUSEBUTTONDOWN and event.button == LEFT_BUTTON:
            if self._slider.inflate(2 * KNOB_PX, 3 * KNOB_PX).collidepoint(event.pos):
                self._sliding = True
                self._slide(event.pos[0])
                return True
            if self._shift:
                self.controls.mouse_px = self.controls.in_picture(event.pos)
                self._pushing = self._robot_at(self.controls.mouse_px)
                if self._pushing is None:
                    self.say("shift + drag begins on a robot")
                return True
            return not self._in_picture(event.pos)
        if event.type == pg.MOUSEBUTTONDOWN and event.button == RIGHT_BUTTON:
            if self._in_picture(event.pos):
                self._drop_patch(self.controls.in_picture(event.pos))
            return True
        if event.type == pg.MOUSEMOTION and self._sliding:
            self._slide(event.pos[0])
            return True
        if event.type == pg.MOUSEBUTTONUP and event.button == LEFT_BUTTON:
            if self._pushing is not None:
                robot, self._pushing = self._pushing, None
                self._push(robot, *self._pull(robot))
                return True
            sliding, self._sliding = self._sliding, False
            return sliding
        return False

    def _in_picture(self, px: tuple[int, int]) -> bool:
        return HEAD_PX <= px[1] < self._size_px[1] - BAR_PX

    def _robot_at(self, px: tuple[int, int]) -> int | None:
        """The robot nearest to a px of the picture, if it is near."""
        x_mm, y_mm = self.renderer.place_mm(px)
        away = [
            math.hypot(x - x_mm, y - y_mm) / (REACH_RADII * robot.outline_radius_mm)
            for x, y, robot in zip(
                self.scene.x_mm, self.scene.y_mm, self.session.scenario.robot_models, strict=True
            )
        ]
        nearest = min(range(len(away)), key=away.__getitem__)
        return nearest if away[nearest] <= 1.0 else None

    def _pull(self, robot: int) -> tuple[float, float]:
        """The force of the push that the mouse draws, at most 8 N."""
        x_mm, y_mm = self.renderer.place_mm(self.controls.mouse_px)
        x_N = PUSH_N_PER_MM * (x_mm - float(self.scene.x_mm[robot]))
        y_N = PUSH_N_PER_MM * (y_mm - float(self.scene.y_mm[robot]))
        factor = min(1.0, MOST_PUSH_N / max(math.hypot(x_N, y_N), 1e-9))
        return factor * x_N, factor * y_N

    # Menus

    def _open_menu(
        self, title: str, lines: Mapping[str, str], now: str, choose: Callable[[str], None]
    ) -> None:
        if not lines:
            return
        names = list(lines)
        at = names.index(now) if now in names else 0
        self.menu = Menu(title, lines, choose, at)

    def _take_in_menu(self, event: Any, menu: Menu) -> None:
        pg = self.pg
        if event.type == pg.KEYDOWN:
            if event.key == pg.K_ESCAPE or character(event) in ("q", "p", "t"):
                self.menu = None
            elif event.key in (pg.K_UP, pg.K_DOWN):
                self.menu = menu.moved(1 if event.key == pg.K_DOWN else -1)
            elif event.key in (pg.K_RETURN, pg.K_KP_ENTER):
                self._choose(menu)
        elif event.type == pg.MOUSEWHEEL:
            self.menu = menu.moved(-event.y)
        elif event.type == pg.MOUSEBUTTONDOWN and event.button == LEFT_BUTTON:
            row = None
            if self._menu_plate is not None:
                shown = self._shown_rows(menu)
                row = self.overlay.row_at(self._menu_plate, event.pos, len(shown), title=True)
            self.menu = None if row is None else menu._replace(at=shown.start + row)
            if self.menu is not None:
                self._choose(self.menu)

    def _choose(self, menu: Menu) -> None:
        self.menu = None
        menu.choose(list(menu.lines)[menu.at])

    # What the controls do

    def say(self, text: str) -> None:
        """Show a message for some seconds."""
        self.message, self._message_until = text, time.perf_counter() + MESSAGE_S

    def _attempt(self, action: Callable[[], object]) -> bool:
        """Do something; a message if it does not fit. Whether it was done."""
        try:
            action()
        except (ValueError, OSError) as error:
            self.say(" ".join(str(error).split()))
            return False
        return True

    def _restart(self, restart: Callable[[], object], words: str) -> None:
        if self._attempt(restart):
            self.begin()
            self.say(words)

    def _use_policy(self, name: str) -> None:
        self._wait(f"loading {name} ...")
        self._restart(
            lambda: self.session.restart(policy=name),
            f"policy {name}: seed {self.session.seed} from its start",
        )
        if self.session.policy == name and self.session.asks_for:
            self.message += f"; it asks for {', '.join(self.session.asks_for)}"

    def _use_disturbance(self, name: str) -> None:
        self._wait(f"loading {name} ...")
        self._restart(
            lambda: self.session.use_disturbance(name),
            f"disturbance {name}: seed {self.session.seed} from its start",
        )

    def _wait(self, words: str) -> None:
        """Show a message before something that may take a moment."""
        self.say(words)
        self.draw()

    def _set_level(self, level: float) -> None:
        session = self.session
        level = min(max(round(level, 2), 0.0), MOST_LEVEL)
        fixed: list[str] = []
        if self._attempt(lambda: fixed.extend(session.set_level(level))):
            self.renderer.show_patches(patches_of(session.formation))
            words = f"level {level:g} of {session.scenario.disturbance.name}, at once"
            self.say(words + (f"; {', '.join(fixed)}: as at the start" if fixed else ""))

    def _slide(self, x_px: int) -> None:
        share = (x_px - self._slider.left) / max(self._slider.width, 1)
        self._set_level(round(MOST_LEVEL * share / 0.05) * 0.05)

    def _drop_patch(self, px: tuple[int, int]) -> None:
        place = self.renderer.place_mm(px)
        if self._attempt(lambda: self.session.drop_patch(*place)):
            self.renderer.show_patches(patches_of(self.session.formation))
            self.say("a slippery patch, at once")

    def _push(self, robot: int, x_N: float, y_N: float) -> None:
        if self._attempt(lambda: self.session.push(robot, x_N, y_N)):
            self.say(f"robot_{robot} is pushed with {math.hypot(x_N, y_N):.1f} N for 0.2 s")

    def _kick(self) -> None:
        """Push the robot that is followed, or else in the close-up, to its left."""
        robot = self.renderer.camera.follow
        robot = min(1, self.renderer.robots - 1) if robot is None else robot
        theta = float(self.scene.theta_rad[robot])
        force_N = 0.5 * MOST_PUSH_N
        self._push(robot, -force_N * math.cos(theta), -force_N * math.sin(theta))

    def save_picture(self) -> Path:
        """Save what the window shows as a PNG file in the current folder; its path."""
        number = 1
        while (path := Path(f"tlf-{number}.png")).exists():
            number += 1
        self.pg.image.save(self.pg.display.get_surface(), str(path))
        return path

    # Drawing

    def _picture_size(self) -> tuple[int, int]:
        return self._size_px[0], self._size_px[1] - HEAD_PX - BAR_PX

    def _resize(self) -> None:
        size_px = self.pg.display.get_window_size()
        if size_px != self._size_px and all(
            a >= b for a, b in zip(size_px, SMALLEST_PX, strict=True)
        ):
            self._size_px = size_px
            self.renderer.resize(self._picture_size())

    def title(self) -> str:
        """What runs."""
        session = self.session
        disturbance = session.scenario.disturbance.name
        return f"{session.scenario.name}, {session.policy}, {disturbance}, seed {session.seed}"

    def note(self) -> str:
        """What was changed by hand, if anything."""
        changes = self.session.changes
        return f"changed by hand: {', '.join(changes)}" if changes else ""

    def draw(self) -> None:
        """Draw the whole window."""
        pg = self.pg
        surface = pg.display.get_surface()
        surface.blit(self.renderer.paint(self.scene), (0, HEAD_PX))
        self._draw_push(surface)
        self._draw_head(surface)
        self._draw_bar(surface)
        if self.session.ended:
            middle = (surface.get_width() // 2, HEAD_PX + 40)
            end = f"end of the episode at {self.session.scenario.horizon_s:g} s"
            self.overlay.plate(surface, [[f"{end};  r: start again,  n: next seed"]], midtop=middle)
        right = surface.get_width() - EDGE_PX
        if self.controls.help:
            keys = (*self.keys, *TIME_KEYS, *VIEW_KEYS)
            self.overlay.plate(surface, keys, title="Keys", topright=(right, HEAD_PX + EDGE_PX))
        if self.menu is not None:
            self._draw_menu(surface, self.menu)
        pg.display.flip()

    def _draw_push(self, surface: Any) -> None:
        if self._pushing is None:
            return
        robot, theme = self._pushing, self.theme
        start = self.renderer.px_of(float(self.scene.x_mm[robot]), float(self.scene.y_mm[robot]))
        end = self.controls.mouse_px
        at = [(x, y + HEAD_PX) for x, y in (start, end)]
        self.pg.draw.line(surface, theme.alarm, *at, 3)
        self.pg.draw.circle(surface, theme.alarm, at[1], 5)
        force = f"{math.hypot(*self._pull(robot)):.1f} N"
        self.overlay.plate(surface, [[force]], bottomleft=(at[1][0] + 8, at[1][1] - 4))

    def _draw_head(self, surface: Any) -> None:
        theme, width = self.theme, surface.get_width()
        surface.fill(mixed(theme.floor, theme.ink, 0.07), (0, 0, width, HEAD_PX))
        title = self.overlay.text(self.title(), TITLE_TEXT_PX)
        middle = HEAD_PX // 2
        surface.blit(title, title.get_rect(midleft=(EDGE_PX, middle)))
        note = self.note()
        if note:
            image = self.overlay.text(note, BAR_TEXT_PX, theme.alarm)
            surface.blit(image, image.get_rect(midright=(width - EDGE_PX, middle)))
        caption = f"tlf: {self.title()}" + (f" ({note})" if note else "")
        if caption != self._caption:
            self._caption = caption
            self.pg.display.set_caption(caption)

    def state(self) -> str:
        """How fast the episode runs, in words."""
        controls = self.controls
        if self.session.ended:
            return "ended"
        if controls.paused:
            return "paused"
        reached = "" if self._rate > 0.9 else f" ({controls.speed * self._rate:.1f} reached)"
        return f"{controls.speed:g} × real time{reached}"

    def _draw_bar(self, surface: Any) -> None:
        pg, theme, text = self.pg, self.theme, self.overlay.text
        width, height = surface.get_size()
        bar = pg.Rect(0, height - BAR_PX, width, BAR_PX)
        surface.fill(mixed(theme.floor, theme.ink, 0.07), bar)
        x, y = EDGE_PX, bar.centery
        if self.controls.paused or self.session.ended:
            for left in (x, x + 8):
                surface.fill(theme.ink, (left, y - 7, 5, 14))
        else:
            pg.draw.polygon(surface, theme.ink, [(x, y - 8), (x, y + 8), (x + 13, y)])
        state = text(self.state(), BAR_TEXT_PX)
        surface.blit(state, state.get_rect(midleft=(x + 24, y)))
        right = width - EDGE_PX
        image = text("h: keys", BAR_TEXT_PX)
        right = surface.blit(image, image.get_rect(midright=(right, y))).left - 26
        self._slider = pg.Rect(right - SLIDER_PX, y - 2, SLIDER_PX, 4)
        left = self._draw_slider(surface)
        message = self.message if time.perf_counter() < self._message_until else ""
        if message:
            start = max(x + 24 + state.get_width() + 26, 200)
            image = text(message, BAR_TEXT_PX)
            room = pg.Rect(0, 0, max(left - 20 - start, 0), image.get_height())
            surface.blit(image, image.get_rect(midleft=(start, y)), room)

    def _draw_slider(self, surface: Any) -> int:
        """The level, and a knob to drag; the px at which its text begins."""
        pg, theme, slider = self.pg, self.theme, self._slider
        level = self.session.level
        pg.draw.rect(surface, mixed(theme.floor, theme.ink, 0.35), slider, border_radius=2)
        for whole in range(int(MOST_LEVEL) + 1):
            x = slider.left + slider.width * whole / MOST_LEVEL
            surface.fill(mixed(theme.floor, theme.ink, 0.5), (x - 1, slider.centery - 7, 2, 14))
        x = slider.left + slider.width * min(level, MOST_LEVEL) / MOST_LEVEL
        pg.draw.aacircle(surface, theme.ink, (x, slider.centery), KNOB_PX)
        pg.draw.aacircle(surface, theme.floor, (x, slider.centery), KNOB_PX - 3)
        image = self.overlay.text(f"level {level:.2f}", BAR_TEXT_PX)
        place = image.get_rect(midright=(slider.left - 16, slider.centery))
        return int(surface.blit(image, place).left)

    def _shown_rows(self, menu: Menu) -> range:
        """The rows of a list that fit into the window, with the marked one among them."""
        count = len(menu.lines)
        fit = min(max((self._size_px[1] - HEAD_PX - BAR_PX - MENU_ROOM_PX) // LINE_PX, 3), count)
        first = min(max(menu.at - fit // 2, 0), count - fit)
        return range(first, first + fit)

    def _draw_menu(self, surface: Any, menu: Menu) -> None:
        shown = self._shown_rows(menu)
        names = list(menu.lines)[shown.start : shown.stop]
        rows = [(name, shortened(menu.lines[name].replace("`", ""))) for name in names]
        self._menu_plate = self.overlay.plate(
            surface,
            rows,
            chosen=menu.at - shown.start,
            title=f"{menu.title}: up, down, Enter or click; Esc",
            center=(surface.get_width() // 2, HEAD_PX + self._picture_size()[1] // 2),
        )


def shortened(line: str) -> str:
    """A line that fits beside a name in a list."""
    return line if len(line) <= MOST_LINE else f"{line[: MOST_LINE - 3].rstrip()}..."


def open_display(size_px: tuple[int, int]) -> Any:
    """Open a window; the module pygame.

    Raises
    ------
    ValueError
        in one line, without pygame and without a display.
    """
    try:
        pg = import_pygame()
    except ImportError as error:
        raise ValueError(f"a live window needs pygame: {error}") from error
    try:
        pg.display.init()
        pg.display.set_mode(size_px, pg.RESIZABLE)
    except pg.error as error:
        raise ValueError(
            f"no window can be opened ({error}): there is no display, or DISPLAY is not set; "
            "`tlf run --video FILE.mp4` writes a video without one"
        ) from error
    pg.key.set_repeat(400, 60)
    return pg
