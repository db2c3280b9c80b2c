"""Write the numbers of ``docs/performance.json`` into ``docs/performance.md`` and draw ``speed.svg``.

First run ``tlf speed --memory --cold --training --out docs/performance.json``, then
``python docs/figures/make_speed.py``. This needs the extra ``figures``.
"""

from __future__ import annotations

import json
from typing import Any

import matplotlib
from make_figures import BLUE, FOLDER, GREEN, GREY, ORANGE, STYLE
from matplotlib.figure import Figure

from baselines.speed.peers import (
    ALONE,
    JAXNAV,
    KHEPERAX,
    LEFT_OUT,
    MPE2,
    OURS,
    PEER_ROBOTS,
    PEERS,
    SPREAD,
    VECTOR,
    VMAS,
)
from tlf_env.common.files import atomic

DOCS = FOLDER.parent
# What is measured only if an option asks for it.
OPTIONAL = {"memory": "--memory", "starts": "--cold", "training": "--training"}
PART_NAMES = {
    "plant": "wheel loops and plant, 20 substeps",
    "onboard": "encoders, position fixes, EKF, 20 substeps",
    "actions": "actions, reference controller, search for near robots",
    "radio": "radio, observer, references",
    "observation_reward_info": "errors, reward, observation, info",
    "api": "Gymnasium interface: copying and naming arrays",
}


def rows_of(result: dict[str, Any], env: str, **fields: int) -> list[dict[str, Any]]:
    """Results of an environment, filtered by fields."""
    return [
        row
        for row in result["results"]
        if row["env"] == env and all(row[key] == value for key, value in fields.items())
    ]


def number(value: float) -> str:
    """A number with three significant digits and thousands separated by spaces."""
    digits = len(str(round(value)))
    return f"{round(value, min(0, 3 - digits)):,.0f}".replace(",", " ")


def table(head: list[str], rows: list[list[str]], names: int = 1) -> str:
    """A Markdown table; the first ``names`` columns are text, the others numbers."""
    line = "|" + "|".join(["---"] * names + ["---:"] * (len(head) - names)) + "|"
    first, *others = [f"| {' | '.join(row)} |" for row in (head, *rows)]
    return "\n".join([first, line, *others])


def ratio(result: dict[str, Any], to: str, **fields: Any) -> str:
    """The paired ratio of ours to a peer, with its spread."""
    for one in result["ratios"]:
        if one["to"] == to and all(one[key] == value for key, value in fields.items()):
            return f"{one['ratio']:.3g} × ({one['min']:.3g} … {one['max']:.3g})"
    return ""


def machine(result: dict[str, Any]) -> str:
    """The machine and the versions of the measurement."""
    about, found = result["machine"], result["versions"]
    versions = ", ".join(f"{name} {value}" for name, value in found.items())
    return (
        f"{about['processor']}, {about['cores']} cores, {about['system']}, load average "
        f"{about.get('load_average', 'unknown')} at the start; {versions}. "
        f"Medians of {result['repeats']} timings, smallest and largest in brackets."
    )


def speeds(result: dict[str, Any]) -> str:
    """Agent steps per second of all environments."""
    body = []
    special = {row["env"]: None for row in result["results"] if row["env"].startswith(f"{VECTOR},")}
    for env in (ALONE, VECTOR, *special, *PEERS):
        for row in rows_of(result, env):
            spread = (
                f"({number(row['min'] * row['robots'])} … {number(row['max'] * row['robots'])})"
            )
            body.append(
                [
                    f"`{VECTOR}`{env.removeprefix(VECTOR)}" if env in special else f"`{env}`",
                    str(row["robots"]),
                    str(row["formations"]),
                    str(row["threads"]),
                    number(row["env_steps_per_s"]),
                    f"{number(row['agent_steps_per_s'])} {spread}",
                ]
            )
    head = "environment|robots|formations|threads|formation steps/s|agent steps/s"
    return table(head.split("|"), body)


def ratios(result: dict[str, Any]) -> str:
    """Agent steps per second of ours for each of a peer's: three robots, one thread."""
    ours = {"robots": PEER_ROBOTS, "threads": 1}
    counts = sorted({row["formations"] for row in rows_of(result, VECTOR, **ours)})
    body = [
        [
            f"`{name}`",
            ratio(result, name, env=ALONE, formations=1, **ours),
            *(ratio(result, name, env=VECTOR, formations=count, **ours) for count in counts),
        ]
        for name in PEERS
        if rows_of(result, name)
    ]
    grouped = [f"{count:,}".replace(",", " ") for count in counts]
    return table(["ours to", "one, PettingZoo", *grouped], body)


