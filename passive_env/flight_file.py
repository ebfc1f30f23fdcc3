"""Reads files of recorded air traffic: ADS-B rows as text, plain or gzip, to columns in SI units.

Data, credit and columns: passive_env/data/README.md.
"""

from __future__ import annotations

import csv
import gzip
import io
import itertools
import math
import zlib
from collections.abc import Callable, Sequence
from datetime import datetime
from typing import NamedTuple

import numpy as np

FOOT_M = 0.3048
KNOT_M_S = 1852.0 / 3600.0
MIN_ROWS = 8
"""Fewest rows of a flight that is used."""

COLUMNS = {
    "timestamp": "an ISO 8601 time with its UTC offset, such as 2021-10-07 12:55:58+00:00",
    "icao24": "the transponder address",
    "callsign": "the call sign, may be empty",
    "latitude": "degrees from -90 to 90",
    "longitude": "degrees from -180 to 180",
    "altitude": "feet from -10000 to 200000",
    "groundspeed": "knots from 0 to 5000",
    "track": "degrees clockwise from north, from -360 to 360",
    "vertical_rate": "feet per minute from -100000 to 100000",
}
LIMITS = {
    "timestamp": (-math.inf, math.inf),
    "latitude": (-90.0, 90.0),
    "longitude": (-180.0, 180.0),
    "altitude": (-1e4, 2e5),
    "groundspeed": (0.0, 5e3),
    "track": (-360.0, 360.0),
    "vertical_rate": (-1e5, 1e5),
}
MISSING = frozenset({"", "nan", "NaN", "NaT", "NA", "<NA>", "None", "null"})


class FlightFileError(ValueError):
    """A flights file that cannot be used; the message names file, line, column, the value and what would be right."""


class Rows(NamedTuple):
    """Rows of a file, column by column, in file order first and in (aircraft, time) order once they are cleaned."""

    time_s: np.ndarray  # [n] since 1970
    icao24: np.ndarray  # [n] str
    callsign: np.ndarray  # [n] str
    latitude: np.ndarray  # [n] deg
    longitude: np.ndarray  # [n] deg
    altitude_m: np.ndarray  # [n]
    speed_m_s: np.ndarray  # [n]
    track_rad: np.ndarray  # [n] clockwise from the local north
    climb_m_s: np.ndarray  # [n]

    def take(self, index: np.ndarray) -> Rows:
        """The rows of an index or a mask."""
        return Rows(*(column[index] for column in self))

    def cut(self, before: np.ndarray) -> list[Rows]:
        """Pieces of at least one row, a new one starting at every row index in `before`."""
        edges = [0, *before.tolist(), len(self.time_s)]
        return [self.take(np.arange(start, stop)) for start, stop in itertools.pairwise(edges) if stop > start]


def parse(content: bytes, source: str) -> tuple[Rows, int]:
    """Complete rows in SI units and file order, and the number of rows read.

    Args:
        content: of the file; source: its name, for messages.
    Raises:
        FlightFileError: not such a file, or a malformed row.
    """
    table, lines = _read_table(content, source)
    time_s = _numbers("timestamp", table["timestamp"], lines, source, _timestamp)
    names = ("latitude", "longitude", "altitude", "groundspeed", "track", "vertical_rate")
    lat, lon, feet, knots, degrees, feet_min = (_numbers(name, table[name], lines, source, float) for name in names)
    icao24 = np.array([_text(value).lower() for value in table["icao24"]])
    callsign = np.array([_text(value) for value in table["callsign"]])
    altitude_m, speed_m_s, climb_m_s = feet * FOOT_M, knots * KNOT_M_S, feet_min * FOOT_M / 60.0
    rows = Rows(time_s, icao24, callsign, lat, lon, altitude_m, speed_m_s, np.radians(degrees), climb_m_s)
    missing = (icao24 == "") | np.isnan(np.stack([time_s, lat, lon, feet, knots, degrees, feet_min])).any(axis=0)
    return rows.take(~missing), len(lines)


