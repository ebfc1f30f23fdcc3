"""Reads files of recorded measurements: CSV text whose column names end in their units, to columns in SI units.

One row is one return of one station, or says that a station was there and received none. Columns: docs/track.md.
"""

from __future__ import annotations

import csv
import difflib
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

FARTHEST_M = 1e7
"""Places lie within this distance of the origin, range sums within four times it."""

TURNS = 2.0 * math.pi + 1e-9

UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3},
    "angle": {"deg": math.pi / 180.0, "rad": 1.0, "mrad": 1e-3},
    "length": {"m": 1.0, "km": 1e3},
    "speed": {"m_s": 1.0, "km_h": 1.0 / 3.6, "kn": 1852.0 / 3600.0},
    "density": {"per_rad2": 1.0, "per_deg2": (180.0 / math.pi) ** 2},
}
"""Units by kind of quantity, and what one of them is in SI units."""


@dataclass(frozen=True)
class Quantity:
    """What a column may hold.

    Attributes:
        kind: one of `UNITS`.
        low, high: limits in SI units, inclusive.
        words: what a value must be.
        optional: whether a cell may be left empty.
    """

    kind: str
    low: float
    high: float
    words: str
    optional: bool = False


_PLACE = Quantity("length", -FARTHEST_M, FARTHEST_M, "within 10,000 km of the origin")
_SPEED = Quantity("speed", -2e4, 2e4, "within 20 km/s")
_ANGLE = Quantity("angle", -TURNS, TURNS, "within one full turn either way (360 deg, 6.2832 rad)", optional=True)
_ANGLE_STD = Quantity("angle", 1e-9, 4.0, "a standard deviation, positive and at most 4 rad (229 deg)", optional=True)
_LATITUDE = Quantity("angle", -0.5 * math.pi - 1e-12, 0.5 * math.pi + 1e-12, "from -90 to 90 degrees")
_LONGITUDE = Quantity("angle", -math.pi - 1e-12, TURNS, "from -180 to 360 degrees")
_ELEVATION = Quantity("angle", -0.5 * math.pi - 1e-9, 0.5 * math.pi + 1e-9, "from -90 to 90 degrees", optional=True)

HORIZONTAL = ("bearing", "azimuth", "direction")
"""Names of a horizontal angle: the first two clockwise from north, the last counter-clockwise from east."""

QUANTITIES: dict[str, Quantity] = {
    "time": Quantity("time", -1e12, 1e12, "a number of seconds"),
    **dict.fromkeys(HORIZONTAL, _ANGLE),
    "elevation": _ELEVATION,
    **{f"{name}_std": _ANGLE_STD for name in (*HORIZONTAL, "elevation")},
    "range_sum": Quantity("length", 1e-3, 4.0 * FARTHEST_M, "a positive length", optional=True),
    "range_sum_std": Quantity("length", 1e-3, 1e6, "a standard deviation, positive and at most 1000 km", optional=True),
    "clutter_density": Quantity("density", 0.0, 1e12, "not negative; 0 says that nobody knows it"),
    **{f"{owner}{axis}": _PLACE for owner in ("", "transmitter_") for axis in ("east", "north", "up", "height")},
    **{f"velocity_{axis}": _SPEED for axis in ("east", "north", "up")},
    **{f"{owner}latitude": _LATITUDE for owner in ("", "transmitter_")},
    **{f"{owner}longitude": _LONGITUDE for owner in ("", "transmitter_")},
}
"""Columns with a unit, by their names without it."""

TEXTS = ("station", "transmitter", "time_utc", "available")
"""Columns without a unit."""

SEPARATORS = (";", "\t", "|")
"""What other programs put between columns instead of commas."""

NOTE = "note"
"""Columns whose names begin so are not read."""


class RecordingError(ValueError):
    """A recording that cannot be used; the message names file, line, column, the value and what would be right."""


