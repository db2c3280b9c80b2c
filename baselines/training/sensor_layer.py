"""The first layer of a network on raw sensors: fixed sums and differences of its readings, in fitting scales.

A position fix is several metres from the start, and what counts is a tenth of a millimetre between it and the
reference. A network whose inputs are the readings themselves does not learn to subtract them. This layer
subtracts them, and nothing else: it is linear and not trained. What the robot's heading, its speeds and its
errors in its own frame are, the layers after it have to find out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from baselines.data.episodes import entry_names
from baselines.policies.history import History
from tlf_env.task.actions import FULL_WHEEL_SPEED_RAD_S
from tlf_env.task.observation import SAMPLE_ENTRIES, SENSOR_TAIL_ENTRIES
from tlf_env.task.scenario import Scenario

FEATURE_LIMIT = 10.0  # features are clipped at ±10
ERROR_SCALES_MM = (3.0, 30.0, 300.0)
RATE_SCALES_MM_S = (4.0, 50.0)
SPEED_SCALES_MM_S, TURN_SCALES_RAD_S = (5.0, 100.0), (0.03, 0.5)
SPANS_S = (0.04, 0.12, 0.26)  # over which rates and means are taken, and over the whole history
START_S = 0.06  # the time in units of this is clipped soon: how full the history is
PLAIN = ("message_sin", "message_cos", "message_u_1", "message_u_2", "is_leader")
NEEDED = ("message_x", "message_y", "message_u_1", "message_u_2")


class SensorLayer(NamedTuple):
    """Features and what the wheels do if the robot drives the reference's twist.

    ``weight`` is (feature, input), before clipping at ±:data:`FEATURE_LIMIT`. ``twist`` are the columns of the
    reference's speed and yaw rate, and ``wheels`` (2, 2) makes wheel speed actions of them.
    """

    weight: np.ndarray
    twist: tuple[int, int]
    wheels: np.ndarray


def sensor_layer(scenario: Scenario, history: History) -> SensorLayer:
    """The layer for ``sensor`` observations with a history of single observations.

    Raises
    ------
    ValueError
        if the history is not one of single observations, or lacks entries that the layer needs.
    """
    readings = _Readings(scenario, history)
    rows = []
    for axis in "xy":
        errors = [readings.error(axis, ago) for ago in range(readings.count)]
        rows += [errors[0] / scale for scale in ERROR_SCALES_MM]
        for span in readings.spans(1):
            rate = readings.rate(errors[:span])
            rows += [rate / scale for scale in RATE_SCALES_MM_S]
    for kind, scales in (("speed", SPEED_SCALES_MM_S), ("turn", TURN_SCALES_RAD_S)):
        twists = [readings.twist_error(kind, ago) for ago in range(readings.count)]
        rows += [twists[0] / scale for scale in scales]
        rows += [np.mean(twists[1 : 1 + span], axis=0) / scales[0] for span in readings.spans(0)]
    rows += [readings.change(side) for side in "lr"]
    rows += [readings.plain(name) for name in PLAIN]
    rows.append(readings.one("time") / START_S)
    return SensorLayer(
        np.array(rows, dtype=np.float32),
        (readings.columns["message_u_1"], readings.columns["message_u_2"]),
        readings.wheels(),
    )


class _Readings:
    """Rows that take readings out of an input: the present observation and then the earlier ones, by name."""

    def __init__(self, scenario: Scenario, history: History) -> None:
        names = entry_names(scenario)
        kept = names if history.entries is None else list(history.entries)
        if scenario.observation != "sensor":
            raise ValueError(
                f"input sensor needs observation sensor, the scenario has {scenario.observation!r}"
            )
        if scenario.action != "wheel_speed":
            raise ValueError(
                f"input sensor needs action wheel_speed, the scenario has {scenario.action!r}"
            )
        if history.mean_of != 1 or history.observations < 2:
            raise ValueError(
                "input sensor needs a history of at least 2 observations with mean_of 1; it has "
                f"{history.observations} with mean_of {history.mean_of}"
            )
        lacking = [name for name in NEEDED if name not in kept]
        lacking += [
            f"{prefix}_0 or a later one"
            for prefix in SAMPLE_ENTRIES
            if not any(name.startswith(f"{prefix}_") for name in kept)
        ]
        if lacking:
            raise ValueError(f"input sensor: history.entries lacks {', '.join(lacking)}")
        self.columns = {name: place for place, name in enumerate(names)}
        self._kept = {name: len(names) + place for place, name in enumerate(kept)}
        self._entries, self._width = len(kept), len(names) + history.size(len(names))
        self._period_s, self._substeps = scenario.control_period_s, scenario.substeps
        robot = scenario.robot_models[0]
        self._radius, self._half = robot.wheel_radius_mm, robot.axle_width_mm / 2
        self.count = 1 + history.observations  # the present one and the earlier ones

    def spans(self, more: int) -> list[int]:
        """Numbers of observations in :data:`SPANS_S` and in all, each ``more`` than the steps between."""
        steps = [round(span / self._period_s) for span in SPANS_S]
        return [count + more for count in (*steps, self.count - 1) if count < self.count]

    def plain(self, name: str, ago: int = 0) -> np.ndarray:
        """An entry as it is in the observation of so many control steps ago."""
        row = np.zeros(self._width)
        place = self._kept[name] + (ago - 1) * self._entries if ago else self.columns[name]
        row[place] = 1.0
        return row

    def one(self, name: str, ago: int = 0) -> np.ndarray:
        """An entry in its unit."""
        prefix = name.rsplit("_", 1)[0]
        entry = SENSOR_TAIL_ENTRIES.get(name) or SAMPLE_ENTRIES[prefix]
        return self.plain(name, ago) * entry.scale

    def mean(self, prefix: str, ago: int) -> np.ndarray:
        """Mean of the samples of a control step, of those that the history keeps."""
        offered = self._kept if ago else self.columns
        names = [f"{prefix}_{k}" for k in range(self._substeps) if f"{prefix}_{k}" in offered]
        return np.mean([self.one(name, ago) for name in names], axis=0)

    def error(self, axis: str, ago: int) -> np.ndarray:
        """Mean position fix minus the reference, in the world's frame, mm."""
        return self.mean(f"fix_{axis}", ago) - self.one(f"message_{axis}", ago)

    def rate(self, errors: list[np.ndarray]) -> np.ndarray:
        """Slope of the straight line through errors, the newest first, mm/s."""
        time = -self._period_s * np.arange(len(errors))
        weight = (time - time.mean()) / np.square(time - time.mean()).sum()
        return np.tensordot(weight, np.array(errors), axes=1)

    def twist_error(self, kind: str, ago: int) -> np.ndarray:
        """Speed (mm/s) or yaw rate (rad/s) by the wheels minus the reference's."""
        left, right = (
            self.mean(f"step_{side}", ago) * self._substeps / self._period_s for side in "lr"
        )
        if kind == "speed":
            return self._radius * (left + right) / 2 - self.one("message_u_1", ago)
        return self._radius * (right - left) / (2 * self._half) - self.one("message_u_2", ago)

    def change(self, side: str) -> np.ndarray:
        """By how much a wheel turns farther in the second half of the last control step than in the first."""
        signs = np.where(np.arange(self._substeps) < self._substeps / 2, -1.0, 1.0)
        steps = [self.plain(f"step_{side}_{k}") for k in range(self._substeps)]
        return np.tensordot(signs, np.array(steps), axes=1)

    def wheels(self) -> np.ndarray:
        """Wheel speed actions (left, right) by entries of the reference's twist, (2, 2)."""
        forward, turn = (SENSOR_TAIL_ENTRIES[f"message_u_{i}"].scale for i in (1, 2))
        each = [[forward, -self._half * turn], [forward, self._half * turn]]
        return np.array(each) / (self._radius * FULL_WHEEL_SPEED_RAD_S)
