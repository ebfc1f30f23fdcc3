"""Recorded measurements as arrays: who was where at every instant and what was received, in one frame and SI units.

Instants are the times of the rows; rows of one time are one scan. A station without a row at an instant is missing: its
place is then dead reckoning from the row before. Columns: docs/track.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from passive_env.earth_frame import EarthFrame
from passive_env.recording_file import HORIZONTAL, RecordingError, Table, read_table
from trackers.angles import wrap

ALONE = "platform"
"""Name of the only station of a file without a column `station`."""

_WHERE = (
    "time", "time_utc", "east", "north", "up", "latitude", "longitude", "height",
    "velocity_east", "velocity_north", "velocity_up",
)  # fmt: skip
_BEARINGS = (*_WHERE, "station", *HORIZONTAL, *(f"{name}_std" for name in HORIZONTAL))
_ANGLES = (*_BEARINGS, "elevation", "elevation_std", "available", "clutter_density")
_SITES = ("east", "north", "up", "latitude", "longitude", "height")
_SUMS = (
    *_WHERE, "transmitter", *(f"transmitter_{name}" for name in _SITES), "range_sum", "range_sum_std",
)  # fmt: skip

SAME_PLACE_M = 0.1
"""Rows of one station and instant may differ in their place by this."""


class Recording(NamedTuple):
    """Directions at k instants; s stations, b returns of one station in a scan at most, d = 2 or 3 coordinates.

    Attributes:
        source: the file's name.
        time_s: [k] strictly ascending.
        epoch: the first row's time of day, or "".
        stations: names, in the order of the arrays.
        platforms: [k, s, 2d] m, m/s.
        present: [k, s] bool, whether the file tells of the station then.
        angles: [k, s, b, 2] rad, counter-clockwise from east, and elevation (0 in the plane); 0 where not valid.
        valid: [k, s, b] bool.
        available: [k, s, 2] bool, whether directions and elevations can be used.
        std: [k, s, 2] rad; NaN where the file does not tell.
        clutter_density: [k, s] per rad²; NaN where the file does not tell.
        frame: of places on the earth; None where the file has metres.
    """

    source: str
    time_s: Any
    epoch: str
    stations: tuple[str, ...]
    platforms: Any
    present: Any
    angles: Any
    valid: Any
    available: Any
    std: Any
    clutter_density: Any
    frame: EarthFrame | None

    def reordered(self, names: Sequence[str]) -> Recording:
        """The same with the stations in another order."""
        order = [self.stations.index(name) for name in names]
        parts = ("platforms", "present", "angles", "valid", "available", "std", "clutter_density")
        return self._replace(stations=tuple(names), **{name: getattr(self, name)[:, order] for name in parts})


class SumRecording(NamedTuple):
    """Range sums at k instants; n transmitters, d = 2 or 3 coordinates.

    Attributes:
        source, time_s, epoch, frame: as of `Recording`.
        stations: the receiver's name.
        platforms: [k, 1, 2d] the receiver m, m/s.
        names: of the transmitters.
        transmitters: [n, d] m.
        listened: [k, n] bool, whether the file has a row of the transmitter.
        answered: [k, n] bool, whether its echo came.
        range_sums: [k, n] m; 0 without an echo.
        std: [k, n] m; NaN where the file does not tell.
    """

    source: str
    time_s: Any
    epoch: str
    stations: tuple[str, ...]
    platforms: Any
    names: tuple[str, ...]
    transmitters: Any
    listened: Any
    answered: Any
    range_sums: Any
    std: Any
    frame: EarthFrame | None


def read_bearings(path: str | Path, origin: Sequence[float] | None = None) -> Recording:
    """Unlabelled bearings in the plane: any number of rows per station and instant.

    Args:
        path: of the file; origin: latitude, longitude [deg] and, if need be, height [m] of the frame of places on the
            earth; None: the first row's place.
    Raises:
        RecordingError: anything in the file that cannot be used. OSError: it cannot be opened.
    """
    return _recording(read_table(path, _BEARINGS), origin, dimensions=2, several=True)


def read_azimuths(path: str | Path, origin: Sequence[float] | None = None) -> Recording:
    """One target's bearings in the plane, at most one per station and instant; arguments as of `read_bearings`."""
    return _recording(read_table(path, _BEARINGS), origin, dimensions=2, several=False)


def read_angles(path: str | Path, origin: Sequence[float] | None = None) -> Recording:
    """Unlabelled azimuths and elevations in space; arguments as of `read_bearings`."""
    return _recording(read_table(path, _ANGLES), origin, dimensions=3, several=True)


