"""The tables of a world's fields in the documentation, made from the models.

``python -m tlf_env.task.world_table docs/world.md`` updates them between their markers.
"""

from __future__ import annotations

import sys
import types
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from tlf_env.disturbances.table import unit
from tlf_env.physics.vehicle import RobotParameters
from tlf_env.physics.world import (
    BoxShape,
    CircleShape,
    MovingObstacle,
    Obstacle,
    Patch,
    PolygonShape,
    Pushable,
    Wall,
)

NO_UNIT = ("type", "shape", "closed", "random_start")
LARGE = 1e9  # a bound as large as this only keeps numbers finite, and is not printed
SURFACE = {
    "restitution": "share of the approach speed that a contact returns; a factor, see [contact](#contact)",
    "friction": "coefficient of Coulomb friction of a contact; a factor",
}
PLACE = {
    "shape": "a mapping, see [shapes](#shapes)",
    "x_mm": "place",
    "y_mm": "place",
    "angle_rad": "counter-clockwise angle of the shape",
}
# The tables of the page: the model of each, and what its fields mean.
TABLES: dict[str, tuple[type[BaseModel], dict[str, str]]] = {
    "walls": (
        Wall,
        {
            "points_mm": "corners (x, y) of the polyline",
            "thickness_mm": "thickness, with round ends; 0 is a line",
            "closed": "whether the last corner is joined to the first",
            **SURFACE,
        },
    ),
    "obstacles": (Obstacle, PLACE | SURFACE),
    "pushables": (
        Pushable,
        {
            **PLACE,
            "x_mm": "place of the centre of mass at the start of an episode",
            "y_mm": "the same",
            "mass_kg": "mass",
            "inertia_kg_mm2": "moment of inertia about the centre of mass; none: that of a uniform plate",
            "floor_friction": "µ of the friction with the floor, see below",
            "damping_per_s": "rate at which the velocities decrease besides",
            **SURFACE,
        },
    ),
    "moving": (
        MovingObstacle,
        {
            "shape": PLACE["shape"],
            "points_mm": "corners (x, y) of the path",
            "speed_mm_s": "speed along the path",
            "closed": "whether it goes round; otherwise there and back",
            "pause_s": "pause at each end of the path",
            "start_s": "time on its course at the start of an episode",
            "random_start": "whether a time, uniform over one lap, is drawn per episode and added",
            "angle_rad": "angle of the shape, which does not turn",
            **SURFACE,
        },
    ),
    "patches": (
        Patch,
        {
            "x_mm": "centre",
            "y_mm": "centre",
            "radius_mm": "radius",
            "friction_scale": "factor on the friction of each tyre on it",
        },
    ),
    "circle": (CircleShape, {"type": "`circle`", "radius_mm": "radius; the place is the centre"}),
    "box": (
        BoxShape,
        {
            "type": "`box`",
            "width_mm": "size along x at the angle 0; the place is the centre",
            "length_mm": "size along y at the angle 0",
        },
    ),
    "polygon": (
        PolygonShape,
        {
            "type": "`polygon`",
            "points_mm": "corners of a convex polygon in order, relative to the place",
        },
    ),
    "robot": (
        RobotParameters,
        {
            "outline_radius_mm": "radius of the outline; of the circle around a polygon",
            "outline_offset_mm": "how far the circle's centre lies behind c",
            "outline_polygon_mm": "a convex polygon instead: corners (right, forward) of c, in order",
            "outline_restitution": SURFACE["restitution"],
            "outline_friction": SURFACE["friction"],
        },
    ),
}


def table(model: type[BaseModel], meanings: dict[str, str]) -> str:
    """The fields of a model in Markdown, those that must be given first.

    Raises
    ------
    ValueError
        for a field without a meaning, or a meaning without a field.
    """
    fields = model.model_fields
    wanted = set(fields) if model is not RobotParameters else set(meanings)
    if wanted != set(meanings) or not wanted <= set(fields):
        raise ValueError(
            f"{model.__name__} has the fields {sorted(wanted)}, not {sorted(meanings)}"
        )
    names = sorted(meanings, key=lambda name: not fields[name].is_required())
    rows = [
        (
            f"`{name}`",
            "" if name in NO_UNIT else unit(name),
            allowed(fields[name]),
            "*required*" if fields[name].is_required() else value(fields[name].default),
            meanings[name],
        )
        for name in names
    ]
    head = "| field | unit | allowed | default | meaning |\n|---|---|---|---|---|\n"
    return head + "\n".join(f"| {' | '.join(row)} |" for row in rows) + "\n"


def value(default: Any) -> str:
    """A default as in YAML."""
    if default is None:
        return "none"
    return str(default).lower() if isinstance(default, bool) else f"{default:g}"


def bounds(annotation: Any, metadata: Iterable[Any]) -> dict[str, float]:
    """The bounds of a number or of a length, by pydantic's names: ``gt``, ``ge``, ``le``, ``min_length`` ..."""
    found: dict[str, float] = {}
    if get_origin(annotation) is types.UnionType or get_origin(annotation) is Union:
        for one in get_args(annotation):
            found |= bounds(one, ())
    elif get_origin(annotation) is Annotated:
        kind, *more = get_args(annotation)
        found |= bounds(kind, more)
    for one in metadata:
        if isinstance(one, FieldInfo):
            found |= bounds(None, one.metadata)
        for name in ("gt", "ge", "le", "min_length", "max_length"):
            if hasattr(one, name):
                found[name] = getattr(one, name)
    return found


def allowed(field: FieldInfo) -> str:
    """The values of a field that are allowed."""
    if field.annotation is bool:
        return "true, false"
    found = bounds(field.annotation, field.metadata)
    if "min_length" in found:
        return f"{found['min_length']} to {found['max_length']} points"
    high = found.get("le", LARGE)
    low = found.get("ge", -LARGE)
    if low <= -LARGE and "gt" in found:
        above = f"> {found['gt']:g}"
        return above if high >= LARGE else f"{above}, ≤ {high:g}"
    if low <= -LARGE and high >= LARGE:
        return ""
    return f"≥ {low:g}" if high >= LARGE else f"{low:g} to {high:g}"


def renewed(page: str) -> str:
    """A page with all tables between their markers updated.

    Raises
    ------
    ValueError
        for a page without the markers of a table.
    """
    for name, (model, meanings) in TABLES.items():
        begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
        if begin not in page or end not in page:
            raise ValueError(f"the page has no {begin.strip()} … {end}")
        before, rest = page.split(begin, 1)
        page = before + begin + table(model, meanings) + end + rest.split(end, 1)[1]
    return page


if __name__ == "__main__":
    place = Path(sys.argv[1])
    place.write_text(renewed(place.read_text(encoding="utf-8")), encoding="utf-8")
