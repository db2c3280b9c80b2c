"""Write the numbers of ``docs/performance.json`` into ``docs/performance.md`` and draw ``speed.svg``.

First run ``tlf speed --out docs/performance.json``, then ``python docs/figures/make_speed.py``. This needs
the extra ``figures``.
"""

from __future__ import annotations

import json
from typing import Any

import matplotlib
from make_figures import BLUE, FOLDER, GREEN, GREY, ORANGE, STYLE
from matplotlib.figure import Figure

from tlf_env.common.files import atomic

DOCS = FOLDER.parent
MPE2, VMAS, ALONE, VECTOR = (
    "mpe2/simple_spread_v3",
    "vmas/diff_drive",
    "tlf_env/infinity-v0",
    "tlf_env.FormationVectorEnv",
)
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


def ratio(result: dict[str, Any], row: dict[str, Any], to: str) -> str:
    """The paired ratio to a peer, with its spread."""
    keys = ("env", "robots", "formations", "threads")
    for one in result["ratios"]:
        if one["to"] == to and all(one[key] == row[key] for key in keys):
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
    for env in (ALONE, VECTOR, *special, VMAS, MPE2):
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
                    ratio(result, row, MPE2),
                    ratio(result, row, VMAS),
                ]
            )
    head = "environment|robots|formations|threads|formation steps/s|agent steps/s|to mpe2|to VMAS"
    return table(head.split("|"), body)


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


def written(text: str, result: dict[str, Any]) -> str:
    """The page with the text between all markers replaced.

    Raises
    ------
    ValueError
        if the page does not contain each marker once.
    """
    for make in (machine, speeds, parts, scaling, memory):
        mark = f"<!-- {make.__name__} -->"
        if text.count(mark) != 1:
            raise ValueError(f"performance.md must have one line {mark!r}")
        before, after = text.split(mark)
        text = before + mark + "\n" + make(result) + after[after.index("\n<!-- end -->") :]
    return text


def speed(result: dict[str, Any]) -> Figure:
    """Agent steps per second against the number of formations."""
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.subplots()
    lines = [
        (VECTOR, 3, 1, BLUE, "-", "o", "tlf_env, 3 robots"),
        (VECTOR, 3, 2, BLUE, "--", "o", "tlf_env, 3 robots, 2 threads"),
        (VECTOR, 5, 1, ORANGE, "-", "s", "tlf_env, 5 robots"),
        (VECTOR, 5, 2, ORANGE, "--", "s", "tlf_env, 5 robots, 2 threads"),
        (VMAS, 3, 1, GREEN, "-", "^", "VMAS DiffDrive, 3 agents"),
        (VMAS, 3, 2, GREEN, "--", "^", "VMAS DiffDrive, 2 threads"),
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
    axes.legend(frameon=False, fontsize=9, loc="upper left")
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
