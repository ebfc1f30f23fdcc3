"""Cleans recorded flights: drops rows that cannot be true, cuts an aircraft's rows where they do not connect."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pymap3d
from scipy.ndimage import median_filter

from passive_env.flight_file import MIN_ROWS, Rows

# Read off the shipped data; change them together with the counts in tests/test_flights.py.
GAP_S = 30.0  # a longer silence splits the flight
REPEAT_M = 10.0  # the same position again although the recorded speed says the aircraft moved further than this
JUMP_M = 500.0  # horizontal departure from the neighbours, after dead reckoning by the recorded velocity
JUMP_ALTITUDE_M = 100.0
JUMP_WINDOW = 15  # rows whose median decides what the neighbours say
DRIFT_M_S = 30.0  # what dead reckoning may drift per second before two rows count as two pieces
MIN_DURATION_S = 60.0
SPEED_MISMATCH = 0.2  # share of the speed by which positions may disagree with the recorded velocity


def usable_pieces(rows: Rows, counts: Counter[str]) -> list[Rows]:
    """The clean, gap-free pieces of a table, each of one aircraft; what is left out is added to counts."""
    pieces: list[Rows] = []
    if not len(rows.time_s):
        return pieces
    for piece in _cut_at_gaps(_drop_repeats(_sorted(rows, counts), counts), counts):
        for segment in _cut_at_gaps(_drop_jumps(piece, counts), counts):
            pieces += [part for part in _cut_at_jumps(segment, counts) if _is_usable(part, counts)]
    return pieces


def _sorted(rows: Rows, counts: Counter[str]) -> Rows:
    """Rows by aircraft, then by time; rows of equal time keep the file's order."""
    by_aircraft = rows.take(np.argsort(rows.icao24, kind="stable"))
    backwards = _same_aircraft(by_aircraft) & (np.diff(by_aircraft.time_s) < 0)
    counts["rows_out_of_order"] += int(backwards.sum())
    return rows.take(np.lexsort((rows.time_s, rows.icao24)))


def _same_aircraft(rows: Rows) -> np.ndarray:
    """[n - 1] whether a row and the row before are of one aircraft."""
    return rows.icao24[1:] == rows.icao24[:-1]


def _drop_repeats(rows: Rows, counts: Counter[str]) -> Rows:
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


def _cut_at_gaps(rows: Rows, counts: Counter[str]) -> list[Rows]:
    """Pieces of one aircraft each, without a silence longer than GAP_S."""
    same = _same_aircraft(rows)
    gap = same & (np.diff(rows.time_s) > GAP_S)
    counts["splits_at_gap"] += int(gap.sum())
    return rows.cut(np.flatnonzero(gap | ~same) + 1)


def _drop_jumps(rows: Rows, counts: Counter[str]) -> Rows:
    """Without rows far from the running median of what dead reckoning leaves unexplained."""
    residual = _unexplained(rows)
    deviation = residual - median_filter(residual, size=(JUMP_WINDOW, 1), mode="mirror")
    jump = (np.hypot(deviation[:, 0], deviation[:, 1]) > JUMP_M) | (np.abs(deviation[:, 2]) > JUMP_ALTITUDE_M)
    counts["dropped_jump"] += int(jump.sum())
    return rows.take(~jump)


def _cut_at_jumps(rows: Rows, counts: Counter[str]) -> list[Rows]:
    """Pieces between lasting jumps, which no median removes."""
    allowed = np.array([JUMP_M, JUMP_M, JUMP_ALTITUDE_M]) + DRIFT_M_S * np.diff(rows.time_s)[:, None]
    jump = np.any(np.abs(np.diff(_unexplained(rows), axis=0)) > allowed, axis=1)
    counts["splits_at_jump"] += int(jump.sum())
    return rows.cut(np.flatnonzero(jump) + 1)


def _unexplained(rows: Rows) -> np.ndarray:
    """[n, 3] m: position minus the recorded velocity's integral (trapezoids); drifts slowly where rows are good."""
    position, velocity = local_frame(rows)
    moved = 0.5 * (velocity[1:] + velocity[:-1]) * np.diff(rows.time_s)[:, None]
    return position - np.concatenate([np.zeros((1, 3)), np.cumsum(moved, axis=0)])


def _is_usable(rows: Rows, counts: Counter[str]) -> bool:
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


def local_frame(rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    """Position [n, 3] m and velocity [n, 3] m/s, east-north about the first row, up = altitude.

    The recorded velocities refer to each row's own north and are turned into the first row's (4° at 400 km).
    """
    lat, lon, alt = rows.latitude, rows.longitude, rows.altitude_m
    east, north, _ = pymap3d.geodetic2enu(lat, lon, alt, lat[0], lon[0], alt[0])
    to_east, to_north = rows.speed_m_s * np.sin(rows.track_rad), rows.speed_m_s * np.cos(rows.track_rad)
    u, v, w = pymap3d.enu2uvw(to_east, to_north, rows.climb_m_s, lat, lon)
    v_east, v_north, _ = pymap3d.uvw2enu(u, v, w, lat[0], lon[0])
    return np.stack([east, north, alt], axis=1), np.stack([v_east, v_north, rows.climb_m_s], axis=1)