@dataclass(frozen=True, eq=False)
class Table:
    """Rows of a recording, column by column.

    Attributes:
        source: the file's name, for messages.
        lines: [r] line of every row in the file, the header is line 1.
        time_s: [r] ascending; since the first row where the file has times of day.
        numbers: by name without unit, each [r] in SI units; NaN where a cell is empty.
        texts: by name, each [r] text.
        epoch: the first row's time of day; "" where the file has plain seconds.
    """

    source: str
    lines: list[int]
    time_s: np.ndarray
    numbers: dict[str, np.ndarray]
    texts: dict[str, list[str]]
    epoch: str

    def has(self, *names: str) -> bool:
        """Whether all of these columns are there."""
        return all(name in self.numbers or name in self.texts for name in names)

    def error(self, row: int, words: str) -> RecordingError:
        """An error about a row."""
        return RecordingError(f"{self.source}, line {self.lines[row]}: {words}")


def read_table(path: str | Path, known: Sequence[str]) -> Table:
    """Read and check a recording.

    Args:
        path: of the file.
        known: names, without units, of the columns that may stand in it.
    Raises:
        RecordingError: not such a file, a column nobody knows or without its unit, a value that is none or outside its
            limits, times that go back. OSError: there is no such file, or it cannot be opened.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file, must be a CSV file of measurements")
    return parse_table(path.read_bytes(), str(path), known)


def parse_table(content: bytes, source: str, known: Sequence[str]) -> Table:
    """`read_table` of a file's content; source: its name."""
    header, lines, rows = _read_rows(content, source)
    places = _places(header, source, known)
    cells = {name: [row[at].strip() for row in rows] for name, (at, _) in places.items()}
    numbers = {
        name: _numbers(source, header[at], QUANTITIES[name], factor, cells[name], lines)
        for name, (at, factor) in places.items()
        if name in QUANTITIES
    }
    texts = {name: cells[name] for name in TEXTS if name in cells and name != "time_utc"}
    for name, values in texts.items():
        if "" in values:
            raise RecordingError(f"{source}, line {lines[values.index('')]}, column {name!r}: is empty, must be filled")
    time_s, epoch = _times(source, lines, numbers, cells)
    numbers.pop("time", None)
    return Table(source, lines, time_s, numbers, texts, epoch)


# -- rows and columns --------------------------------------------------------------------------------------------------


def _read_rows(content: bytes, source: str) -> tuple[list[str], list[int], list[list[str]]]:
    """Header, and every row with its line in the file."""
    try:
        reader = csv.reader(io.StringIO(content.decode("utf-8-sig"), newline=""), strict=True)
        header = [name.strip() for name in next(reader, [])]
        numbered = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except UnicodeDecodeError as error:
        raise RecordingError(f"{source}: is no UTF-8 text (byte {error.start}), must be a CSV file") from None
    except csv.Error as error:
        raise RecordingError(f"{source}: is no CSV text ({error})") from None
    if not any(header):
        raise RecordingError(f"{source}: is empty, must be a CSV file with a header line")
    if len(header) == 1 and (found := [sign for sign in SEPARATORS if sign in header[0]]):
        raise RecordingError(f"{source}, line 1: its columns are separated by {found[0]!r}, must be by commas")
    if not numbered:
        raise RecordingError(f"{source}: has a header but no rows, must have one per measurement")
    for line, row in numbered:
        if len(row) != len(header):
            raise RecordingError(f"{source}, line {line}: has {len(row)} fields, must have {len(header)} as the header")
    lines, rows = zip(*numbered, strict=True)
    return header, list(lines), list(rows)


def _places(header: list[str], source: str, known: Sequence[str]) -> dict[str, tuple[int, float]]:
    """Place and unit of every column, by its name without the unit."""
    places: dict[str, tuple[int, float]] = {}
    for at, column in enumerate(header):
        if column.startswith(NOTE):
            continue
        name, factor = _split(column, source, known)
        if name in places:
            other = header[places[name][0]]
            raise RecordingError(f"{source}, line 1: {column!r} and {other!r} tell the same, leave one of them out")
        places[name] = at, factor
    return places


