"""Recorded air traffic as target motion: read ADS-B rows, clean them, fit a smooth path, cut windows.

    library = load_flights()                                  # the shipped file, or any file of the same columns
    paths = library.split("train").resample(step_s=2.0)       # [total, 6] states on one time grid
    states = paths.windows(rng.random((1024, 3)), steps=45)   # [1024, 3, 46, 6]

The data's way: table of rows → duplicates, repeated positions and jumps dropped → split at gaps → one `Flight` per
piece → one robust smoothing spline per flight → `FlightPaths`. The `FlightReport` counts every row that is left out.
Reading, cleaning and smoothing have files of their own: `flight_file`, `flight_cleaning`, `flight_path`.

Frame: east, north about the flight's own first point (WGS84, tangent plane; at 400 km from that point the plane
shortens lengths by 0.2 %); up is the recorded pressure altitude itself, so a level flight stays level over the curved
Earth.

Data, credit and columns: passive_env/data/README.md.
"""

from __future__ import annotations

import math
import zlib
from collections import Counter
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from importlib import resources
from pathlib import Path

import numpy as np
from scipy.interpolate import BSpline

from passive_env.flight_cleaning import GAP_S, MIN_DURATION_S, local_frame, usable_pieces
from passive_env.flight_file import MIN_ROWS, FlightFileError, Rows, parse
from passive_env.flight_path import smooth_path

TEST_SHARE = 0.3
PARTS = ("train", "test", "all")


@dataclass(frozen=True, eq=False)
class Flight:
    """One clean, gap-free piece of one aircraft's recorded flight.

    Args:
        icao24: transponder address, lower-case hex.
        callsign: the piece's most frequent call sign, "" if none was recorded.
        time_s: [n] s, strictly increasing, from 0.
        position_m: [n, 3] east, north [m] from the first row; up = pressure altitude [m]. As recorded, noise included.
        velocity_m_s: [n, 3] m/s from recorded ground speed, track and vertical rate, in the same axes.
    """

    icao24: str
    callsign: str
    time_s: np.ndarray
    position_m: np.ndarray
    velocity_m_s: np.ndarray

    @property
    def duration_s(self) -> float:
        """Time from the first to the last row [s]."""
        return float(self.time_s[-1])

    @cached_property
    def path(self) -> BSpline:
        """Path of `smooth_path`: time [...] s to position [..., 3] m; `nu=1`: velocity, `nu=2`: acceleration."""
        return smooth_path(self.time_s, self.position_m, self.velocity_m_s)


@dataclass(frozen=True)
class FlightReport:
    """What the loader did with a file: every row is either kept or counted under exactly one `dropped_` reason.

    Args:
        rows_read: rows below the header.
        rows_kept, flights_kept, aircraft_kept: what is left.
        rows_out_of_order: rows earlier than their aircraft's row before them; sorted, not dropped.
        dropped_missing_value: a value other than the call sign is empty.
        dropped_duplicate_time: a second row of an aircraft at the same time.
        dropped_repeated_position: position frozen while the aircraft moved (receiver out of reach).
        dropped_jump: position or altitude far from what the neighbouring rows say.
        dropped_speed_mismatch: rows of pieces whose positions contradict the recorded speed and track.
        dropped_too_short: rows of pieces below `MIN_ROWS` or `MIN_DURATION_S`.
        splits_at_gap, splits_at_jump: cuts within one aircraft's rows.
    """

    rows_read: int = 0
    rows_kept: int = 0
    flights_kept: int = 0
    aircraft_kept: int = 0
    rows_out_of_order: int = 0
    dropped_missing_value: int = 0
    dropped_duplicate_time: int = 0
    dropped_repeated_position: int = 0
    dropped_jump: int = 0
    dropped_speed_mismatch: int = 0
    dropped_too_short: int = 0
    splits_at_gap: int = 0
    splits_at_jump: int = 0

    @property
    def dropped(self) -> dict[str, int]:
        """Rows dropped, by reason in words."""
        names = [f.name for f in fields(self) if f.name.startswith("dropped_")]
        return {name.removeprefix("dropped_").replace("_", " "): getattr(self, name) for name in names}

    def __str__(self) -> str:
        reasons = ", ".join(f"{count} {reason}" for reason, count in self.dropped.items() if count)
        return (
            f"{self.rows_read} rows read, {self.rows_kept} kept as {self.flights_kept} flights of {self.aircraft_kept}"
            f" aircraft; rows dropped: {reasons or 'none'}; cuts: {self.splits_at_gap} at gaps longer than {GAP_S:g} s,"
            f" {self.splits_at_jump} at jumps; {self.rows_out_of_order} rows were out of time order and were sorted."
        )


