"""What ``make_generalisation.py`` drives: the entries, and the conditions that were in no training."""

from __future__ import annotations

from typing import Any, NamedTuple

from make_board import DOCS

from tlf_env.task.scenario import Scenario, load_scenario

HORIZON_S = 60.0
LATE_HORIZON_S = 100.0  # where the last robot sets out late: errors count from 40 s on
OWN_ROBOT = "examples/own_robot.yaml"
BASE = "linearised"  # beneath `residual`
LEARNED = ("residual", "from-nothing")
ENTRIES = {
    "consistent": "reference:consistent",
    "linearised": "reference:linearised",
    "adrc": "adrc:searched+ekf-gyro-smoothed+grip",
    "kanayama": "kanayama:searched+ekf-gyro-smoothed+grip",
    "residual": "residual",
    "from-nothing": "from-nothing",
}
CLASSICAL = tuple(name for name in ENTRIES if name not in LEARNED)
MIXTURE = "combined-medium"
ROW_GAP_S, ROW_SETTLE_S = 5.0, 10.0
ROW_HORIZON_S = 125.0  # the last of 20 robots sets out after 95 s, and errors count from 105 s on


class Cell(NamedTuple):
    """A condition. Every entry drives the same seeds in it."""

    table: str
    row: str  # its name in the table, without the disturbance
    source: str  # a task or a file
    disturbance: str
    level: float = 1.0
    fields: dict[str, Any] = {}
    most_seeds: int | None = None

    @property
    def disturbed(self) -> str:
        """The disturbance as the tables show it."""
        level = "" if self.level == 1.0 else f" × {self.level:g}"
        return f"{self.disturbance}{level}"

    @property
    def name(self) -> str:
        """The first cell of the row in the table."""
        if self.row == self.disturbed:
            preset, *level = self.row.split(" ", 1)
            return " ".join([f"`{preset}`", *level])
        return f"{self.row}, {self.disturbed}"


def scenario_of(cell: Cell) -> Scenario:
    """The scenario of a cell, as it is before an entry asks for its fields."""
    source = DOCS.parent / cell.source if cell.source == OWN_ROBOT else cell.source
    fields = {"plant": "batch", "horizon_s": HORIZON_S} | cell.fields
    return load_scenario(
        source, disturbance=cell.disturbance, disturbance_level=cell.level, **fields
    )


def both(table: str, row: str, source: str, **fields: Any) -> list[Cell]:
    """A condition without other disturbances, and under a mixture that both learned entries know."""
    return [Cell(table, row, source, name, fields=fields) for name in ("nominal", MIXTURE)]


def tasks() -> list[Cell]:
    """The shipped tasks of no training. The last three have things in the way."""
    hardware = Cell("tasks", "`infinity_hardware`", "infinity_hardware", "hardware")
    posts = Cell("tasks", "`slalom_posts`", "slalom_posts", "nominal")
    contact = [
        Cell("tasks", f"`{name}`", name, "nominal", fields={"plant": "pymunk"}, most_seeds=6)
        for name in ("warehouse", "crossing_traffic")
    ]
    return [
        *both("tasks", "`circle`", "circle"),
        *both("tasks", "`stop_and_go`", "stop_and_go"),
        *both("tasks", "`corridor`", "corridor", horizon_s=27.0),
        hardware,
        posts,
        *contact,
    ]


def counts() -> list[Cell]:
    """Other numbers of robots; the first and the last pair of rows were in the trainings."""
    return [
        *both("counts", "∞, 3 robots", "infinity"),
        *both("counts", "∞, 5 robots", "infinity", robots=5, horizon_s=LATE_HORIZON_S),
        *both("counts", "flower, 3 robots", "flower", robots=3),
        *both("counts", "flower, 5 robots", "flower"),
    ]


def gaps() -> list[Cell]:
    """Other time gaps on the ∞; all trainings have 5 s."""
    return [
        cell
        for gap_s, horizon_s in ((2.0, HORIZON_S), (3.0, HORIZON_S), (8.0, LATE_HORIZON_S))
        for cell in both("gaps", f"{gap_s:g} s", "infinity", time_gap_s=gap_s, horizon_s=horizon_s)
    ]


ROBOTS: dict[str, dict[str, Any]] = {
    "heavier, stronger motors": {
        "mass_kg": 1.6,
        "body_inertia_kg_mm2": 7500,
        "torque_limit_Nmm": 20,
    },
    "wider axle": {"axle_width_mm": 180},
    "larger wheels": {"wheel_radius_mm": 55, "wheel_inertia_kg_mm2": 78},
    "longer trail": {"castor_trail_mm": 25, "com_offset_mm": 22},
}
WEAK = {"torque_limit_Nmm": 12}


def robots() -> list[Cell]:
    """Other robots than the paper's, known to the controllers."""
    weak = "torque limit × 0.8"
    return [
        *both("robots", "`mixed`", "mixed"),
        *(
            cell
            for name, change in ROBOTS.items()
            for cell in both("robots", name, "infinity", robot=change)
        ),
        Cell("robots", weak, "infinity", "nominal", fields={"robot": WEAK}),
        *both("robots", f"{weak}, flower", "flower", robot=WEAK),
        *both("robots", "6 kg, `own_robot.yaml`", OWN_ROBOT),
    ]


UNSEEN = (
    "swell",
    "slip-sines",
    "pushes",
    "creep",
    "radio",
    "fixes-outage",
    "split-ice-right",
)
UNSEEN_WHOLE = ("rolling", "fixes-camera", "fixes-uwb")  # at their level only


def disturbances() -> list[Cell]:
    """Presets on the ∞ that were not in both trainings, at their level and at half of it."""
    levels = [(name, level) for name in UNSEEN for level in (1.0, 0.5)]
    levels += [(name, 1.0) for name in UNSEEN_WHOLE]
    cells = [Cell("disturbances", "", "infinity", name, level) for name, level in levels]
    return [cell._replace(row=cell.disturbed) for cell in cells]


def rows() -> list[Cell]:
    """Long rows on a circle that has room for them."""
    return [
        Cell(
            "rows",
            f"{count} robots",
            "long_circle",
            disturbance,
            fields={"robots": count, "horizon_s": ROW_HORIZON_S},
        )
        for count, disturbance in ((10, "nominal"), (20, "nominal"), (20, "pushes"))
    ]


CELLS = [*tasks(), *counts(), *gaps(), *robots(), *disturbances(), *rows()]
TABLES = tuple(dict.fromkeys(cell.table for cell in CELLS))
