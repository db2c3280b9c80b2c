"""Files of paths and of torques."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
from campaign.fuzzing.cases import changed, damaged
from campaign.fuzzing.checks import REFUSED, driven, finite, refused, small, working_folder
from campaign.fuzzing.registry import target
from hypothesis import strategies as st

from baselines.paths.read import read_log
from baselines.paths.retime import retimed, smoothed
from tlf_env.physics.openloop import load_scenarios, run_open_loop
from tlf_env.task.scenario import load_scenario
from tlf_env.task.waypoints import read_points

LOGS = [
    b"t_s,x_mm,y_mm\n0,0,0\n1,100,0\n2,200,50\n3,300,150\n4,300,150\n5,500,200\n",
    b"# log\ntime;x [m];y [m]\n0,0;0,0;0,0\n0,1;0,1;0,0\n0,2;0,2;0,05\n0,3;0,35;0,1\n",
    b"sec nanosec x y\n1 0 0 0\n1 500000000 1 0\n2 0 2 1\n2 500000000 3 1\n",
    b"\xef\xbb\xbftimestamp\tpose_x\tpose_y\r\n1e9\t0\t0\r\n1.0000001e9\t1\t0\r\n1.0000002e9\t2\t1\r\n",
]


@target(
    st.tuples(
        damaged(lambda: LOGS),
        st.sampled_from(
            [None, None, "1,2,3", "t_s,x_mm,y_mm", "sec+nanosec,x,y", "9,9,9", "a", "1+2,3,4"]
        ),
        st.sampled_from([None, "m", "mm", "cm", "km", "x"]),
    ),
    share=2.0,
)
def paths(case: Any) -> None:
    """Logs, and files of waypoints."""
    data, columns, units = case
    with working_folder() as folder:
        path = folder / "log.csv"
        path.write_bytes(data)
        refused(lambda: read_points(path))
        found = refused(lambda: load_scenario(path))
        if found is not REFUSED and small(found):
            driven(found, steps=1)
        log = refused(lambda: read_log(path, columns, units))
        if log is not REFUSED:
            finite("times of a log", log.t_s)
            finite("places of a log", log.xy_mm)
            for noise in (0.0, 5.0):
                made = refused(lambda: smoothed(log, noise))
                if made is not REFUSED:
                    finite("smoothed times and places", np.column_stack(made[:2]))
            again = refused(lambda: retimed(log.xy_mm, 400.0))
            if again is not REFUSED:
                finite("times and places anew", np.column_stack(again))


TORQUES: list[Any] = [
    {
        "roll": {
            "duration_s": 0.2,
            "start": {"x_mm": 1.0, "theta_rad": 0.5, "castor_rad": 0.1, "forward_mm_s": 100.0},
            "inputs": [
                {"torque_l_Nmm": 1.0, "torque_r_Nmm": 1.0, "from_s": 0.0},
                {"torque_l_Nmm": -1.0, "torque_r_Nmm": 2.0, "from_s": 0.1},
            ],
            "joint_friction": True,
        }
    }
]


@target(
    st.tuples(
        changed(lambda: TORQUES, most=4),
        st.sampled_from(["kernel", "kernel", "chipmunk", "x"]),
        st.sampled_from([0.001, 0.1, 0.0005, 0.003, 0.0, -1.0, math.nan]),
    ),
    share=1.5,
)
def open_loops(case: Any) -> None:
    """Files of torques, run."""
    data, plant, dt_s = case
    with working_folder() as folder:
        path = folder / "open.json"
        path.write_text(json.dumps(data))
        found = refused(lambda: load_scenarios(path))
        if found is REFUSED:
            return
        for one in found.values():
            if one.duration_s > 1.0:
                continue
            rows = refused(lambda: run_open_loop(one, dt_s=dt_s, plant=plant))
            if rows is not REFUSED:
                finite("rows of an open loop", rows)


@target(damaged(lambda: [json.dumps(one).encode() for one in TORQUES]), share=2.0)
def open_loop_files(case: bytes) -> None:
    """Bytes of files of torques."""
    with working_folder() as folder:
        (folder / "open.json").write_bytes(case)
        refused(lambda: load_scenarios(folder / "open.json"))