@dataclass(frozen=True, eq=False)
class FlightLibrary:
    """Clean flights of one file, the loader's report on the whole file, and the file's name."""

    flights: tuple[Flight, ...]
    report: FlightReport
    source: str

    def split(self, part: str) -> FlightLibrary:
        """The flights of one part; an aircraft is in "train" or in "test", never in both, on every machine the same.

        The address decides: crc32(icao24) / 2³² < TEST_SHARE is "test". All survey flights (call signs SAVAN..) of the
        shipped file are one aircraft and therefore in one part, "train".

        Args:
            part: "train", "test" or "all".
        Raises:
            ValueError: unknown part, or no aircraft of this file falls into it.
        """
        if part not in PARTS:
            raise ValueError(f"part must be one of {', '.join(PARTS)}; got {part!r}")
        if part == "all":
            return self
        chosen = tuple(flight for flight in self.flights if is_test(flight.icao24) == (part == "test"))
        if not chosen:
            raise ValueError(f"no aircraft of {self.source} falls into part {part!r}; use part 'all'")
        return FlightLibrary(chosen, self.report, self.source)

    def resample(self, step_s: float) -> FlightPaths:
        """All flights' smooth paths on a grid of step_s [s]; each flight starts at its own first row.

        Raises:
            ValueError: if step_s is not a positive number.
        """
        if not (math.isfinite(step_s) and step_s > 0):
            raise ValueError(f"step_s must be a positive number of seconds; got {step_s!r}")
        pieces = [_sample(flight, step_s) for flight in self.flights]
        flight_start = np.cumsum([0, *map(len, pieces)])
        return FlightPaths(step_s, _read_only(np.concatenate(pieces)), _read_only(flight_start), self.source)


@dataclass(frozen=True, eq=False)
class FlightPaths:
    """All flights of a library on one time grid.

    Args:
        step_s: time between two rows [s].
        states: [total, 6] x, y, z [m], vx, vy, vz [m/s]; east-north-up; the velocity is the position's derivative.
        flight_start: [flights + 1] first row of each flight, then total.
        source: the file's name, for messages.
    """

    step_s: float
    states: np.ndarray
    flight_start: np.ndarray
    source: str

    def window_starts(self, steps: int) -> np.ndarray:
        """[m] every row from which `steps` further rows lie in the same flight, ascending.

        Raises:
            ValueError: if steps is negative or no flight is long enough.
        """
        ends = self._starts_up_to(steps)
        return self._start_row(np.arange(ends[-1]), ends, steps)

    def windows(self, uniforms: np.ndarray, steps: int) -> np.ndarray:
        """Windows of recorded motion, every start row equally likely; neither shape nor speed is altered.

        Args:
            uniforms: [...] in [0, 1), one random number per window.
            steps: rows after the first.
        Returns:
            [..., steps + 1, 6] a copy; x, y are still the flight's own, the caller shifts and rotates.
        Raises:
            ValueError: uniforms outside [0, 1), or no flight is long enough.
        """
        uniforms = np.asarray(uniforms, dtype=float)
        if not np.all((uniforms >= 0) & (uniforms < 1)):
            raise ValueError("uniforms must be numbers in [0, 1)")
        ends = self._starts_up_to(steps)
        rank = np.minimum((uniforms * ends[-1]).astype(np.intp), ends[-1] - 1)
        rows = self._start_row(rank, ends, steps)[..., None] + np.arange(steps + 1)
        return self.states[rows]

    def turning_starts(self, steps: int, acceleration_m_s2: float, turning_s: float) -> np.ndarray:
        """[m] those of `window_starts` whose windows accelerate level, harder than a limit, for long enough.

        Args:
            steps: rows after a window's first.
            acceleration_m_s2: the limit, on the change of the level velocity from row to row.
            turning_s: time for which it is exceeded, in one turn or several [s]; 0 takes every window.
        """
        starts = self.window_starts(steps)
        change = np.linalg.norm(np.diff(self.states[:, 3:5], axis=0), axis=-1) / self.step_s
        before = np.concatenate([[0], np.cumsum(change > acceleration_m_s2)])  # steps that turn before each row
        return starts[self.step_s * (before[starts + steps] - before[starts]) >= turning_s]

    def _starts_up_to(self, steps: int) -> np.ndarray:
        """[flights] number of possible window starts in the flights up to and including each one."""
        if steps < 0:
            raise ValueError(f"steps must not be negative; got {steps}")
        lengths = np.diff(self.flight_start)
        ends = np.cumsum(np.maximum(lengths - steps, 0))
        if ends[-1] == 0:
            longest_s = (lengths.max() - 1) * self.step_s
            raise ValueError(
                f"no flight of {self.source} lasts {steps * self.step_s:g} s ({steps} steps of {self.step_s:g} s); "
                f"the longest lasts {longest_s:g} s: take fewer or shorter steps"
            )
        return ends

    def _start_row(self, rank: np.ndarray, ends: np.ndarray, steps: int) -> np.ndarray:
        """Row of the rank-th window start: each earlier flight that has starts holds `steps` rows that are none."""
        flight = np.searchsorted(ends, rank, side="right")
        before = np.concatenate([[0], ends])[flight]
        return self.flight_start[flight] + rank - before


