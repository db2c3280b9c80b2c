"""Tasks for BenchMARL, which trains them with any of its algorithms for continuous actions.

>>> from baselines.benchmarl import FormationTask
>>> task = FormationTask.INFINITY.get_from_yaml()
>>> task.config["horizon_s"] = 20.0
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarl.environments import Task, TaskClass
from torchrl.data import Composite
from torchrl.envs import EnvBase, PettingZooWrapper

from baselines.torchrl import FormationBatchEnv
from tlf_env.common.presets import check_named_files, presets_folder
from tlf_env.envs.parallel import parallel_env


class FormationTaskClass(TaskClass):
    """A formation as BenchMARL sees it: one group, ``robot``, and the true state for central critics.

    ``config`` holds the arguments of :func:`tlf_env.parallel_env`. An invalid one is an error as there, when
    the environment is made.
    """

    def get_env_fun(
        self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any
    ) -> Callable[[], EnvBase]:
        """A function that makes the environment: on the plant ``batch`` one for all ``num_envs`` formations.

        On other plants it makes one formation, and BenchMARL calls it ``num_envs`` times.
        """
        arguments = dict(self.config)
        if arguments.get("plant") == "batch":
            arguments.pop("render_mode", None)
            return lambda: FormationBatchEnv(
                formations=num_envs, seed=seed, device=device, **arguments
            )
        return lambda: PettingZooWrapper(
            parallel_env(**arguments), return_state=True, seed=seed, device=device
        )

    def supports_continuous_actions(self) -> bool:
        """True: the actions are numbers from -1 to 1."""
        return True

    def supports_discrete_actions(self) -> bool:
        """False."""
        return False

    def has_render(self, env: EnvBase) -> bool:
        """Whether ``config`` asks for frames; the plant ``batch`` has none."""
        return self.config.get("plant") != "batch" and self.config.get("render_mode") == "rgb_array"

    def max_steps(self, env: EnvBase) -> int:
        """Control steps of an episode at most."""
        return parallel_env(**self.config).scenario.horizon_steps

    def group_map(self, env: EnvBase) -> dict[str, list[str]]:
        """All robots in one group."""
        return env.group_map

    def observation_spec(self, env: EnvBase) -> Composite:
        """The observations of the robots, as ``("robot", "observation")``."""
        return _entries(env, "observation")

    def info_spec(self, env: EnvBase) -> Composite | None:
        """The infos of the robots, as ``("robot", "info")``; None if ``config`` leaves them out."""
        return _entries(env, "info") or None

    def state_spec(self, env: EnvBase) -> Composite | None:
        """The true state of the formation, as ``"state"``."""
        return Composite({"state": env.full_observation_spec_unbatched["state"].clone()})

    def action_spec(self, env: EnvBase) -> Composite:
        """The actions of the robots, as ``("robot", "action")``."""
        return env.full_action_spec_unbatched

    def action_mask_spec(self, env: EnvBase) -> Composite | None:
        """None: every action is allowed at any time."""
        return None

    @staticmethod
    def env_name() -> str:
        """The name of the environment in BenchMARL's logs."""
        return "tlf_env"


class FormationTask(Task):
    """The tasks: the presets in ``configs/benchmarl``."""

    INFINITY = None
    FLOWER = None

    @staticmethod
    def associated_class() -> type[TaskClass]:
        """The class of the tasks."""
        return FormationTaskClass

    def get_from_yaml(self, path: str | None = None) -> TaskClass:
        """The task with the arguments in a YAML file; the shipped one if ``path`` is None.

        Raises
        ------
        ValueError
            for the argument ``trust``, as a file must not permit itself to run code, and for a file elsewhere.
        """
        shipped = presets_folder() / "benchmarl" / f"{self.name.lower()}.yaml"
        task = super().get_from_yaml(str(path or shipped))
        check_named_files(Path(path or shipped), dict(task.config))
        if "trust" in task.config:
            raise ValueError(
                f"{path}: trust must be left out; set it in Python: task.config['trust'] = True"
            )
        return task


def _entries(env: EnvBase, key: str) -> Composite:
    """The observation specs of one key, by group."""
    specs = env.full_observation_spec_unbatched
    return Composite(
        {
            group: Composite({key: specs[group, key].clone()}, shape=specs[group].shape)
            for group in env.group_map
            if key in specs[group].keys()  # noqa: SIM118 - `key in spec` tests a tensor, not a key
        }
    )
