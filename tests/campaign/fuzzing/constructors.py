"""Arguments of everything that makes an environment."""

from __future__ import annotations

from typing import Any

from campaign.fuzzing.cases import anything, arrays, real
from campaign.fuzzing.checks import REFUSED, refused, small, working_folder
from campaign.fuzzing.registry import target
from campaign.fuzzing.scenarios import SHORT
from hypothesis import strategies as st

import tlf_env
from tlf_env.envs.single import FormationEnv
from tlf_env.envs.vector import FormationVectorEnv
from tlf_env.task.scenario import Scenario, load_scenario

ARGUMENTS: dict[str, Any] = {
    name: st.one_of(anything, arrays, st.fixed_dictionaries({"!": st.just("object")}))
    for name in (
        "scenario", "render_mode", "adversary", "infos", "learner", "others", "trust", "formations", "threads",
        "mixture", "staggered", "autoreset_mode", "max_episode_steps", "num_envs", "residual_base", "estimator",
        "wheel_loop", "observer", "disturbance_level", "no_such_field", *Scenario.model_fields,
    )
}  # fmt: skip


@target(
    st.tuples(
        st.sampled_from(
            [
                "parallel_env",
                "aec_env",
                "BatchPlant",
                "FormationEnv",
                "FormationVectorEnv",
                "load_scenario",
            ]
        ),
        st.lists(st.sampled_from(list(ARGUMENTS)), max_size=3, unique=True).flatmap(
            lambda names: st.fixed_dictionaries({name: ARGUMENTS[name] for name in names})
        ),
    ),
    share=1.5,
)
def constructors(case: Any) -> None:
    """Arguments of everything that makes an environment."""
    name, fields = case
    given = {key: real(value) for key, value in fields.items()}
    if isinstance(given.get("render_mode"), str) and given["render_mode"] == "human":
        return
    for key in ("formations", "num_envs", "threads", "robots"):
        if isinstance(given.get(key), int) and given[key] > 50:
            return
    made: Any = {"FormationEnv": FormationEnv, "FormationVectorEnv": FormationVectorEnv}.get(name)
    made = made or getattr(tlf_env, name)
    scenario = given.pop("scenario", "infinity")
    usual = {key: value for key, value in SHORT.items() if key not in given}
    if name == "load_scenario":
        refused(lambda: made(scenario, **usual, **given), TypeError)
        return
    if name == "BatchPlant":
        given.setdefault("formations", 1)
    with working_folder():
        checked = refused(
            lambda: load_scenario(
                scenario,
                **{
                    key: value
                    for key, value in {**usual, **given}.items()
                    if key in Scenario.model_fields
                },
            ),
            TypeError,
        )
        if isinstance(checked, Scenario) and not small(checked):
            return
        env = refused(lambda: made(scenario, **usual, **given), TypeError)
        if env is REFUSED or name in ("BatchPlant", "FormationVectorEnv"):
            return
        refused(lambda: env.reset(seed=0), ImportError, TypeError)
