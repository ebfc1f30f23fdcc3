"""Recorded air traffic as target motion: read ADS-B rows, clean them, fit a smooth path, cut windows.

    library = load_flights()                                  # the shipped file, or any file of the same columns
    paths = library.split("train").resample(step_s=2.0)       # [total, 6] states on one time grid
    states = paths.windows(rng.random((1024, 3)), steps=45)   # [1024, 3, 46, 6]

The data's way: table of rows → duplicates, repeated positions and jumps dropped → split at gaps → one `Flight` per
piece → one robust smoothing spline per flight → `FlightPaths`. The `FlightReport` counts every row that is left out.

Frame: east, north about the flight's own first point (WGS84, tangent plane; at 400 km from that point the plane
shortens lengths by 0.2 %); up is the recorded pressure altitude itself, so a level flight stays level over the curved
Earth.

Data, credit and columns: passive_env/data/README.md.
"""

from __future__ import annotations

import csv
import gzip
import io
import itertools
import math
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from datetime import datetime
from functools import cached_property, lru_cache
from importlib import resources
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pymap3d
from scipy.interpolate import BSpline
from scipy.linalg import solveh_banded
from scipy.ndimage import median_filter

FOOT_M = 0.3048
KNOT_M_S = 1852.0 / 3600.0

# Cleaning: read off the shipped data; change them together with the counts in tests/test_flights.py.
GAP_S = 30.0  # a longer silence splits the flight
REPEAT_M = 10.0  # the same position again although the recorded speed says the aircraft moved further than this
JUMP_M = 500.0  # horizontal departure from the neighbours, after dead reckoning by the recorded velocity
JUMP_ALTITUDE_M = 100.0
JUMP_WINDOW = 15  # rows whose median decides what the neighbours say
DRIFT_M_S = 30.0  # what dead reckoning may drift per second before two rows count as two pieces
MIN_DURATION_S = 60.0
MIN_ROWS = 8
SPEED_MISMATCH = 0.2  # share of the speed by which positions may disagree with the recorded velocity

# Smoothing: chosen by leaving out every third row of the shipped flights and predicting its recorded velocity.
KNOT_S = 4.0  # knot spacing
POSITION_STD_M = 30.0  # time stamps are off by about 0.3 s
VELOCITY_STD_M_S = 1.5  # 1 knot resolution, same time stamps in a turn
JERK_DENSITY = 0.1  # m²/s⁵, horizontal
ALTITUDE_STD_M = 5.0  # 25 ft steps
CLIMB_STD_M_S = 1.0  # 64 ft/min steps
CLIMB_JERK_DENSITY = 0.03  # m²/s⁵
STUDENT_DOF = 3.0
REWEIGHTINGS = 6

TEST_SHARE = 0.3
PARTS = ("train", "test", "all")

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


# ------------------------------------------------------------------------------------------------ what a caller sees


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
        """Smooth path of `fit_path`: time [...] s to position [..., 3] m; `nu=1`: velocity, `nu=2`: acceleration."""
        t, p, v = self.time_s, self.position_m, self.velocity_m_s
        level = fit_path(t, p[:, :2], v[:, :2], POSITION_STD_M, VELOCITY_STD_M_S, JERK_DENSITY)
        climb = fit_path(t, p[:, 2:], v[:, 2:], ALTITUDE_STD_M, CLIMB_STD_M_S, CLIMB_JERK_DENSITY)
        return BSpline(level.t, np.concatenate([level.c, climb.c], axis=1), 3)


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
        path: CSV, plain or gzip, with the columns of `COLUMNS` in any order; None: the shipped file (read once).
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


# ------------------------------------------------------------------------------------------------ the smooth path


