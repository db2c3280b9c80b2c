"""Logs of positions over time, as CSV in any usual form."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tlf_env.common.errors import path_text, shown
from tlf_env.task.waypoints import MAX_COORDINATE_MM

MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "km": 1e6}  # in a unit of length
SECONDS = {
    "s": Decimal(1),
    "ms": Decimal("1e-3"),
    "us": Decimal("1e-6"),
    "ns": Decimal("1e-9"),
}  # in a unit of time
DELIMITERS = (";", "\t", "|", ",", " ")  # the first that gives rows of numbers
COMMENTS = ("#", "%", "//")
TIME_NAMES = frozenset(
    [
        "t",
        "time",
        "times",
        "timestamp",
        "timestamps",
        "stamp",
        "sec",
        "secs",
        "second",
        "seconds",
        "clock",
    ]
)
BEFORE_AXIS, AFTER_AXIS = ("", "pos", "position", "p", "pose"), ("pos", "position")
AXIS_NAMES = {
    axis: {
        name,
        *(before + axis for before in BEFORE_AXIS),
        *(axis + after for after in AFTER_AXIS),
    }
    for axis, name in (("x", "easting"), ("y", "northing"))
}
UNIT_SUFFIX = re.compile(r"^(?P<name>.*?)[ _]*[\[(_ ](?P<unit>mm|cm|m|km|s|ms|us|ns)[\])]?$")
SMALLEST_MM = 100.0  # a smaller path is probably in another unit
LARGEST = Decimal("1e20")  # of a number; nanoseconds since 1970 are 2e18
MOST_LISTED = 300  # characters of a header in an error
SAMPLED_ROWS = 200  # at the start, by which the form is found


class Form(NamedTuple):
    """The form of a file: what is between its values, and before the part of a number below 1."""

    delimiter: str
    decimal: str

    def cells(self, line: str) -> list[str]:
        """The values of a line."""
        parts = line.split() if self.delimiter == " " else line.split(self.delimiter)
        return [part.strip().strip('"').strip() for part in parts]

    def number(self, cell: str) -> Decimal | None:
        """The number in a cell; None if it is none."""
        text = cell.replace(",", ".") if self.decimal == "," else cell
        try:
            found = Decimal(text)
        except InvalidOperation:
            return None
        return found if found.is_finite() else None


class Column(NamedTuple):
    """A column of a file, and its unit by its name, if that says it."""

    number: int
    unit: str | None
    nanoseconds: int | None = None  # a further column that is added, of a time in two parts


class Log(NamedTuple):
    """Positions over time."""

    t_s: np.ndarray  # from 0 on
    xy_mm: np.ndarray  # (time, 2)
    lines: tuple[int, ...]  # of the file, from 1 on
    notes: tuple[str, ...]  # what was found and assumed


def read_log(path: Path, columns: str | None = None, units: str | None = None) -> Log:
    """A log of positions: any delimiter and decimal sign, comments, a byte-order mark, and any line ends.

    Parameters
    ----------
    columns
        The columns of time, x and y, comma-separated: names, or numbers from 1 on; None: by usual names. A time
        in two columns, seconds and nanoseconds, has a + between them.
    units
        Unit of the coordinates, ``m``, ``cm`` or ``mm``; None: as the header says.

    Raises
    ------
    ValueError
        in one line with the file, the line, the value and what is allowed.
    """
    name = path_text(path)
    if units is not None and units not in MM:
        raise ValueError(f"--units {units!r} must be one of {', '.join(MM)}")
    rows = list(_lines(path))
    if not rows:
        raise ValueError(f"{name} has no rows")
    form = _form(name, rows)
    first = form.cells(rows[0][1])
    header = None if any(form.number(cell) is not None for cell in first) else first
    body = rows if header is None else rows[1:]
    places = _columns(name, header, columns, len(form.cells(body[0][1])) if body else 0)
    t_s, xy, lines = _values(name, form, body, places)
    unit, said = _unit_of(name, places, units, xy)
    time_unit = places[0].unit or "s"
    numbers = ", ".join(str(one.number + 1) for one in places)
    notes = (
        f"{len(lines)} rows, separated by {_words(form.delimiter)}, with a decimal {_words(form.decimal)}",
        f"columns {numbers} are time in {time_unit}, x and y in {unit}{said}",
    )
    xy_mm = xy * MM[unit]
    far = np.flatnonzero(np.abs(xy_mm).max(axis=1) > MAX_COORDINATE_MM)
    if len(far):
        raise ValueError(
            f"{name}, line {lines[far[0]]}: x and y must be within ±{MAX_COORDINATE_MM:g} mm, got "
            f"{', '.join(f'{one:g}' for one in xy_mm[far[0]])}"
        )
    return Log(t_s, xy_mm, lines, notes)


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """The lines that are neither empty nor comments, with their numbers."""
    name = path_text(path)
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise ValueError(f"cannot read {name}: {error.strerror}") from error
    coding = "utf-16" if raw[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        text = raw.decode(coding)
    except UnicodeDecodeError as error:
        raise ValueError(f"{name} is not UTF-8 text: {error}") from error
    for number, line in enumerate(text.splitlines(), start=1):
        plain = line.strip()
        if plain and not plain.startswith(COMMENTS):
            yield number, plain


def _form(name: str, rows: Sequence[tuple[int, str]]) -> Form:
    """The form in which most of the first rows are at least three numbers, or two and a text."""
    lines = [line for _, line in rows[1 : SAMPLED_ROWS + 1]] or [rows[0][1]]
    for delimiter in DELIMITERS:
        for decimal in (".",) if delimiter == "," else (".", ","):
            form = Form(delimiter, decimal)
            numbers = [
                sum(form.number(one) is not None for one in form.cells(line)) for line in lines
            ]
            if sum(count >= 3 for count in numbers) > len(lines) / 2:
                return form
    raise ValueError(
        f"{name}, line {rows[0][0]}: no rows of at least three numbers (time, x and y), got {shown(lines[0])}"
    )


def _columns(name: str, header: list[str] | None, wanted: str | None, count: int) -> list[Column]:
    """The columns of time, x and y."""
    if wanted is not None:
        asked = [one.strip() for one in wanted.split(",")]
        if len(asked) != 3:
            raise ValueError(f"--columns {wanted!r} must name three columns: time, x and y")
        seconds, _, nanoseconds = asked[0].partition("+")
        found = [_asked_column(name, header, one, count) for one in (seconds, *asked[1:])]
        if nanoseconds:
            more = _asked_column(name, header, nanoseconds, count)
            found[0] = found[0]._replace(nanoseconds=more.number)
        return found
    if header is None:
        if count == 3:
            return [Column(number, None) for number in range(3)]
        raise ValueError(
            f"{name} has {count} columns and no header; --columns says which are time, x and y, as in "
            "--columns 1,2,3"
        )
    found = []
    for kind, names in (("time", TIME_NAMES), *AXIS_NAMES.items()):
        hits = [number for number, cell in enumerate(header) if _plain_name(cell) in names]
        if len(hits) != 1:
            which = "no column" if not hits else f"{len(hits)} columns"
            raise ValueError(
                f"{name}: {which} for {kind} in the header {_listed(header)}; --columns names those of time, "
                "x and y"
            )
        found.append(Column(hits[0], _unit(header[hits[0]])))
    return found


def _asked_column(name: str, header: list[str] | None, asked: str, count: int) -> Column:
    if header is not None and asked in header:
        return Column(header.index(asked), _unit(asked))
    if asked.isdecimal() and 1 <= int(asked) <= count:
        number = int(asked) - 1
        # A header may have fewer columns than the rows.
        named = header is not None and number < len(header)
        return Column(number, _unit(header[number]) if header is not None and named else None)
    there = _listed(header) if header else f"1 to {count}"
    raise ValueError(f"{name} has no column {asked!r}; the columns are {there}")


def _listed(header: list[str]) -> str:
    """The names of a header, in one line that is not too long."""
    text = path_text(", ".join(header))
    return text if len(text) <= MOST_LISTED else f"{text[:MOST_LISTED]}..."


def _plain_name(cell: str) -> str:
    """A column's name without its unit, path, and marks."""
    found = UNIT_SUFFIX.match(cell.strip().lower())
    last = (found["name"] if found else cell.lower()).strip()
    if last.count(".") > 1:  # as field.pose.pose.position.x
        last = ".".join(last.split(".")[-2:]).removeprefix("position.").removeprefix("pose.")
    return re.sub(r"[^a-z]", "", last)


