"""The window in which a leader is driven by hand."""

from __future__ import annotations

from typing import Any

from baselines.live.drive import DriveSession, Hand
from baselines.live.window import HAND_KEYS, LiveWindow

DEAD_ZONE = 0.15  # of a stick
STICK_TURN, STICK_FORWARD = 0, 1  # axes of a gamepad's left stick
NOT_WHILE_DRIVING = ("up, down, slider",)

PLAY_KEYS = (
    ("up  w", "forward"),
    ("down  s", "brake"),
    ("left  a", "turn left"),
    ("right  d", "turn right"),
    ("gamepad", "left stick"),
    *(("slider", what) if keys in NOT_WHILE_DRIVING else (keys, what) for keys, what in HAND_KEYS),
)


class PlayWindow(LiveWindow):
    """A live window whose keys or gamepad drive the leader; as :class:`LiveWindow` otherwise."""

    keys = PLAY_KEYS
    session: DriveSession

    def __init__(self, session: DriveSession, **options: Any) -> None:
        self._pressed: set[int] = set()
        self._stick = {STICK_TURN: 0.0, STICK_FORWARD: 0.0}
        self._pads: list[Any] = []
        super().__init__(session, **options)
        self.pg.joystick.init()
        self.say("drive with the arrow keys, W A S D or a gamepad")

    def stage(self) -> dict[str, Any]:
        """The scenario's own path, as a guide."""
        return {"path_mm": self.session.guide_mm}

    def take(self, event: Any) -> None:
        """Take an event; keys that drive act while they are held."""
        pg = self.pg
        if event.type == pg.KEYUP:
            self._pressed.discard(event.key)
        elif event.type == pg.WINDOWFOCUSLOST:
            self._pressed.clear()
        elif event.type == pg.JOYDEVICEADDED:
            self._pads.append(pg.joystick.Joystick(event.device_index))
            self.say(f"gamepad: {self._pads[-1].get_name()}")
        elif event.type == pg.JOYAXISMOTION and event.axis in self._stick:
            value = float(event.value)
            self._stick[event.axis] = value if abs(value) > DEAD_ZONE else 0.0
        super().take(event)

    def take_key(self, event: Any) -> bool:
        """Take a key that is pressed: one that drives, or one of every live window."""
        if event.key in self._driving():
            self._pressed.add(event.key)
            self.controls.paused = False
            return True
        return super().take_key(event)

    def _driving(self) -> dict[int, Hand]:
        pg = self.pg
        return {
            pg.K_UP: Hand(1.0, 0.0),
            pg.K_w: Hand(1.0, 0.0),
            pg.K_DOWN: Hand(-1.0, 0.0),
            pg.K_s: Hand(-1.0, 0.0),
            pg.K_LEFT: Hand(0.0, 1.0),
            pg.K_a: Hand(0.0, 1.0),
            pg.K_RIGHT: Hand(0.0, -1.0),
            pg.K_d: Hand(0.0, -1.0),
        }

    def hand(self) -> Hand:
        """What the keys and the stick ask for now."""
        keys = self._driving()
        asked = [keys[key] for key in self._pressed]
        ahead = any(one.forward > 0 for one in asked) - any(one.forward < 0 for one in asked)
        left = any(one.left > 0 for one in asked) - any(one.left < 0 for one in asked)
        return Hand(
            max(-1.0, min(1.0, ahead - self._stick[STICK_FORWARD])),
            max(-1.0, min(1.0, left - self._stick[STICK_TURN])),
        )

    def advance(self, elapsed_s: float) -> None:
        """Simulate the control steps that are due, with the hand's wish."""
        self.session.drive.hand = self.hand()
        super().advance(elapsed_s)

    def after_steps(self) -> None:
        """Follow the leader once it leaves the picture."""
        x, y = self.renderer.px_of(float(self.scene.x_mm[0]), float(self.scene.y_mm[0]))
        width, height = self.renderer.size_px
        camera = self.renderer.camera
        if camera.follow is None and not (0 <= x <= width and 0 <= y <= height):
            camera.follow = 0

    def state(self) -> str:
        """How fast the leader is, and the episode."""
        return f"{self.session.drive.speed:.0f} mm/s   {super().state()}"