def fit_path(
    time_s: np.ndarray,
    position_m: np.ndarray,
    velocity_m_s: np.ndarray,
    position_std_m: float,
    velocity_std_m_s: float,
    jerk_density: float,
) -> BSpline:
    """Cubic spline through noisy positions and velocities, robust against late and stale rows.

        min over p   Σᵢ wᵢ |p(tᵢ) − zᵢ|² / σₚ²  +  Σᵢ uᵢ |ṗ(tᵢ) − vᵢ|² / σᵥ²  +  ∫ |p⃛|² dt / q

    on uniform knots, at most KNOT_S apart (a P-spline with a third-difference penalty); the weights follow from
    Student's t with ν degrees of freedom in m dimensions, w = (ν + m) / (ν + |r|²/σ²), by iterative reweighting.
    Deviation from Eilers & Marx: velocities enter the same least-squares problem.

    Measured on the shipped flights (2 s grid; median, 99 %, largest): horizontal acceleration 0.09, 4.5, 8.3 m/s² (the
    largest is a 40° bank in a survey turn), vertical 0.02, 0.5, 1.5 m/s²; speed minus recorded ground speed 0.25, 1.5,
    19 m/s (the tail: stale velocities in badly heard turns); recorded positions across the path 1.7 m in the median,
    along it 17 m.

    Args:
        time_s: [n] s, increasing, from 0, n ≥ 2.
        position_m: [n, m] m; velocity_m_s: [n, m] m/s.
        position_std_m: σₚ [m]; velocity_std_m_s: σᵥ [m/s].
        jerk_density: q [m²/s⁵]: the smaller, the smoother.
    Returns:
        spline of time in [0, time_s[-1]] with values [..., m].
    Source: Eilers & Marx (1996), Flexible smoothing with B-splines and penalties; Lange, Little & Taylor (1989), Robust
        statistical modeling using the t distribution.
    """
    intervals = max(1, math.ceil(time_s[-1] / KNOT_S))
    h = time_s[-1] / intervals
    first, B, G = _cubic_basis(time_s, h, intervals)
    J = np.tile([-1.0, 3.0, -3.0, 1.0], (intervals, 1)) * math.sqrt(h / jerk_density) / h**3
    design = np.concatenate([B / position_std_m, G / velocity_std_m_s, J])
    no_jerk = np.zeros((intervals, position_m.shape[1]))
    target = np.concatenate([position_m / position_std_m, velocity_m_s / velocity_std_m_s, no_jerk])
    column = np.concatenate([first, first, np.arange(intervals)])[:, None] + np.arange(4)
    c = _robust_least_squares(design, column, target, robust_rows=2 * len(time_s))
    return BSpline(h * np.arange(-3, intervals + 4), c, 3)