def read_range_sums(path: str | Path, origin: Sequence[float] | None = None) -> SumRecording:
    """Bistatic range sums, at most one per transmitter and instant; in space where the file has heights.

    Arguments as of `read_bearings`.
    """
    table = read_table(path, _SUMS)
    _require(table, ("transmitter",), ("range_sum",))
    frame = _frame(table, origin)
    d = 3 if table.has("up") or table.has("height") else 2
    receiver, sites = _places(table, frame, d, ""), _places(table, frame, d, "transmitter_")
    time_s, scan = np.unique(table.time_s, return_inverse=True)
    names, who = _numbered(table.texts["transmitter"])
    _check_single(table, scan, who, names, "transmitter")
    first = [int(np.flatnonzero(who == n)[0]) for n in range(len(names))]
    _check_places(table, sites, sites[first][who], "transmitter", "every row of a transmitter must have the same")
    lead = np.searchsorted(scan, np.arange(len(time_s)))
    _check_places(table, receiver, receiver[lead][scan], "receiver", "all rows of one time must have the same")
    k, n = len(time_s), len(names)
    sums, std, listened = np.zeros((k, n)), np.full((k, n), np.nan), np.zeros((k, n), dtype=bool)
    value = table.numbers["range_sum"]
    sums[scan, who], listened[scan, who] = np.nan_to_num(value), True
    answered = np.zeros((k, n), dtype=bool)
    answered[scan, who] = np.isfinite(value)
    if table.has("range_sum_std"):
        std[scan, who] = table.numbers["range_sum_std"]
    velocity = _velocities(table, frame, d)
    here = None if velocity is None else velocity[lead]
    states = _states(time_s, np.ones(k, dtype=bool), receiver[lead], here)
    return SumRecording(
        table.source, time_s, table.epoch, ("receiver",), states[:, None], tuple(names), sites[first], listened,
        answered, sums, std, frame,
    )  # fmt: skip


# -- directions --------------------------------------------------------------------------------------------------------


def _recording(table: Table, origin: Sequence[float] | None, dimensions: int, several: bool) -> Recording:
    """Rows as arrays; several: whether a station may have more than one return in a scan."""
    angle = _horizontal(table)
    _require(table, *((("elevation",),) if dimensions == 3 else ()))
    frame = _frame(table, origin)
    places, velocity = _places(table, frame, dimensions, ""), _velocities(table, frame, dimensions)
    time_s, scan = np.unique(table.time_s, return_inverse=True)
    names, who = _numbered(table.texts.get("station", [ALONE] * len(table.lines)))
    if not several:
        _check_single(table, scan, who, names, "station")
    components = _components(table, angle, dimensions)
    slot = _slots(table, scan, who, names, components)
    k, s, b = len(time_s), len(names), int(slot.max()) + 1
    angles, valid = np.zeros((k, s, b, 2)), np.zeros((k, s, b), dtype=bool)
    valid[scan, who, slot] = np.isfinite(components).any(-1)
    angles[scan, who, slot] = np.nan_to_num(_turned(table, frame, components))
    std = np.full((k, s, 2), np.nan)
    for column, name in enumerate((f"{angle}_std", "elevation_std")[: dimensions - 1]):
        if table.has(name):
            std[scan, who, column] = _alike(table, scan, who, table.numbers[name], name)
    density = np.full((k, s), np.nan)
    if table.has("clutter_density"):
        density[scan, who] = _alike(table, scan, who, table.numbers["clutter_density"], "clutter_density")
    available = np.zeros((k, s, 2), dtype=bool)
    available[scan, who] = _available(table, components)
    states, present = np.zeros((k, s, 2 * dimensions)), np.zeros((k, s), dtype=bool)
    for station in range(s):
        rows = np.flatnonzero(who == station)
        lead = rows[np.unique(scan[rows], return_index=True)[1]]
        _check_places(
            table, places[rows], places[lead][np.searchsorted(scan[lead], scan[rows])], names[station],
            "all rows of one station and time must have the same", rows,
        )  # fmt: skip
        present[scan[lead], station] = True
        own = None if velocity is None else velocity[lead]
        states[:, station] = _states(time_s, present[:, station], places[lead], own)
    return Recording(
        table.source, time_s, table.epoch, tuple(names), states, present, angles, valid, available, std, density, frame
    )


