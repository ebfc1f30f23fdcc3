"""What the agent does: spaces of actions and their meaning."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces


class Continuous:
    """A Box in [−1, 1], one number per rate as a share of its limit: turns (counter-clockwise +), then any climbs.

    Args:
        size: how many numbers.
        odd: [size] whether a number changes its sign when left and right are exchanged; None: all do.
    """

    def __init__(self, size: int, odd: Sequence[bool] | None = None):
        self.size = size
        self._mirror_sign = _mirror_sign(size, odd)
        self.space = spaces.Box(-1.0, 1.0, (size,), np.float32)

    def decode(self, action: Any, batch: int | None) -> np.ndarray:
        """Commands [e, a] in [−1, 1], float64, of actions [a] (batch None) or [batch, a]; outside values are clipped.

        Raises:
            ValueError: wrong shape, or values that are not finite numbers.
        """
        values = _numbers(action, (self.size,) if batch is None else (batch, self.size))
        return np.minimum(np.maximum(values, -1.0), 1.0)

    def encode(self, commands: np.ndarray) -> np.ndarray:
        """Actions [e, a] that `decode` turns into the commands [e, a]."""
        return commands.astype(np.float32)

    def mirrored(self, commands: np.ndarray) -> np.ndarray:
        """Commands [..., a] that do in the mirrored world what these do here."""
        return self._mirror_sign * commands


class Discrete:
    """A MultiDiscrete with one choice per rate among equally spaced ones from −limit to +limit.

    Args:
        size, odd: as of `Continuous`.
        levels: choices per rate.
    """

    def __init__(self, size: int, levels: int = 3, odd: Sequence[bool] | None = None):
        self.size = size
        self._mirror_sign = _mirror_sign(size, odd)
        self.levels = levels
        self.space = spaces.MultiDiscrete([levels] * size)

    def decode(self, action: Any, batch: int | None) -> np.ndarray:
        """Commands [e, a] in [−1, 1] of choices [a] or [batch, a].

        Raises:
            ValueError: wrong shape, or a choice outside 0 … levels − 1.
        """
        values = _numbers(action, (self.size,) if batch is None else (batch, self.size))
        if ((values < 0) | (values >= self.levels) | (values != np.rint(values))).any():
            raise ValueError(f"action {action!r}: choices must be integers from 0 to {self.levels - 1}")
        return 2.0 * values / (self.levels - 1) - 1.0

    def encode(self, commands: np.ndarray) -> np.ndarray:
        """The choices [e, a] nearest to commands [e, a]."""
        return np.rint(0.5 * (np.clip(commands, -1.0, 1.0) + 1.0) * (self.levels - 1)).astype(np.int64)

    def mirrored(self, commands: np.ndarray) -> np.ndarray:
        """Commands [..., a] that do in the mirrored world what these do here."""
        return self._mirror_sign * commands


def _mirror_sign(size: int, odd: Sequence[bool] | None) -> np.ndarray:
    return np.where([True] * size if odd is None else odd, -1.0, 1.0)


def _numbers(action: Any, shape: tuple[int, ...]) -> np.ndarray:
    try:
        if np.iscomplexobj(action):
            raise TypeError("complex")
        values = np.asarray(action, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"action {action!r}: must be numbers of shape {shape}") from error
    if values.shape != shape:
        raise ValueError(f"action has shape {values.shape}, must have shape {shape}")
    if not np.isfinite(values).all():
        raise ValueError(f"action {action!r}: every value must be a finite number")
    return values if len(shape) == 2 else values[None]
