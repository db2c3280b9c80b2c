"""The families of disturbances: a picture of one draw of each knob, and what each does to the board's entries.

Writes ``docs/disturbances/FAMILY.png`` and the tables of ``docs/disturbances/FAMILY.md``.
``python docs/figures/make_families.py`` drives 16 seeds of each cell for 60 s on the batch plant; it takes
about half an hour and needs the extra ``figures``. ``--only FAMILY`` renews one family, ``--tables`` and
``--figures`` only its table or its picture.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from family_devices import draw_motors, draw_robots, draw_sensors
from family_outside import draw_floor, draw_grip, draw_slip
from make_board import DOCS
from make_limits import ENTRIES, SMOOTH, arguments, friction, noise, ramped, renew, sines, wet
from matplotlib.figure import Figure

from baselines.runs.seed_ranges import FIRST_TABLE_SEED
from baselines.runs.style import METADATA
from tlf_env.common.files import atomic
from tlf_env.task.scenario import load_scenario

FOLDER = DOCS / "disturbances"
DPI = 100
BAND = {"type": "band_limited", "correlation_s": 0.5}


DRAWINGS: dict[str, Callable[[Figure], None]] = {
    "slip": draw_slip,
    "grip": draw_grip,
    "floor": draw_floor,
    "motors": draw_motors,
    "sensors": draw_sensors,
    "robots": draw_robots,
}


def under(**groups: dict[str, Any]) -> dict[str, Any]:
    """A scenario's fields with a disturbance of some groups of channels."""
    return {"disturbance": groups}


def preset(name: str) -> dict[str, Any]:
    """A scenario's fields with a preset's disturbance."""
    return {"disturbance": name}


def pushed(force_N: float, torque_Nmm: float, correlation_s: float = 0.5) -> dict[str, Any]:
    """Band-limited forces along both axes and a torque, by their standard deviations."""
    band = BAND | {"correlation_s": correlation_s}
    force, torque = band | {"std": force_N}, band | {"std": torque_Nmm}
    return under(push={"x_N": force, "y_N": force, "torque_Nmm": torque})


def bumped(force_N: float) -> dict[str, Any]:
    """One push to the right of the world, 0.1 s long, after settling."""
    bump = {"type": "impulse", "value": force_N, "at_s": 30.0, "duration_s": 0.1}
    return under(push={"x_N": bump})


def gains(share: float) -> dict[str, Any]:
    """Torque gains drawn for each wheel and episode."""
    drawn = {"type": "uniform", "low": 1 - share, "high": 1 + share}
    return under(actuator={"torque_gain_l": drawn, "torque_gain_r": drawn})


def loaded(mass_kg: float, behind_mm: float) -> dict[str, Any]:
    """A payload whose inertia is that of a box of 100 × 70 mm."""
    inertia_kg_mm2 = mass_kg * (100**2 + 70**2) / 12
    return under(
        payload={"mass_kg": mass_kg, "behind_mm": behind_mm, "inertia_kg_mm2": inertia_kg_mm2}
    )


def jumping(most_mm: float) -> dict[str, Any]:
    """Fixes whose offset is drawn anew every 5 s."""
    drawn = {"type": "uniform", "low": -most_mm, "high": most_mm, "every_s": 5.0}
    return under(position={"bias_x_mm": drawn, "bias_y_mm": drawn})


def outage(duration_s: float) -> dict[str, Any]:
    """No fixes for a while, after settling."""
    gone = {"type": "impulse", "value": 1.0, "at_s": 30.0, "duration_s": duration_s}
    return under(position={"outage": gone})


def observed(bandwidth_rad_s: float) -> dict[str, Any]:
    """Wheel speeds from a velocity observer."""
    return {"wheel_loop": {"speed_observer_rad_s": bandwidth_rad_s}}


def mixed() -> dict[str, Any]:
    """The robots of the scenario ``mixed``."""
    return {"robots": [robot.model_dump() for robot in load_scenario("mixed").robot_models]}


