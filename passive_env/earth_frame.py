"""Places on the ellipsoid and directions seen from them, in the one plane frame that trackers work in.

The frame is the tangent plane of WGS84 at its origin: east, north, up [m]. A direction that is measured against the
north of a place far from the origin is turned into the frame: norths converge, by 1° per 90 km east at 50° latitude.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pymap3d


class EarthFrame(NamedTuple):
    """A tangent plane; latitude and longitude [rad] and height [m] of its origin."""

    latitude: float
    longitude: float
    height: float

    def local(self, latitude: Any, longitude: Any, height: Any) -> np.ndarray:
        """East, north, up [..., 3] m of places: latitude, longitude [...] rad, height [...] m over the ellipsoid."""
        return np.stack(pymap3d.geodetic2enu(latitude, longitude, height, *self, deg=False), axis=-1)

    def geodetic(self, east: Any, north: Any, up: Any) -> np.ndarray:
        """Latitude [rad], longitude [rad] and height [m], together [..., 3], of places [...] m in the frame."""
        found = pymap3d.enu2geodetic(east, north, up, *self, deg=False)
        return np.stack(np.broadcast_arrays(*found), axis=-1)

    def ground(self, east: Any, north: Any) -> np.ndarray:
        """Latitude and longitude [..., 2] rad of places [...] m, taken to lie on the ellipsoid."""
        height = self.geodetic(east, north, np.zeros_like(east))[..., 2]
        return self.geodetic(east, north, -height)[..., :2]

    def turned(self, vectors: Any, latitude: Any, longitude: Any) -> np.ndarray:
        """Vectors [..., 3] given east, north and up of places [...] rad, in the frame's axes."""
        east, north, up = np.moveaxis(np.asarray(vectors), -1, 0)
        u, v, w = pymap3d.enu2uvw(east, north, up, latitude, longitude, deg=False)
        return np.stack(pymap3d.uvw2enu(u, v, w, self.latitude, self.longitude, deg=False), axis=-1)

    def directions(self, direction: Any, elevation: Any, latitude: Any, longitude: Any) -> tuple[Any, Any]:
        """Directions in the frame: counter-clockwise from east, and elevation, each [...] rad.

        Args:
            direction: [...] rad, counter-clockwise from the east of the place; elevation: [...] rad over its horizon.
            latitude, longitude: [...] rad of the place.
        """
        level = np.cos(elevation)
        sight = np.stack([level * np.cos(direction), level * np.sin(direction), np.sin(elevation)], axis=-1)
        east, north, up = np.moveaxis(self.turned(sight, latitude, longitude), -1, 0)
        return np.arctan2(north, east), np.arcsin(np.clip(up, -1.0, 1.0))
