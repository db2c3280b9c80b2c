"""A page for each controller, law and learned policy: what it is, its gains, where it is on the board."""

from __future__ import annotations

import inspect
import json
from collections.abc import Iterator, Mapping
from typing import Any

import equations
from shared import READ, ROOT, Pages, board, cells, error, policies_of, policy_page, table

from baselines.commands.catalogue import ESTIMATOR_LINES, LEARNED_LINES
from baselines.policies.laws.catalogue import LAWS
from baselines.policies.laws.law import Memoryless
from baselines.policies.learned import shipped_policies
from tlf_env.common.presets import (
    first_sentence,
    preset_names,
    preset_summary,
    presets_folder,
    read_yaml,
)
from tlf_env.onboard.controllers import controller_names, load_controller
from tlf_env.onboard.kinds import DEFAULT_CONTROLLER

WEIGHTS = ROOT / "baselines" / "policies" / "weights"
TASKS = ("infinity", "flower")
LAW_OF = {
    "paper": "The law is the paper's, eqs (16), (19) and (21): "
    "[equation by equation](../equations.md#tracking-law).",
    "linearised": "The law is feedback linearisation of a point ahead of the axle: "
    "[its code](../equations.md#what-the-default-has-in-place-of-it).",
    "rejection": "The law is feedback linearisation of a point ahead of the axle, and an observer of the "
    "motion that the wheels do not explain: [systems](../systems.md#rivals).",
}

# The laws in short, with the errors e₁, e₂, e₃ of eq. (16) and the reference's twist u₁*, u₂*.
FORMULAS = {
    "pure_pursuit": r"""With the place (f, r) of the reference some time ahead, forward and right of the robot:

$$u_1 = u_1^* + k\,e_1, \qquad u_2 = -\frac{2 r}{f^2 + r^2}\,\lvert u_1\rvert$$""",
    "feedback_linearisation": r"""A point $b$ ahead of the axle can move in every direction.
Its error decays with $k$:

$$\begin{aligned}
v_1 &= u_1^*\cos e_3 - b\,u_2^*\sin e_3 + k\,(e_1 + b\,(\cos e_3 - 1)), & u_1 &= v_1\\
v_2 &= -u_1^*\sin e_3 - b\,u_2^*\cos e_3 + k\,(e_2 - b\sin e_3), & u_2 &= -v_2/b
\end{aligned}$$""",
    "kanayama": r"""$$u_1 = u_1^*\cos e_3 + k_x e_1, \qquad
u_2 = u_2^* + u_1^*\,(k_\theta\sin e_3 - k_y e_2)$$""",
    "lqr": r"""The corrections $v$ of the reference's twist are the linear feedback of the errors that
costs least over a horizon, with a gain $K$ that is computed anew in every step:

$$\dot e = A(t)\,e - B\,v, \qquad v = K(t)\,e, \qquad
\min \sum \Big(\frac{e_i}{\text{tolerance}}\Big)^2 + \Big(\frac{v_j}{\text{tolerance}}\Big)^2$$""",
    "sliding_mode": r"""With the surfaces $\sigma_1 = c\,e_3 - \operatorname{atan}(e_2/\ell)$ and
$\sigma_2 = e_1$, which a correction of bounded size reaches:

$$\dot\sigma_1 = -\eta_1\operatorname{sat}(\sigma_1/\varphi_1), \qquad
\dot\sigma_2 = -\eta_2\operatorname{sat}(\sigma_2/\varphi_2)$$""",
    "adrc": r"""Feedback linearisation, minus the motion $d$ that the wheels do not explain and an observer
estimates:

$$u_1 = v_1 - \hat d_1, \qquad u_2 = -v_2/b - \hat d_2$$""",
    "nmpc": r"""A plan of accelerations $a$ over the next second that costs least within the limits of the
robot; its first part is driven, and the next step improves the rest:

$$\min_a \sum \Big(\frac{\text{deviation}}{\text{tolerance}}\Big)^2 \quad\text{with}\quad
\lvert a_1\rvert, \lvert a_2\rvert, \lvert u_2\rvert, \lvert u_1 u_2\rvert \text{ bounded}$$""",
}


