"""The table of channels in the documentation, made from the channels.

``python -m tlf_env.disturbances.table docs/disturbances.md`` updates it between its markers.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from tlf_env.disturbances.channels import CHANNELS, Channel

# Endings of a name, the longest first, and their units.
UNITS = {
    "_rad_s_sqrt_hz": "rad/s/√Hz",
    "_kg_mm2": "kg·mm²",
    "_s_rad": "s/rad",
    "_per_s": "1/s",
    "_rad_s": "rad/s",
    "_mm_s": "mm/s",
    "_Nmm": "N·mm",
    "_N": "N",
    "_rad": "rad",
    "_mm": "mm",
    "_kg": "kg",
    "_s": "s",
}
BEGIN, END = "<!-- channels -->\n", "<!-- end of channels -->"


def unit(path: str) -> str:
    """The unit in a channel's name; 1 for a number without one."""
    return next((unit for ending, unit in UNITS.items() if path.endswith(ending)), "1")


def row(channel: Channel) -> str:
    """One channel as a row of the table."""
    cells = (
        f"`{channel.path}`",
        unit(channel.path),
        f"{channel.nominal:.4g}",
        f"{channel.low:g} to {channel.high:g}",
        channel.rate,
        channel.meaning,
    )
    return "| " + " | ".join(cells) + " |"


def table() -> str:
    """All channels in Markdown."""
    head = "| channel | unit | nominal | range | evaluated every | meaning |\n|---|---|---|---|---|---|\n"
    return head + "\n".join(row(channel) for channel in CHANNELS) + "\n"


def renewed(page: str) -> str:
    """A page with the table between its markers updated.

    Raises
    ------
    ValueError
        for a page without the markers.
    """
    if BEGIN not in page or END not in page:
        raise ValueError(f"the page has no {BEGIN.strip()} … {END}")
    return re.sub(f"({BEGIN}).*?({END})", lambda at: at[1] + table() + at[2], page, flags=re.DOTALL)


if __name__ == "__main__":
    place = Path(sys.argv[1])
    place.write_text(renewed(place.read_text(encoding="utf-8")), encoding="utf-8")
