"""Angles: the only place that wraps.

All angles are radians, counter-clockwise from +x (east), as in `atan2(dy, dx)`.
"""

from __future__ import annotations

import math

import numpy as np

from trackers.compiled import helper

TWO_PI = 2.0 * math.pi


@helper
def wrap_scalar(angle):
    """Wrap one angle [rad] into [−π, π]; for use inside kernels."""
    return angle - TWO_PI * np.rint(angle / TWO_PI)


def wrap(angle):
    """Wrap angles [...] rad into [−π, π]."""
    angle = np.asarray(angle, dtype=float)
    return angle - TWO_PI * np.rint(angle / TWO_PI)


def circular_mean(angle, axis=-1):
    """Mean direction of angles [...] rad along `axis`; 0 where the directions cancel exactly."""
    angle = np.asarray(angle, dtype=float)
    return np.arctan2(np.sin(angle).sum(axis), np.cos(angle).sum(axis))