def _horizontal(table: Table) -> str:
    """The name of the horizontal angle."""
    there = [name for name in HORIZONTAL if table.has(name)]
    if len(there) != 1:
        told = " and ".join(there) or "none"
        raise RecordingError(
            f"{table.source}, line 1: must have one column of a horizontal angle, bearing or azimuth (clockwise from "
            f"north) or direction (counter-clockwise from east), in _deg, _rad or _mrad; has {told}"
        )
    return there[0]


def _components(table: Table, angle: str, dimensions: int) -> np.ndarray:
    """[r, 2] direction counter-clockwise from east in [−π, π] and elevation, 0 in the plane; NaN where empty."""
    direction = table.numbers[angle] if angle == "direction" else 0.5 * math.pi - table.numbers[angle]
    elevation = np.where(np.isnan(direction), np.nan, 0.0) if dimensions == 2 else table.numbers["elevation"]
    return np.stack([wrap(direction), elevation], axis=-1)


def _turned(table: Table, frame: EarthFrame | None, components: np.ndarray) -> np.ndarray:
    """Components [r, 2] in the axes of the frame; a direction alone is taken for level."""
    if frame is None:
        return components
    direction, elevation = np.nan_to_num(components).T
    turned = frame.directions(direction, elevation, table.numbers["latitude"], table.numbers["longitude"])
    return np.where(np.isnan(components), np.nan, np.stack(turned, axis=-1))


def _available(table: Table, components: np.ndarray) -> np.ndarray:
    """[r, 2] bool: what has a value; both where a station received nothing, unless the file says that it was off."""
    given = np.isfinite(components)
    some = given.any(axis=1)
    on = np.ones(len(components), dtype=bool)
    if table.has("available"):
        for row, cell in enumerate(table.texts["available"]):
            if cell not in ("0", "1"):
                raise table.error(row, f"available is {cell!r}, must be 1 or 0")
            on[row] = cell == "1"
        odd = np.flatnonzero(~on & some)
        if len(odd):
            raise table.error(int(odd[0]), "available is 0, but the row has a return: leave its angles empty")
    return np.where(np.expand_dims(some, 1), given, on[:, None])


def _slots(table: Table, scan: np.ndarray, who: np.ndarray, names: list[str], components: np.ndarray) -> np.ndarray:
    """[r] place of every row among those of its station and scan, in the file's order.

    Raises:
        RecordingError: the same return twice, a row without one beside others, rows of different components.
    """
    slot = np.zeros(len(scan), dtype=np.int64)
    seen: dict[tuple[int, int], list[int]] = {}
    for row, key in enumerate(zip(scan.tolist(), who.tolist(), strict=True)):
        others = seen.setdefault(key, [])
        where = f"station {names[key[1]]!r} at {table.time_s[row]:g} s"
        for other in others:
            given, given_there = np.isfinite(components[row]), np.isfinite(components[other])
            if np.array_equal(components[row], components[other], equal_nan=True):
                raise table.error(row, f"{where} has the row of line {table.lines[other]} twice; leave one of them out")
            if not np.array_equal(given, given_there):
                raise table.error(
                    row, f"{where} has rows with and without an angle (line {table.lines[other]}); must all have alike"
                )
        slot[row] = len(others)
        others.append(row)
    return slot


def _check_single(table: Table, scan: np.ndarray, who: np.ndarray, names: list[str], kind: str) -> None:
    """Refuse two rows of one sender and instant."""
    seen: dict[tuple[int, int], int] = {}
    for row, key in enumerate(zip(scan.tolist(), who.tolist(), strict=True)):
        if key in seen:
            raise table.error(
                row, f"{kind} {names[key[1]]!r} at {table.time_s[row]:g} s has a row already (line "
                f"{table.lines[seen[key]]}); this tracker takes one of each per time",
            )  # fmt: skip
        seen[key] = row


def _alike(table: Table, scan: np.ndarray, who: np.ndarray, values: np.ndarray, name: str) -> np.ndarray:
    """The values [r], the same in all rows of a station and scan."""
    seen: dict[tuple[int, int], int] = {}
    for row, key in enumerate(zip(scan.tolist(), who.tolist(), strict=True)):
        first = seen.setdefault(key, row)
        if not np.array_equal(values[row], values[first], equal_nan=True):
            raise table.error(row, f"{name} differs from that of line {table.lines[first]}, one station and time")
    return values


# -- places ------------------------------------------------------------------------------------------------------------


