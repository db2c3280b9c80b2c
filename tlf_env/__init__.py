"""Multi-agent environment of time-gap leader-follower control of wheeled robots with slip.

>>> import tlf_env
>>> env = tlf_env.parallel_env("infinity")
>>> observations, infos = env.reset(seed=0)
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium
import pettingzoo

if TYPE_CHECKING:
    from tlf_env.engine.batch import BatchPlant
    from tlf_env.engine.snapshot import Snapshot
    from tlf_env.envs.parallel import aec_env, parallel_env
    from tlf_env.onboard.parts import Estimated, Readings
    from tlf_env.task.info import EndReason, TouchedBy
    from tlf_env.task.scenario import Scenario, load_scenario

__version__ = "0.1.0"
__all__ = [
    "BatchPlant",
    "EndReason",
    "Estimated",
    "Readings",
    "Scenario",
    "Snapshot",
    "TouchedBy",
    "__version__",
    "aec_env",
    "load_scenario",
    "parallel_env",
]

_MODULES = {
    "BatchPlant": "tlf_env.engine.batch",
    "EndReason": "tlf_env.task.info",
    "Estimated": "tlf_env.onboard.parts",
    "Readings": "tlf_env.onboard.parts",
    "Snapshot": "tlf_env.engine.snapshot",
    "TouchedBy": "tlf_env.task.info",
    "aec_env": "tlf_env.envs.parallel",
    "parallel_env": "tlf_env.envs.parallel",
    "Scenario": "tlf_env.task.scenario",
    "load_scenario": "tlf_env.task.scenario",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(_MODULES[name]), name)


_PETTINGZOO_HAS_IDS = hasattr(pettingzoo, "register")  # from 1.27 on

# Written out, as reading the folder of presets would slow down every import.
TASKS = (
    "circle",
    "corridor",
    "crossing_traffic",
    "flower",
    "infinity",
    "infinity_from_rest",
    "infinity_hardware",
    "long_circle",
    "mixed",
    "slalom_posts",
    "stop_and_go",
    "warehouse",
)
for _task in TASKS:
    if _PETTINGZOO_HAS_IDS:
        for _kind in ("parallel", "aec"):
            pettingzoo.register(
                _kind,
                f"tlf_env/{_task}-v0",
                f"tlf_env.envs.parallel:{_kind}_env",
                kwargs={"scenario": _task},
            )
    gymnasium.register(
        f"tlf_env/{_task.title().replace('_', '')}-v0",
        "tlf_env.envs.single:FormationEnv",
        vector_entry_point="tlf_env.envs.vector:FormationVectorEnv",
        kwargs={"scenario": _task},
    )
