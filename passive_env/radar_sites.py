"""Where the sites of a passive radar stand: the paper's layouts, a user's own, drawn pools of transmitters."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from trackers.compiled import kernel

PAPER_SITES_M: dict[str, tuple[tuple[float, float, float], ...]] = {
    "paper_poor": ((0.0, 0.0, 0.0), (-32e3, -33e3, 50.0), (0.0, -45e3, 60.0), (-10e3, -90e3, 100.0)),
    "paper_good": ((-36e3, 0.0, 100.0), (-108e3, -124.7e3, 0.0), (-108e3, 124.7e3, 0.0), (108e3, 0.0, 0.0)),
}
"""Receiver, then transmitters of the paper's layouts. In print the good one has its second transmitter where the first
is, which would leave two range sums; with the other sign of y the three are the triangle of which the text speaks."""

SITE_NAMES = ("random", *PAPER_SITES_M)
"""Layouts that go by a name; "random" is drawn."""

MOST_TRANSMITTERS = 16
FARTHEST_SITE_M = 1e7

LEAST_ANGLE_SIN = 1e-6
"""Sine of the angle between two sites' directions from the receiver below which they count as one line."""


def checked_sites(sites: Any, dimensions: int) -> tuple[tuple[float, ...], ...]:
    """Coordinates [m] of receiver and transmitters, as a user gave them in place of a name.

    Args:
        sites: [1 + n, dimensions or 3] m.
        dimensions: 2 or 3, of the scenario.
    Returns:
        the same as tuples.
    Raises:
        ValueError: saying what must be: coordinates that are none, a layout in which range sums cannot fix a position
            because sites coincide or all lie on one line.
    """
    if isinstance(sites, str):
        names = ", ".join(map(repr, SITE_NAMES))
        raise ValueError(f"must be one of {names}, or coordinates [m] of receiver and transmitters")
    points = _coordinates(sites, dimensions)
    gaps = np.linalg.norm((points[:, None] - points)[..., :2], axis=-1) + np.eye(len(points)) * 1e9
    if gaps.min() < 1.0:
        a, b = (int(i) for i in np.unravel_index(gaps.argmin(), gaps.shape))
        raise ValueError(f"points {a} and {b} coincide: move one, or leave it out")
    away = points[1:, :2] - points[0, :2]
    away /= np.linalg.norm(away, axis=-1, keepdims=True)
    crossing = away[:, None, 0] * away[:, 1] - away[:, None, 1] * away[:, 0]
    if np.abs(crossing).max() < LEAST_ANGLE_SIN:
        raise ValueError("all points lie on one line, across which range sums tell nothing: move some")
    return tuple(tuple(float(value) for value in point) for point in points)


def _coordinates(sites: Any, dimensions: int) -> np.ndarray:
    """Points [1 + n, dimensions or 3] m.

    Raises:
        ValueError: too few, too many, too far, or no numbers.
    """
    try:
        points = np.array(sites, dtype=float)
    except (TypeError, ValueError) as error:
        raise ValueError("must be a name, or coordinates [m] of receiver and transmitters") from error
    if points.ndim != 2 or len(points) < 3 or points.shape[1] not in (dimensions, 3):
        raise ValueError(f"must be 3 points or more of {dimensions} coordinates, the receiver first")
    if not np.isfinite(points).all():
        raise ValueError("every coordinate must be a finite number [m]")
    if np.abs(points).max() > FARTHEST_SITE_M:
        raise ValueError(f"every coordinate must lie within {FARTHEST_SITE_M:.0f} m of the origin")
    if len(points) > 1 + MOST_TRANSMITTERS:
        raise ValueError(f"must be a receiver and {MOST_TRANSMITTERS} transmitters at most")
    return points


@kernel("(n,q),(l),(d)->(n,d)", "FFFF")
def draw_transmitters(u, limits, like, sites):
    """Transmitters [..., n, d] m about a receiver in the origin.

    Args:
        u: [..., n, 3] uniform: azimuth, distance, height.
        limits: [3] m, least and largest distance, largest height.
        like: [d], its length tells whether there are heights.
    """
    for n in range(u.shape[0]):
        azimuth, away = 2.0 * math.pi * u[n, 0], limits[0] + (limits[1] - limits[0]) * u[n, 1]
        sites[n, 0], sites[n, 1] = away * math.cos(azimuth), away * math.sin(azimuth)
        if like.shape[0] == 3:
            sites[n, 2] = limits[2] * u[n, 2]