def _unit(cell: str) -> str | None:
    found = UNIT_SUFFIX.match(cell.strip().lower())
    return found["unit"] if found else None


def _values(
    name: str, form: Form, body: Sequence[tuple[int, str]], places: list[Column]
) -> tuple[np.ndarray, np.ndarray, tuple[int, ...]]:
    """Times from 0 on in s, and coordinates as they are."""
    scale = SECONDS.get(places[0].unit or "s")
    if scale is None:
        raise ValueError(
            f"{name}: the time's unit {places[0].unit} must be one of {', '.join(SECONDS)}"
        )
    times: list[Decimal] = []
    points = []
    for line, text in body:
        cells = form.cells(text)
        values = [_value(name, form, line, cells, place.number) for place in places]
        if places[0].nanoseconds is not None:
            part = _value(name, form, line, cells, places[0].nanoseconds)
            values[0] += part * SECONDS["ns"]
        if times and values[0] <= times[-1]:
            what = "the same time as" if values[0] == times[-1] else "before"
            raise ValueError(
                f"{name}, line {line}: its time {values[0]} is {what} that of line {body[len(times) - 1][0]}, "
                f"{times[-1]}; times must increase"
            )
        times.append(values[0])
        points.append((float(values[1]), float(values[2])))
    if len(times) < 2:
        raise ValueError(f"{name} must have at least two rows of numbers, got {len(times)}")
    t_s = np.array([float((time - times[0]) * scale) for time in times])
    together = np.flatnonzero(np.diff(t_s) <= 0.0)
    if len(together):
        line = body[together[0] + 1][0]
        raise ValueError(
            f"{name}, line {line}: its time {times[together[0] + 1]} is too near to the one before it"
        )
    return t_s, np.array(points), tuple(line for line, _ in body)