def _require(table: Table, *groups: tuple[str, ...]) -> None:
    """Refuse a table that lacks one of these columns."""
    for group in groups:
        if not table.has(*group):
            missing = ", ".join(name for name in group if not table.has(name))
            raise RecordingError(f"{table.source}, line 1: has no column {missing}; docs/track.md lists the columns")


def _frame(table: Table, origin: Sequence[float] | None) -> EarthFrame | None:
    """The frame of places on the earth; None where places are in metres."""
    earth, local = table.has("latitude") or table.has("longitude"), table.has("east") or table.has("north")
    if earth == local:
        told = "both" if earth else "neither"
        raise RecordingError(
            f"{table.source}, line 1: places must be east and north (_m or _km), or latitude and longitude (_deg or "
            f"_rad); has {told}"
        )
    if not earth:
        if origin is not None:
            raise ValueError(f"--origin: is not used, {table.source} has places in metres; leave it out")
        return None
    _require(table, ("latitude", "longitude"))
    if origin is None:
        return EarthFrame(float(table.numbers["latitude"][0]), float(table.numbers["longitude"][0]), 0.0)
    told = tuple(origin)
    good = len(told) in (2, 3) and np.isfinite(told).all() and abs(told[0]) <= 90.0 and abs(told[1]) <= 360.0
    if not good:
        shown = " ".join(map(str, told))
        raise ValueError(f"--origin {shown}: must be latitude, longitude [deg] and, if need be, height [m]")
    return EarthFrame(math.radians(told[0]), math.radians(told[1]), float(told[2]) if len(told) == 3 else 0.0)


def _places(table: Table, frame: EarthFrame | None, d: int, owner: str) -> np.ndarray:
    """[r, d] m."""
    across, above = (("east", "north"), "up") if frame is None else (("latitude", "longitude"), "height")
    names = [f"{owner}{name}" for name in across] + [f"{owner}{above}"] * (d == 3)
    _require(table, tuple(names))
    if frame is None:
        return np.stack([table.numbers[name] for name in names], axis=-1)
    height = f"{owner}height"
    heights = table.numbers[height] if table.has(height) else np.zeros(len(table.lines))
    return frame.local(table.numbers[names[0]], table.numbers[names[1]], heights)[:, :d]


def _velocities(table: Table, frame: EarthFrame | None, d: int) -> np.ndarray | None:
    """[r, d] m/s in the axes of the frame; None where the file does not tell."""
    names = ("velocity_east", "velocity_north", "velocity_up")
    if not any(table.has(name) for name in names):
        return None
    _require(table, names[:d])
    parts = [table.numbers[name] if table.has(name) else np.zeros(len(table.lines)) for name in names]
    velocity = np.stack(parts, axis=-1)
    if frame is not None:
        velocity = frame.turned(velocity, table.numbers["latitude"], table.numbers["longitude"])
    return velocity[:, :d]


def _check_places(table: Table, found, wanted, who: str, words: str, rows: Any = None) -> None:
    """Refuse rows whose places [r, d] are not those wanted."""
    apart = np.flatnonzero(np.abs(found - wanted).max(-1) > SAME_PLACE_M)
    if len(apart):
        row = int(apart[0] if rows is None else rows[apart[0]])
        raise table.error(row, f"the place of {who} is another than before; {words}")


def _states(time_s: np.ndarray, present: np.ndarray, places: np.ndarray, velocity: np.ndarray | None) -> np.ndarray:
    """[k, 2d] states of a station at all instants, from those [p] at which it is present.

    Velocities that are not told are those from the row before to the row, the first one's to the next. Where the
    station is missing it flies straight on; before its first row it is where that finds it.
    """
    at = np.flatnonzero(present)
    if velocity is None:
        velocity = np.zeros_like(places)
        if len(at) > 1:
            velocity[1:] = np.diff(places, axis=0) / np.diff(time_s[at])[:, None]
            velocity[0] = velocity[1]
    last = np.maximum(np.searchsorted(at, np.arange(len(time_s)), side="right") - 1, 0)
    since = np.where(present, 0.0, np.maximum(time_s - time_s[at[last]], 0.0))
    return np.concatenate([places[last] + since[:, None] * velocity[last], velocity[last]], axis=-1)


def _numbered(names: Sequence[str]) -> tuple[list[str], np.ndarray]:
    """Different names in the order of their first rows, and every row's number [r]."""
    order = list(dict.fromkeys(names))
    number = {name: i for i, name in enumerate(order)}
    return order, np.array([number[name] for name in names])