def _split(column: str, source: str, known: Sequence[str]) -> tuple[str, float]:
    """A column's name without its unit, and the unit in SI units."""
    if column in TEXTS and column in known:
        return column, 1.0
    names = [name for name in known if name in QUANTITIES and (column == name or column.startswith(f"{name}_"))]
    if names:
        name = max(names, key=len)
        units = UNITS[QUANTITIES[name].kind]
        unit = column.removeprefix(name).removeprefix("_")
        if unit in units:
            return name, units[unit]
        told = f"has the unknown unit {unit!r}" if unit else "has no unit"
        right = " or ".join(f"{name}_{unit}" for unit in units)
        raise RecordingError(f"{source}, line 1: column {column!r} {told}, must be {right}")
    spelled = [f"{name}_{next(iter(UNITS[QUANTITIES[name].kind]))}" if name in QUANTITIES else name for name in known]
    near = difflib.get_close_matches(column, spelled, n=1)
    hint = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(spelled)}"
    raise RecordingError(
        f"{source}, line 1: unknown column {column!r}; {hint} (columns whose names begin with 'note' are not read)"
    )


# -- values ------------------------------------------------------------------------------------------------------------


def _numbers(
    source: str, column: str, quantity: Quantity, factor: float, cells: list[str], lines: list[int]
) -> np.ndarray:
    """[r] a column's values in SI units, NaN where a cell is empty.

    Raises:
        RecordingError: a value that is no finite number or outside its limits, an empty cell where none may be.
    """
    values = np.full(len(cells), np.nan)
    for row, cell in enumerate(cells):
        where = f"{source}, line {lines[row]}, column {column!r}"
        if not cell:
            if not quantity.optional:
                raise RecordingError(f"{where}: is empty, must be {quantity.words}")
            continue
        value = factor * _finite(where, cell, quantity)
        if not quantity.low <= value <= quantity.high:
            raise RecordingError(f"{where}: {cell} found, must be {quantity.words}")
        values[row] = value
    return values


def _finite(where: str, cell: str, quantity: Quantity) -> float:
    try:
        value = float(cell)
    except ValueError:
        raise RecordingError(f"{where}: {cell!r} is no number, must be {quantity.words}") from None
    if not math.isfinite(value):
        blank = "; leave the cell empty where there was no return" if quantity.optional else ""
        raise RecordingError(f"{where}: {cell} is not finite, must be {quantity.words}{blank}")
    return value


def _times(
    source: str, lines: list[int], numbers: dict[str, np.ndarray], cells: dict[str, list[str]]
) -> tuple[np.ndarray, str]:
    """[r] seconds, ascending, and the first row's time of day, if there are such."""
    if ("time" in numbers) == ("time_utc" in cells):
        told = "both time_s and time_utc" if "time" in numbers else "neither time_s nor time_utc"
        raise RecordingError(f"{source}, line 1: has {told}, must have one of them")
    time_s, epoch = (numbers["time"], "") if "time" in numbers else _times_of_day(source, lines, cells["time_utc"])
    back = np.flatnonzero(np.diff(time_s) < 0.0)
    if len(back):
        row = int(back[0]) + 1
        raise RecordingError(
            f"{source}, line {lines[row]}: time goes back by {time_s[row - 1] - time_s[row]:g} s; sort the rows by time"
        )
    return time_s, epoch


def _times_of_day(source: str, lines: list[int], cells: list[str]) -> tuple[np.ndarray, str]:
    moments = []
    for line, cell in zip(lines, cells, strict=True):
        try:
            moment = datetime.fromisoformat(cell)
        except ValueError:
            moment = None
        if moment is None or moment.tzinfo is None:
            raise RecordingError(
                f"{source}, line {line}, column 'time_utc': {cell!r} found, must be an ISO 8601 time with its offset "
                "from UTC, such as 2026-05-01T12:00:00.5+00:00"
            )
        moments.append(moment)
    return np.array([(moment - moments[0]).total_seconds() for moment in moments]), moments[0].isoformat()