# The rows of each family's table: fields of the scenario `infinity` by the text of the first cell.
FAMILIES: dict[str, dict[str, dict[str, Any]]] = {
    "slip": {
        "nominal": {},
        "ramps of 3 s": ramped(3.0),
        "ramps of 0.5 s": ramped(0.5),
        "ramps of 0.2 s: `slip-ramps`": preset("slip-ramps"),
        "ramps of 0.05 s": ramped(0.05),
        **{
            f"band-limited, {s:g} s": noise("band_limited", "correlation_s", s) for s in (10.0, 2.0)
        },
        "band-limited, 0.5 s: `slip-noise`": preset("slip-noise"),
        "band-limited, 0.1 s": noise("band_limited", "correlation_s", 0.1),
        **{f"sines of {f:g} Hz": sines(f) for f in (0.05, 0.15)},
        "sines of 0.3 Hz, random phases: `slip-sines`": preset("slip-sines"),
        **{f"sines of {f:g} Hz": sines(f) for f in (0.6, 1.0, 2.0)},
        "sine and noise: `swell`": preset("swell"),
        **{
            f"Ornstein–Uhlenbeck, {s:g} s": noise("ornstein_uhlenbeck", "time_constant_s", s)
            for s in (5.0, 1.5, 0.5, 0.1)
        },
        "steps every 3 s: `slip`": preset("slip"),
        "left wheel only, band-limited, 0.5 s": under(slip={"left_mm_s": BAND | {"std": 30.0}}),
        "right wheel only, band-limited, 0.5 s": under(slip={"right_mm_s": BAND | {"std": 30.0}}),
    },
    "grip": {
        "nominal": {},
        "friction × 0.6": friction(0.6),
        "friction × 0.5: `ice`": preset("ice"),
        "friction × 0.4": friction(0.4),
        "friction × 0.3": friction(0.3),
        **{
            f"friction × {scale:g}, start ramp of 6 s": friction(scale, **SMOOTH)
            for scale in (0.5, 0.4, 0.3)
        },
        "left × 0.6: `split-ice`": preset("split-ice"),
        "left × 0.5": under(tyre={"friction_left": 0.5}),
        "right × 0.6": under(tyre={"friction_right": 0.6}),
        "patches × 0.4: `patches`": preset("patches"),
        "patches × 0.3": wet(0.3),
        "creep 0.03": under(tyre={"creep": 0.03}),
        "creep 0.1: `creep`": preset("creep"),
        "creep 1": under(tyre={"creep": 1.0}),
    },
    "floor": {
        "nominal": {},
        "rolling resistance 0.001": under(floor={"rolling_resistance": 0.001}),
        "rolling resistance 0.004: `rolling`": preset("rolling"),
        "rolling resistance 0.008": under(floor={"rolling_resistance": 0.008}),
        "slope 0.002 rad": under(floor={"slope_rad": 0.002}),
        "slope 0.005 rad: `slope`": preset("slope"),
        "slope 0.005 rad, rising towards −x": under(
            floor={"slope_rad": 0.005, "uphill_rad": 1.5708}
        ),
        "slope 0.01 rad": under(floor={"slope_rad": 0.01}),
        "slope 0.003 rad, band-limited, 2 s": under(
            floor={"slope_rad": BAND | {"std": 0.003, "correlation_s": 2.0}}
        ),
        "pushes of 0.03 N, 2 N·mm, 0.5 s: `pushes`": preset("pushes"),
        "pushes of 0.03 N, 2 N·mm, 2 s": pushed(0.03, 2.0, 2.0),
        "pushes of 0.1 N": pushed(0.1, 0.0),
        "pushes of 5 N·mm": pushed(0.0, 5.0),
        "one push of 1 N for 0.1 s": bumped(1.0),
        "one push of 3 N for 0.1 s": bumped(3.0),
    },
    "motors": {
        "nominal": {},
        "torque gains 0.9 to 1.1": gains(0.1),
        "torque gains 0.8 to 1.2": gains(0.2),
        "dead time 1 ms": under(actuator={"dead_time_s": 0.001}),
        "dead time 2 ms": under(actuator={"dead_time_s": 0.002}),
        "dead time 5 ms": under(actuator={"dead_time_s": 0.005}),
        "computing delay 10 ms": under(actuator={"computing_delay_s": 0.01}),
        "computing delay 20 ms": under(actuator={"computing_delay_s": 0.02}),
        "gains, dead time, delay: `actuator`": preset("actuator"),
        "back-EMF 0.005 s/rad": under(actuator={"back_emf_s_rad": 0.005}),
        "back-EMF 0.01 s/rad": under(actuator={"back_emf_s_rad": 0.01}),
        "back-EMF 0.025 s/rad": under(actuator={"back_emf_s_rad": 0.025}),
        "back-EMF 0.025 s/rad, stall torque 2": under(
            actuator={"back_emf_s_rad": 0.025, "stall_torque": 2.0}
        ),
        "current limit × 0.95": under(actuator={"current_limit": 0.95}),
        "current limit × 0.9": under(actuator={"current_limit": 0.9}),
        "dead band 1 N·mm": under(actuator={"dead_band_Nmm": 1.0}),
        "dead band 3 N·mm": under(actuator={"dead_band_Nmm": 3.0}),
        "a small geared motor: `motor`": preset("motor"),
    },
    "sensors": {
        "nominal": {},
        "fixes without noise: `none`": preset("none"),
        "noise of 2 mm: `noise`": preset("noise"),
        "noise of 10 mm": under(position={"noise_std_mm": 10.0}),
        "fixes that jump by up to 10 mm every 5 s": jumping(10.0),
        "fixes at 100 Hz": under(position={"period_s": 0.01}),
        "fixes at 30 Hz": under(position={"period_s": 0.033}),
        "fixes at 10 Hz": under(position={"period_s": 0.1}),
        "fixes 10 ms late": under(position={"delay_s": 0.01}),
        "fixes 50 ms late": under(position={"delay_s": 0.05}),
        "fixes at 30 Hz, 50 ms late": under(position={"period_s": 0.033, "delay_s": 0.05}),
        "outage of 1 s at 30 s": outage(1.0),
        "outage of 5 s at 30 s": outage(5.0),
        "an outage of 1 s in every 20 s: `fixes-outage`": preset("fixes-outage"),
        "half of the fixes missing": under(position={"outage": 0.5}),
        "5 % outliers of 50 mm": under(position={"outlier_share": 0.05, "outlier_std_mm": 50.0}),
        "motion capture: `fixes-100hz`": preset("fixes-100hz"),
        "a camera: `fixes-camera`": preset("fixes-camera"),
        "ultra-wideband radio: `fixes-uwb`": preset("fixes-uwb"),
        "encoder noise of 0.0001 rad": under(encoder={"noise_std_rad": 1e-4}),
        "encoders of 4096 counts: `encoders-4096`": preset("encoders-4096"),
        "4096 counts, velocity observer of 80 rad/s": preset("encoders-4096") | observed(80.0),
        "encoders of 1024 counts: `encoders-1024`": preset("encoders-1024"),
        "1024 counts, velocity observer of 80 rad/s": preset("encoders-1024") | observed(80.0),
        "velocity observer of 80 rad/s alone": observed(80.0),
        "both radii 1 % too large": under(calibration={"radius_left": 1.01, "radius_right": 1.01}),
        "left radius 0.5 % too large": under(calibration={"radius_left": 1.005}),
        "axle 2 % too wide": under(calibration={"track": 1.02}),
        "radii and axle drawn: `calibration`": preset("calibration"),
        "motors and sensors, observer of 80 rad/s: `hardware`": preset("hardware") | observed(80.0),
    },
    "robots": {
        "nominal": {},
        "three different robots: `mixed`": mixed(),
        "0.15 kg above the centre of mass": loaded(0.15, 20.0),
        "0.15 kg, 40 mm behind the axle": loaded(0.15, 40.0),
        "0.3 kg above the centre of mass": loaded(0.3, 20.0),
        "a laser scanner: `payload`": preset("payload"),
        "start scatter 20 mm, 0.1 rad": under(
            start={"position_std_mm": 20.0, "heading_std_rad": 0.1}
        ),
        "start scatter 80 mm, 0.3 rad: `start`": preset("start"),
        "dropout 0.1": under(radio={"dropout": 0.1}),
        "dropout 0.5": under(radio={"dropout": 0.5}),
        "jitter 0.1 s": under(radio={"jitter_s": 0.1}),
        "jitter 0.5 s": under(radio={"jitter_s": 0.5}),
        "dropout 0.1, jitter 0.1 s: `radio`": preset("radio"),
    },
}


def draw(family: str) -> None:
    """Write the picture of a family."""
    figure = Figure(layout="constrained", facecolor="white")
    DRAWINGS[family](figure)
    with atomic(FOLDER / f"{family}.png", "wb") as file:
        figure.savefig(file, format="png", dpi=DPI, metadata=METADATA.get("png"))


def main() -> None:
    """Drive and write the tables, draw the pictures."""
    parser = arguments(__doc__)
    parser.add_argument("--only", default=",".join(FAMILIES), help="families, comma-separated")
    parser.add_argument("--tables", action="store_true", help="no pictures")
    parser.add_argument("--figures", action="store_true", help="no tables")
    options = parser.parse_args()
    seeds = range(FIRST_TABLE_SEED, FIRST_TABLE_SEED + options.seeds)
    for family in options.only.split(","):
        print(family, flush=True)
        if not options.tables:
            draw(family)
        if not options.figures:
            page, entries = FOLDER / f"{family}.md", options.entry or ENTRIES
            renew(page, "entries", FAMILIES[family], seeds, entries)


if __name__ == "__main__":
    main()