def flat(values: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """The values of nested mappings by their paths."""
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{before}{key}.")
        else:
            yield before + key, value


def standing(name: str, folder: str = "leaderboard") -> str:
    """Where the entries of a policy are on a board; empty if there are none."""
    mine = [one for one in policies_of(folder) if policy_page(one["policy"]) == name]
    if not mine:
        return ""
    entries = policies_of(folder)
    rows = []
    for one in mine:
        place = 1 + sum(other["failed"] < one["failed"] for other in entries)
        low, high = one["score"]["interval"]
        rows.append(
            (
                f"`{one['policy']}`",
                f"{place} of {len(entries)}",
                f"{one['failed']} of {one['runs']}",
                f"{one['score']['iqm']:.1f} [{low:.1f}, {high:.1f}]",
            )
        )
    heads = ("entry", "place by failed runs", "failed", "score, 0 to 100")
    return table(heads, rows, right=3)


def errors(name: str) -> str:
    """The errors of a policy's entries under the disturbances of the board."""
    mine = [one["policy"] for one in policies_of() if policy_page(one["policy"]) == name]
    if not mine:
        return ""
    found = {
        (cell["policy"], cell["task"], cell["disturbance"]): cell
        for policy in mine
        for cell in cells(policy=policy)
    }
    disturbances = dict.fromkeys(disturbance for _, _, disturbance in found)
    heads = ["disturbance"]
    for policy in mine:
        heads += [f"{task}, `{policy}`" if len(mine) > 1 else task for task in TASKS]
    rows = [
        (
            f"[{disturbance}](../presets/{disturbance}.md)",
            *(
                error(found[policy, task, disturbance])
                if (policy, task, disturbance) in found
                else "–"
                for policy in mine
                for task in TASKS
            ),
        )
        for disturbance in disturbances
    ]
    return READ + "\n\n" + table(heads, rows, right=len(heads) - 1)


def places(name: str) -> str:
    """The section on the boards."""
    main, alone = standing(name), standing(name, "leaderboard-controllers")
    text = "## On the board\n\n"
    if main:
        text += (
            f"{main}\nWhole systems, `{board()['command']}`: [leaderboard](../leaderboard.md).\n\n"
        )
    if alone:
        command = board("leaderboard-controllers")["command"]
        text += (
            f"{alone}\nControllers on one estimator and limiter, `{command}`: "
            "[controllers alone](../leaderboard-controllers.md).\n\n"
        )
    if not main and not alone:
        text += "No board has it by this name. " + NOT_THERE.get(name, "") + "\n\n"
    return text + errors(name)


NOT_THERE = {
    "reference-adrc.md": "It is the system `adrc:searched+ekf-gyro-smoothed+grip`, see [adrc](adrc.md).",
    "nmpc.md": "A board of it would take hours: [systems](../systems.md#the-default) has some of its numbers.",
}


def reference_page(name: str) -> str:
    """The page of a controller on board."""
    found = load_controller(name).controller
    path = presets_folder("controller") / f"{name}.yaml"
    file = path.read_text("utf-8")
    given = read_yaml(path)
    point = found.linearisation
    law = "paper" if point is None else "linearised" if point.rejection is None else "rejection"
    comment = " ".join(line.lstrip("# ") for line in file.splitlines() if line.startswith("#"))
    values = {key: value for key, value in given.items() if key != "found"}
    rows = [(f"`{key}`", value) for key, value in flat(values)]
    default = " It is the default." if name == DEFAULT_CONTROLLER else ""
    return f"""# reference:{name}

{comment}{default}

```sh
tlf run infinity --policy reference:{name} --disturbance slip-noise
```

## Law

{LAW_OF[law]} What the limits, the spacing and the lead do:
[limits and spacing](../controller/limits-and-spacing.md).

## Gains

{table(("field of the file", "value"), rows)}
A name ends in its unit. The file is `configs/controllers/{name}.yaml`; a file of your own with the key
`controller` is `--policy reference:FILE.yaml`.

{places(f"reference-{name}.md")}"""


def law_page(law: str) -> str:
    """The page of a law of a textbook or a rival."""
    kind, _ = LAWS[law]
    signature = inspect.signature(kind.__init__).parameters
    defaults = {
        name: one.default
        for name, one in signature.items()
        if name not in ("self", "preview_s", "rays", "neighbour", "bounds")
    }
    names = preset_names(law)
    presets = {name: read_yaml(presets_folder(law) / f"{name}.yaml") for name in names}
    fields = dict.fromkeys([*defaults, *(key for one in presets.values() for key in one)])
    rows = [
        (
            f"`{field}`",
            *(
                "–" if values.get(field) is None else values[field]
                for values in (defaults, *({**defaults, **one} for one in presets.values()))
            ),
        )
        for field in fields
        if field != "found"
    ]
    method = "twist" if issubclass(kind, Memoryless) else "step"
    path = kind.__module__.replace(".", "/") + ".py"
    said = "\n".join(f"- `{law}:{name}`: {preset_summary(law, name)}" for name in names)
    return f"""# {law}

{first_sentence(inspect.getdoc(kind) or "")}

```sh
tlf run infinity --policy {law}:searched+ekf-gyro-smoothed+grip --disturbance slip-noise
```

## Law

{FORMULAS[law]}

::: {kind.__module__}.{kind.__qualname__}
    options:
      show_root_heading: false
      show_root_toc_entry: false
      show_bases: false
      show_source: false
      members: []

## Code

`{path}`. The entries of `seen` are those of the [observation](../environment.md#observations) in their units.

```python
{equations.source(kind.__module__, f"{kind.__qualname__}.{method}")}
```

## Parameters

{table(("parameter", "default", *(f"`:{name}`" for name in names)), rows)}
Parameters that end in `_error_mm` bound the errors that the law sees
([why](../controller/limits-and-spacing.md)); – stands for none, or for a value that follows from the others.

{said}

{places(policy_page(law))}"""


def learned_page(name: str) -> str:
    """The page of a learned policy that is shipped."""
    card = json.loads((WEIGHTS / f"{name}.json").read_text("utf-8"))
    training = (presets_folder("training") / f"{name}.yaml").read_text("utf-8")
    network = card["network"]
    sizes = " × ".join(map(str, network["hidden"]))
    rows = [
        ("algorithm", card["algorithm"]),
        ("network", f"{sizes}, {network['activation']}"),
        ("observation", f"`{card['observation']}`, {len(card['entries'])} entries"),
        ("action", f"`{card['action']}`"),
        (
            "an action of 1",
            f"{card['action_scales'][0]:g} mm/s and {card['action_scales'][1]:g} rad/s",
        ),
        ("estimator", f"`{card['estimator']}`"),
        (
            "weights",
            f"`baselines/policies/weights/{name}.safetensors`, with the card `{name}.json`",
        ),
    ]
    return f"""# {name}

{LEARNED_LINES[name]}

```sh
tlf run infinity --policy {name} --disturbance slip-noise
tlf train {name} --seeds 0,1,2      # trains it again
```

## What it is

{table(("what", "value"), rows)}
What the action does, and what decided: [learning](../learning.md). It runs without torch.

![Score on the validation seeds and mean reward of the shipped trainings](../learning/curves.png)

## How it was trained

`configs/train/{name}.yaml`

```yaml
{training.rstrip()}
```

{places(f"{name}.md")}"""


def pages() -> Pages:
    """The pages of all policies, and their index."""
    found: Pages = {}
    rows: list[tuple[str, str, str, str]] = []

    def add(file: str, shown: str, line: str, text: str) -> None:
        found[f"policies/{file}"] = text
        mine = [one for one in policies_of() if policy_page(one["policy"]) == file]
        best = min(mine, key=lambda one: one["failed"], default=None)
        failed = "" if best is None else f"{best['failed']} of {best['runs']}"
        score = "" if best is None else f"{best['score']['iqm']:.1f}"
        rows.append((f"[`{shown}`]({file})", line, failed, score))

    for name in shipped_policies():
        add(f"{name}.md", name, LEARNED_LINES[name], learned_page(name))
    for name in controller_names():
        line = preset_summary("controller", name)
        add(f"reference-{name}.md", f"reference:{name}", line, reference_page(name))
    for law, (kind, _) in LAWS.items():
        add(f"{law}.md", law, first_sentence(inspect.getdoc(kind) or ""), law_page(law))
    heads = ("policy", "what", "failed", "score")
    estimators = table(
        ("estimator", "what"), [(f"`{name}`", line) for name, line in ESTIMATOR_LINES.items()]
    )
    limiters = table(
        ("limiter", "what"),
        [(f"`{name}`", preset_summary("limiter", name)) for name in preset_names("limiter")],
    )
    found["policies/index.md"] = f"""# Policies

A policy turns the observation of a robot into an action, 50 times a second. `tlf list policies` prints these.
*Failed* and *score* are those of the best entry on the [board](../leaderboard.md), over all 49 pairs of
task and disturbance; where they are empty, the board has no entry, and the page says where there are numbers.

{table(heads, rows, right=2)}
## Parts of a system

A law can be put on any estimator and behind any limiter: `CONTROLLER+ESTIMATOR+LIMITER`
([systems](../systems.md)).

{estimators}
{limiters}
What each estimator sees is [drawn here](../explained.md#what-an-estimator-sees); how they compare is
[measured here](../controller/estimators.md).
"""
    return found