def _cubic_basis(time_s: np.ndarray, h: float, intervals: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Uniform cubic B-splines: first non-zero index [n], the four values [n, 4], their derivatives [n, 4] 1/s."""
    first = np.minimum((time_s / h).astype(np.intp), intervals - 1)
    u = time_s / h - first
    B = np.stack([(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3], axis=1) / 6
    G = np.stack([-((1 - u) ** 2), 3 * u**2 - 4 * u, -3 * u**2 + 2 * u + 1, u**2], axis=1) / (2 * h)
    return first, B, G


def _robust_least_squares(design: np.ndarray, column: np.ndarray, target: np.ndarray, robust_rows: int) -> np.ndarray:
    """Coefficients [k, m] of rows that touch four neighbouring coefficients each; the first robust_rows get t weights.

    Args:
        design: [r, 4] scaled to unit noise; column: [r, 4] coefficient index; target: [r, m].
    """
    weight = np.ones(len(design))
    c = _banded_least_squares(design, column, target, weight)
    for _ in range(REWEIGHTINGS):
        r = target - np.einsum("rj,rjm->rm", design, c[column])
        t_weight = (STUDENT_DOF + target.shape[1]) / (STUDENT_DOF + np.einsum("rm,rm->r", r, r))
        weight[:robust_rows] = t_weight[:robust_rows]
        c = _banded_least_squares(design, column, target, weight)
    return c


def _banded_least_squares(design: np.ndarray, column: np.ndarray, target: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Solve (Aᵀ W A) c = Aᵀ W b for A of bandwidth four; shapes as in `_robust_least_squares`, weight [r]."""
    size = int(column[-1, -1]) + 1
    weighted = weight[:, None] * design
    band = np.zeros((4, size))
    for a in range(4):
        for b in range(a, 4):
            band[b - a] += np.bincount(column[:, a], weighted[:, a] * design[:, b], size)
    sums = [np.bincount(column.ravel(), (weighted * b[:, None]).ravel(), size) for b in target.T]
    return solveh_banded(band, np.stack(sums, axis=1), lower=True)


def _sample(flight: Flight, step_s: float) -> np.ndarray:
    """[k, 6] the flight's path at 0, step_s, 2 step_s, … up to its last row."""
    grid = step_s * np.arange(math.floor(flight.duration_s / step_s + 1e-9) + 1)
    return np.concatenate([flight.path(grid), flight.path(grid, nu=1)], axis=1)


# ------------------------------------------------------------------------------------------------ cleaning


class _Rows(NamedTuple):
    """Rows of a file, column by column, in file order first and in (aircraft, time) order after `_sorted`."""

    time_s: np.ndarray  # [n] since 1970
    icao24: np.ndarray  # [n] str
    callsign: np.ndarray  # [n] str
    latitude: np.ndarray  # [n] deg
    longitude: np.ndarray  # [n] deg
    altitude_m: np.ndarray  # [n]
    speed_m_s: np.ndarray  # [n]
    track_rad: np.ndarray  # [n] clockwise from the local north
    climb_m_s: np.ndarray  # [n]

    def take(self, index: np.ndarray) -> _Rows:
        """The rows of an index or a mask."""
        return _Rows(*(column[index] for column in self))

    def cut(self, before: np.ndarray) -> list[_Rows]:
        """Pieces of at least one row, a new one starting at every row index in `before`."""
        edges = [0, *before.tolist(), len(self.time_s)]
        return [self.take(np.arange(start, stop)) for start, stop in itertools.pairwise(edges) if stop > start]


def _library(content: bytes, source: str) -> FlightLibrary:
    """Parse, clean and cut a file's content."""
    rows, rows_read = _parse(content, source)
    counts: Counter[str] = Counter(rows_read=rows_read, dropped_missing_value=rows_read - len(rows.time_s))
    flights = tuple(_flights(rows, counts))
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


def _flights(rows: _Rows, counts: Counter[str]) -> list[Flight]:
    """The clean flights of a table; what is left out is added to counts."""
    flights: list[Flight] = []
    if not len(rows.time_s):
        return flights
    for piece in _cut_at_gaps(_drop_repeats(_sorted(rows, counts), counts), counts):
        for segment in _cut_at_gaps(_drop_jumps(piece, counts), counts):
            flights += [_flight(part) for part in _cut_at_jumps(segment, counts) if _is_usable(part, counts)]
    return flights


def _sorted(rows: _Rows, counts: Counter[str]) -> _Rows:
    """Rows by aircraft, then by time; rows of equal time keep the file's order."""
    by_aircraft = rows.take(np.argsort(rows.icao24, kind="stable"))
    backwards = _same_aircraft(by_aircraft) & (np.diff(by_aircraft.time_s) < 0)
    counts["rows_out_of_order"] += int(backwards.sum())
    return rows.take(np.lexsort((rows.time_s, rows.icao24)))


def _same_aircraft(rows: _Rows) -> np.ndarray:
    """[n - 1] whether a row and the row before are of one aircraft."""
    return rows.icao24[1:] == rows.icao24[:-1]


def _drop_repeats(rows: _Rows, counts: Counter[str]) -> _Rows:
    """Without second rows of one time and without rows whose position was not renewed while the aircraft moved."""
    duplicate = np.append(False, _same_aircraft(rows) & (np.diff(rows.time_s) == 0))
    counts["dropped_duplicate_time"] += int(duplicate.sum())
    rows = rows.take(~duplicate)
    same = _same_aircraft(rows) & (np.diff(rows.latitude) == 0) & (np.diff(rows.longitude) == 0)
    fresh = np.append(True, ~same)
    since = np.maximum.accumulate(np.where(fresh, np.arange(len(fresh)), 0))
    repeated = ~fresh & (rows.speed_m_s * (rows.time_s - rows.time_s[since]) > REPEAT_M)
    counts["dropped_repeated_position"] += int(repeated.sum())
    return rows.take(~repeated)


def _cut_at_gaps(rows: _Rows, counts: Counter[str]) -> list[_Rows]:
    """Pieces of one aircraft each, without a silence longer than GAP_S."""
    same = _same_aircraft(rows)
    gap = same & (np.diff(rows.time_s) > GAP_S)
    counts["splits_at_gap"] += int(gap.sum())
    return rows.cut(np.flatnonzero(gap | ~same) + 1)


def _drop_jumps(rows: _Rows, counts: Counter[str]) -> _Rows:
    """Without rows far from the running median of what dead reckoning leaves unexplained."""
    residual = _unexplained(rows)
    deviation = residual - median_filter(residual, size=(JUMP_WINDOW, 1), mode="mirror")
    jump = (np.hypot(deviation[:, 0], deviation[:, 1]) > JUMP_M) | (np.abs(deviation[:, 2]) > JUMP_ALTITUDE_M)
    counts["dropped_jump"] += int(jump.sum())
    return rows.take(~jump)


def _cut_at_jumps(rows: _Rows, counts: Counter[str]) -> list[_Rows]:
    """Pieces between lasting jumps, which no median removes."""
    allowed = np.array([JUMP_M, JUMP_M, JUMP_ALTITUDE_M]) + DRIFT_M_S * np.diff(rows.time_s)[:, None]
    jump = np.any(np.abs(np.diff(_unexplained(rows), axis=0)) > allowed, axis=1)
    counts["splits_at_jump"] += int(jump.sum())
    return rows.cut(np.flatnonzero(jump) + 1)


def _unexplained(rows: _Rows) -> np.ndarray:
    """[n, 3] m: position minus the recorded velocity's integral (trapezoids); drifts slowly where rows are good."""
    position, velocity = _local_frame(rows)
    moved = 0.5 * (velocity[1:] + velocity[:-1]) * np.diff(rows.time_s)[:, None]
    return position - np.concatenate([np.zeros((1, 3)), np.cumsum(moved, axis=0)])


def _is_usable(rows: _Rows, counts: Counter[str]) -> bool:
    """Whether a piece is long enough and its positions agree with its velocities; if not, count its rows."""
    if len(rows.time_s) < MIN_ROWS or rows.time_s[-1] - rows.time_s[0] < MIN_DURATION_S:
        counts["dropped_too_short"] += len(rows.time_s)
        return False
    lag = MIN_ROWS - 1
    residual, time_s = _unexplained(rows), rows.time_s
    drift = np.linalg.norm(residual[lag:, :2] - residual[:-lag, :2], axis=1) / (time_s[lag:] - time_s[:-lag])
    if np.median(drift) > 2.0 + SPEED_MISMATCH * np.median(rows.speed_m_s):
        counts["dropped_speed_mismatch"] += len(time_s)
        return False
    return True


def _local_frame(rows: _Rows) -> tuple[np.ndarray, np.ndarray]:
    """Position [n, 3] m and velocity [n, 3] m/s, east-north about the first row, up = altitude.

    The recorded velocities refer to each row's own north and are turned into the first row's (4° at 400 km).
    """
    lat, lon, alt = rows.latitude, rows.longitude, rows.altitude_m
    east, north, _ = pymap3d.geodetic2enu(lat, lon, alt, lat[0], lon[0], alt[0])
    to_east, to_north = rows.speed_m_s * np.sin(rows.track_rad), rows.speed_m_s * np.cos(rows.track_rad)
    u, v, w = pymap3d.enu2uvw(to_east, to_north, rows.climb_m_s, lat, lon)
    v_east, v_north, _ = pymap3d.uvw2enu(u, v, w, lat[0], lon[0])
    return np.stack([east, north, alt], axis=1), np.stack([v_east, v_north, rows.climb_m_s], axis=1)


def _flight(rows: _Rows) -> Flight:
    """A piece as a Flight."""
    position, velocity = _local_frame(rows)
    named = rows.callsign[rows.callsign != ""]
    callsign = Counter(named.tolist()).most_common(1)[0][0] if len(named) else ""
    arrays = map(_read_only, (rows.time_s - rows.time_s[0], position, velocity))
    return Flight(str(rows.icao24[0]), callsign, *arrays)


def _read_only(array: np.ndarray) -> np.ndarray:
    array.setflags(write=False)
    return array


# ------------------------------------------------------------------------------------------------ reading


@lru_cache(maxsize=1)
def _shipped() -> FlightLibrary:
    """The package's own file."""
    name = "data/flights.csv.gz"
    return _library((resources.files("passive_env") / name).read_bytes(), f"passive_env/{name}")


def _parse(content: bytes, source: str) -> tuple[_Rows, int]:
    """Complete rows in SI units and file order, and the number of rows read."""
    table, lines = _read_table(content, source)
    time_s = _numbers("timestamp", table["timestamp"], lines, source, _timestamp)
    names = ("latitude", "longitude", "altitude", "groundspeed", "track", "vertical_rate")
    lat, lon, feet, knots, degrees, feet_min = (_numbers(name, table[name], lines, source, float) for name in names)
    icao24 = np.array([_text(value).lower() for value in table["icao24"]])
    callsign = np.array([_text(value) for value in table["callsign"]])
    altitude_m, speed_m_s, climb_m_s = feet * FOOT_M, knots * KNOT_M_S, feet_min * FOOT_M / 60.0
    rows = _Rows(time_s, icao24, callsign, lat, lon, altitude_m, speed_m_s, np.radians(degrees), climb_m_s)
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