def simulated(result: dict[str, Any]) -> str:
    """What each environment simulates."""
    body = [
        [
            f"`{name}`",
            ", ".join(map(str, (3, 5) if name in OURS else peer.robots)),
            peer.simulated.model,
            peer.simulated.step,
            peer.simulated.substeps,
            peer.simulated.sensors,
            peer.simulated.contacts,
            peer.simulated.controllers,
        ]
        for name, peer in {**OURS, **PEERS}.items()
    ]
    head = "environment|robots|model|a step|substeps|sensors|contacts|controllers on board"
    return table(head.split("|"), body, names=8)


def left_out(result: dict[str, Any]) -> str:
    """How each peer is installed, and which were not measured."""
    lines = [
        f"- `{name}`: `pip install {peer.install}`."
        + (
            f" Not measured here: {reason}."
            if (reason := result.get("left_out", {}).get(name))
            else ""
        )
        for name, peer in PEERS.items()
    ]
    return "\n".join([*lines, *(f"- Left out: {name}, {why}" for name, why in LEFT_OUT.items())])


def compiled(result: dict[str, Any]) -> str:
    """Processor time that a peer compiles for, over its numbers of formations."""
    found: dict[str, list[float]] = {}
    for row in result["compiled"]:
        if row["threads"] == 1:
            found.setdefault(row["env"], []).append(row["compile_s"])
    parts = [f"`{env}` {min(some):.1f} to {max(some):.1f} s" for env, some in found.items()]
    return f"Compiling, for each number of formations: {', '.join(parts) or 'no peer'}."


def not_measured(part: str) -> str:
    """What the page shows of a part that was not asked for."""
    return f"Not measured in this run (`tlf speed {OPTIONAL[part]}`)."


def footprint(result: dict[str, Any]) -> str:
    """Growth of the memory of a process with each formation."""
    if not result.get("memory"):
        return not_measured("memory")
    body = [
        [
            f"`{row['env']}`",
            str(row["robots"]),
            *(kilobytes(row[kind]) for kind in ("resident", "peak")),
        ]
        for row in result["memory"]
    ]
    few, many = result["memory"][0]["formations"]
    head = [f"{few} to {many} formations", "robots", "kB after the steps", "kB at most"]
    return table(head, body)


def kilobytes(value: float | None) -> str:
    """Bytes as kB."""
    return "" if value is None else f"{value / 1000:.1f}"


def starts(result: dict[str, Any]) -> str:
    """Processor time of a fresh process up to the end of its first step."""
    if not result.get("starts"):
        return not_measured("starts")
    caches = {"empty": ", nothing compiled", "full": ", all compiled before", None: ""}
    body = [
        [
            f"`{row['env']}`{caches[row['cache']]}",
            str(row["formations"]),
            f"{row['import_s']:.1f}",
            f"{row['first_step_s']:.1f}",
        ]
        for row in result["starts"]
    ]
    return table(["environment", "formations", "imports, s", "to the first step, s"], body)


def training(result: dict[str, Any]) -> str:
    """Time to a trained policy."""
    if not result.get("training"):
        return not_measured("training")
    row = result["training"]
    whole = f"{row['whole_s']:.0f} s of processor time, {row['whole_wall_s']:.0f} s on the clock"
    reached = (
        f"reached after {row['trained_s']:.0f} s, {number(row['robot_steps'])} robot steps"
        if row["trained_s"] is not None
        else "not reached"
    )
    return (
        f"`tlf train {row['training']}`, seed 0: no run of the evaluation lost and a score of at most "
        f"{row['good_mm']:g} mm {reached}; the whole training took {whole}, for "
        f"{number(row['whole_robot_steps'])} robot steps, and ended at {row['last_mm']:.2f} mm."
    )


def parts(result: dict[str, Any]) -> str:
    """Time of each part of a step."""
    found = result["parts"]
    head = ["µs per formation step", *(f"{one['robots']} robots" for one in found)]
    body = [
        [meaning, *(f"{one['us_per_formation_step'][name]:.2f}" for one in found)]
        for name, meaning in PART_NAMES.items()
    ]
    sums = [f"{sum(one['us_per_formation_step'].values()):.2f}" for one in found]
    return table(head, [*body, ["sum", *sums]])


def scaling(result: dict[str, Any]) -> str:
    """Cost against the number of robots, one formation."""
    body = [
        [str(row["robots"]), f"{row['us_per_step']:.0f}", f"{row['us_per_robot_step']:.1f}"]
        for row in result["scaling"]
    ]
    return table(["robots", "µs per step", "µs per robot and step"], body, names=0)


