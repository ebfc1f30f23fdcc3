"""Transmitters whose echoes are blocked for a while: how long, drawn for the tape, and what misses let one believe.

In the world a transmitter is blocked and clear in turn, each stretch of a duration drawn uniformly between two limits.
The belief takes both durations to be exponential with the same means, a chain with two states, and an echo of a clear
transmitter to be missed with a known probability besides:

    predict    b ← b (1 − T/m_b) + (1 − b) T/m_c         m_b, m_c mean durations of a blocked and of a clear stretch
    echo       b ← 0
    no echo    b ← b / (b + (1 − b) q)                   q probability of a miss
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from trackers.compiled import helper, kernel


class Stretches(NamedTuple):
    """Limits of the durations of blocked and of clear stretches [s]; a transmitter is never blocked if both are 0."""

    blocked_min_s: float
    blocked_max_s: float
    clear_min_s: float
    clear_max_s: float

    @property
    def share(self) -> float:
        """Share of the time for which a transmitter is blocked."""
        blocked, clear = self.blocked_min_s + self.blocked_max_s, self.clear_min_s + self.clear_max_s
        return blocked / (blocked + clear)

    def leaving(self, step_s: float) -> tuple[float, float]:
        """Probabilities to become blocked and to become clear within a step, of the belief's chain."""
        to_blocked = 2.0 * step_s / (self.clear_min_s + self.clear_max_s) if self.share else 0.0
        to_clear = 2.0 * step_s / (self.blocked_min_s + self.blocked_max_s) if self.share else 1.0
        return min(to_blocked, 1.0), min(to_clear, 1.0)

    def uniforms(self, duration_s: float) -> int:
        """Uniform numbers that `blocked` consumes per transmitter."""
        shortest = self.blocked_min_s + self.clear_min_s
        return 3 + 2 * int(np.ceil(duration_s / shortest)) if self.share else 0


@kernel("(n,u),(l),(),(t)->(t,n)", "FFfFB")
def _blocked(u, limits, step_s, time_like, out):
    share = limits[4]
    for i in range(u.shape[0]):
        now = u[i, 0] < share
        low, high = (limits[0], limits[1]) if now else (limits[2], limits[3])
        # A stretch that is under way at a random instant is a long one more often: its density grows with its length.
        until = u[i, 2] * math.sqrt(low * low + u[i, 1] * (high * high - low * low))
        drawn = 3
        for t in range(time_like.shape[0]):
            while until <= t * step_s and drawn < u.shape[1]:
                now = not now
                low, high = (limits[0], limits[1]) if now else (limits[2], limits[3])
                until += low + (high - low) * u[i, drawn]
                drawn += 1
            out[t, i] = now


def blocked(uniforms, stretches: Stretches, step_s: float, instants: int) -> Any:
    """When transmitters are blocked; at every instant with the same probability, `Stretches.share`.

    Args:
        uniforms: [..., n, stretches.uniforms(step_s * instants)].
        step_s: time between instants.
    Returns:
        [..., instants, n] bool.
    """
    if not stretches.share:
        return np.zeros((*np.shape(uniforms)[:-2], instants, np.shape(uniforms)[-2]), dtype=bool)
    return _blocked(uniforms, np.array([*stretches, stretches.share]), step_s, np.empty(instants))


def blocked_next(probability, stretches: Stretches, step_s: float) -> Any:
    """Probabilities [...] of being blocked a step later, of those [...] now: before anything has been heard."""
    to_blocked, to_clear = stretches.leaving(step_s)
    return probability * (1.0 - to_clear) + (1.0 - probability) * to_blocked


@helper
def predict_blocked(b, to_blocked, to_clear):
    """Probability of being blocked after a step in which nothing was heard of the transmitter."""
    return b * (1.0 - to_clear) + (1.0 - b) * to_blocked


@helper
def update_blocked(b, answered, missing):
    """Probability of being blocked after an answer, or after none from a transmitter that was listened to."""
    if answered:
        return 0.0
    return b / max(b + (1.0 - b) * missing, 1e-300) if b > 0.0 else 0.0