def _read_table(content: bytes, source: str) -> tuple[dict[str, Sequence[str]], list[int]]:
    """The wanted columns as text, and each row's line in the file (from 1, header included)."""
    reader = csv.reader(io.StringIO(_text_of(content, source), newline=""))
    try:
        header = [name.strip() for name in next(reader, [])]
        _check_header(header, source)
        numbered = [(reader.line_num, row) for row in reader if row]
    except csv.Error as error:
        raise FlightFileError(f"{source}, line {reader.line_num}: not CSV text ({error})") from None
    for line, row in numbered:
        if len(row) != len(header):
            raise FlightFileError(_wrong_length(header, row, line, source))
    if not numbered:
        raise FlightFileError(f"{source}: a header but no rows; expected at least {MIN_ROWS} rows of one aircraft")
    lines, rows = zip(*numbered, strict=True)
    columns = dict(zip(header, zip(*rows, strict=True), strict=True))
    return {name: columns[name] for name in COLUMNS}, list(lines)


def _text_of(content: bytes, source: str) -> str:
    """Decompress (recognised by the content, not the name) and decode."""
    try:
        plain = gzip.decompress(content) if content[:2] == b"\x1f\x8b" else content
        return plain.decode("utf-8-sig")
    except (OSError, EOFError, zlib.error) as error:
        raise FlightFileError(f"{source}: damaged gzip file ({error}); expected CSV, plain or gzip") from None
    except UnicodeDecodeError as error:
        raise FlightFileError(f"{source}: not UTF-8 text (byte {error.start}); expected CSV, plain or gzip") from None


def _check_header(header: list[str], source: str) -> None:
    """Every column there, and once."""
    missing = [name for name in COLUMNS if name not in header]
    if missing:
        raise FlightFileError(
            f"{source}, line 1: column{'s' * (len(missing) > 1)} {', '.join(missing)} missing; "
            f"found {', '.join(header) or 'an empty line'}; expected {', '.join(COLUMNS)}"
        )
    twice = [name for name in COLUMNS if header.count(name) > 1]
    if twice:
        raise FlightFileError(f"{source}, line 1: column {', '.join(twice)} stands there twice; expected it once")


def _wrong_length(header: list[str], row: list[str], line: int, source: str) -> str:
    """Message for a row with more or fewer fields than the header."""
    if len(row) < len(header):
        where = f"column {header[len(row)]!r} is not there"
    else:
        where = f"value {row[len(header)]!r} after the last column {header[-1]!r}"
    return f"{source}, line {line}: {where}; {len(row)} fields, expected {len(header)} as in the header"


def _numbers(
    name: str, texts: Sequence[str], lines: list[int], source: str, parse: Callable[[str], float]
) -> np.ndarray:
    """[n] a column as numbers, NaN where the value is missing.

    Raises:
        FlightFileError: naming the first value that is no number or outside the column's limits.
    """
    low, high = LIMITS[name]
    numbers = np.empty(len(texts))
    for i, text in enumerate(texts):
        try:
            numbers[i] = math.nan if text.strip() in MISSING else parse(text)
        except ValueError:
            numbers[i] = math.inf
    wrong = np.flatnonzero((numbers < low) | (numbers > high) | np.isinf(numbers))
    if len(wrong):
        line, text = lines[wrong[0]], texts[wrong[0]]
        raise FlightFileError(f"{source}, line {line}, column {name!r}: {text!r} found, expected {COLUMNS[name]}")
    return numbers


def _timestamp(text: str) -> float:
    """Seconds since 1970; ValueError without a UTC offset."""
    moment = datetime.fromisoformat(text)
    if moment.tzinfo is None:
        raise ValueError("no UTC offset")
    return moment.timestamp()


def _text(value: str) -> str:
    """A text value, "" if missing."""
    return "" if value.strip() in MISSING else value.strip()