def memory(result: dict[str, Any]) -> str:
    """Memory of a formation by its number of robots."""
    found = result["memory_per_formation_bytes"]
    return "; ".join(f"{value / 1000:.0f} kB with {n} robots" for n, value in found.items()) + "."


PARTS_OF_PAGE = (
    machine, simulated, left_out, speeds, ratios, compiled, parts, scaling, memory, footprint, starts, training,
)  # fmt: skip


def written(text: str, result: dict[str, Any]) -> str:
    """The page with the text between all markers replaced.

    Raises
    ------
    ValueError
        if the page does not contain each marker once.
    """
    for make in PARTS_OF_PAGE:
        mark = f"<!-- {make.__name__} -->"
        if text.count(mark) != 1:
            raise ValueError(f"performance.md must have one line {mark!r}")
        before, after = text.split(mark)
        text = before + mark + "\n" + make(result) + after[after.index("\n<!-- end -->") :]
    return text


def speed(result: dict[str, Any]) -> Figure:
    """Agent steps per second against the number of formations."""
    figure = Figure(figsize=(6.4, 5.4), layout="constrained")
    axes = figure.subplots()
    lines = [
        (VECTOR, 3, 1, BLUE, "-", "o", "tlf_env, 3 robots"),
        (VECTOR, 3, 2, BLUE, "--", "o", "tlf_env, 3 robots, 2 threads"),
        (VECTOR, 5, 1, ORANGE, "-", "s", "tlf_env, 5 robots"),
        (VECTOR, 5, 2, ORANGE, "--", "s", "tlf_env, 5 robots, 2 threads"),
        (VMAS, 3, 1, GREEN, "-", "^", "VMAS DiffDrive, 3 agents"),
        (VMAS, 3, 2, GREEN, "--", "^", "VMAS DiffDrive, 2 threads"),
        (SPREAD, 3, 1, GREY, "-", "v", "JaxMARL simple_spread, 3 agents"),
        (JAXNAV, 3, 1, GREY, "-", "D", "JaxMARL JaxNav with lidar, 3 robots"),
        (KHEPERAX, 1, 1, GREY, "-", "P", "Kheperax, 1 robot"),
    ]
    for env, robots, threads, colour, dashes, marker, label in lines:
        rows = rows_of(result, env, robots=robots, threads=threads)
        if not rows:
            continue
        middle = [row["agent_steps_per_s"] for row in rows]
        low = [m - row["min"] * robots for m, row in zip(middle, rows, strict=True)]
        high = [row["max"] * robots - m for m, row in zip(middle, rows, strict=True)]
        axes.errorbar(
            [row["formations"] for row in rows],
            middle,
            [low, high],
            color=colour,
            ls=dashes,
            marker=marker,
            mfc=colour if threads == 1 else "white",
            ms=5,
            lw=1.4,
            elinewidth=0.8,
            capsize=2,
            label=label,
        )
    for row in rows_of(result, MPE2, robots=3):
        axes.axhline(row["agent_steps_per_s"], color=GREY, lw=1.2, ls=":")
        axes.annotate(
            "mpe2 simple_spread, 3 agents",
            (0.99, row["agent_steps_per_s"]),
            xycoords=("axes fraction", "data"),
            xytext=(0, -3),
            textcoords="offset points",
            ha="right",
            va="top",
            color=GREY,
            fontsize=9,
        )
    axes.set_xscale("log")
    axes.set_yscale("log")
    counts = sorted({row["formations"] for row in result["results"]})
    axes.set_xticks(counts, [f"{count:,}".replace(",", " ") for count in counts])
    axes.minorticks_off()
    axes.grid(which="major", color="0.9", lw=0.6)
    axes.set_xlabel("formations")
    axes.set_ylabel("agent steps per second (1/s)")
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=9)
    return figure


def main() -> None:
    """Write the page and the figure."""
    result = json.loads((DOCS / "performance.json").read_text(encoding="utf-8"))
    page = DOCS / "performance.md"
    new = written(page.read_text(encoding="utf-8"), result)
    with atomic(page, "wb") as file:
        file.write(new.encode())
    with matplotlib.rc_context(STYLE):
        figure = speed(result)
        for kind in ("svg", "png"):
            metadata = {"Date": None} if kind == "svg" else {}
            with atomic(FOLDER / f"speed.{kind}", "wb") as file:
                figure.savefig(file, format=kind, dpi=150, metadata=metadata, facecolor="white")


if __name__ == "__main__":
    main()