def _value(name: str, form: Form, line: int, cells: list[str], number: int) -> Decimal:
    """The number in a cell of a line."""
    cell = cells[number] if number < len(cells) else ""
    value = form.number(cell)
    if value is None:
        raise ValueError(f"{name}, line {line}: {shown(cell)} in column {number + 1} is no number")
    if value.copy_abs() > LARGEST:
        raise ValueError(
            f"{name}, line {line}: {shown(cell)} in column {number + 1} must be within ±{LARGEST:g}"
        )
    return value


def _unit_of(name: str, places: list[Column], units: str | None, xy: np.ndarray) -> tuple[str, str]:
    """The unit of the coordinates, and how it is known.

    Raises
    ------
    ValueError
        if nothing says it, or the path is too small to be in it.
    """
    named = {place.unit for place in places[1:]}
    extent = float(np.ptp(xy, axis=0).max())
    if units is None:
        if len(named) != 1 or None in named:
            raise ValueError(
                f"{name}: nothing says the unit of x and y (the path is {extent:.6g} wide or high); add "
                "--units m, cm or mm"
            )
        units = str(named.pop())
        if units not in MM:
            raise ValueError(
                f"{name}: x and y are in {units}; the units of length are {', '.join(MM)}"
            )
        if extent * MM[units] < SMALLEST_MM:
            raise ValueError(
                f"{name}: the whole path is {extent * MM[units]:.3g} mm wide or high by its header; if it is "
                "in another unit, say so with --units, for example --units m"
            )
        return units, ", by the header"
    return units, ""


def _words(mark: str) -> str:
    return {
        ";": "semicolons",
        "\t": "tabs",
        "|": "bars",
        ",": "comma" if mark == "," else mark,
        " ": "blanks",
        ".": "point",
    }[mark]