def load_flights(path: str | Path | None = None) -> FlightLibrary:
    """Read, clean and split a flights file.

    Args:
        path: CSV, plain or gzip, with `flight_file.COLUMNS` in any order; None: the shipped file (read once).
    Raises:
        FlightFileError: not such a file, a malformed row, or no usable flight in it.
        OSError: the file cannot be opened.
    """
    if path is None:
        return _shipped()
    return _library(Path(path).read_bytes(), str(path))


def is_test(icao24: str) -> bool:
    """Whether the aircraft belongs to the test part."""
    return zlib.crc32(icao24.encode()) / 2**32 < TEST_SHARE


# ------------------------------------------------------------------------------------------ from a file to flights


@lru_cache(maxsize=1)
def _shipped() -> FlightLibrary:
    """The package's own file."""
    name = "data/flights.csv.gz"
    return _library((resources.files("passive_env") / name).read_bytes(), f"passive_env/{name}")


def _library(content: bytes, source: str) -> FlightLibrary:
    """Parse, clean and cut a file's content."""
    rows, rows_read = parse(content, source)
    counts: Counter[str] = Counter(rows_read=rows_read, dropped_missing_value=rows_read - len(rows.time_s))
    flights = tuple(map(_flight, usable_pieces(rows, counts)))
    counts["flights_kept"] = len(flights)
    counts["rows_kept"] = sum(len(flight.time_s) for flight in flights)
    counts["aircraft_kept"] = len({flight.icao24 for flight in flights})
    report = FlightReport(**counts)
    if not flights:
        raise FlightFileError(
            f"{source}: no usable flight; expected an aircraft with {MIN_DURATION_S:g} s of at least {MIN_ROWS} rows"
            f" and no gap above {GAP_S:g} s. {report}"
        )
    return FlightLibrary(flights, report, source)


def _flight(rows: Rows) -> Flight:
    """A piece as a Flight."""
    position, velocity = local_frame(rows)
    named = rows.callsign[rows.callsign != ""]
    callsign = Counter(named.tolist()).most_common(1)[0][0] if len(named) else ""
    arrays = map(_read_only, (rows.time_s - rows.time_s[0], position, velocity))
    return Flight(str(rows.icao24[0]), callsign, *arrays)


def _sample(flight: Flight, step_s: float) -> np.ndarray:
    """[k, 6] the flight's path at 0, step_s, 2 step_s, … up to its last row."""
    grid = step_s * np.arange(math.floor(flight.duration_s / step_s + 1e-9) + 1)
    return np.concatenate([flight.path(grid), flight.path(grid, nu=1)], axis=1)


def _read_only(array: np.ndarray) -> np.ndarray:
    array.setflags(write=False)
    return array
