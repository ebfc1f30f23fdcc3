"""The error that listening to a combination of transmitters promises, by a belief about who of them is blocked.

The tracker of range sums is predicted along an expected path, from scan to scan:

    P ← A P Aᵀ + Q,     then P⁻¹ ← P⁻¹ + Σᵢ pᵢ hᵢᵀhᵢ / σᵢ²      hᵢ slope of the range sum at the expected place

where pᵢ is the probability that transmitter i answers (information reduction). How it goes on depends on whether a
transmitter is blocked now, for that lasts: the promise is the mean over all cases of who is, weighted with their
probabilities.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from passive_env.radar_sensors import RadarBelief, distance, sum_std
from trackers.axis_motion import add_axis_noise, move_axes
from trackers.compiled import Blocks, helper, kernel
from trackers.range_sum import range_sum_row

CRITERIA_SUMS = ("position_std", "log_position_std", "position_variance")
"""What is averaged over scans and cases: √tr C of the position's covariance C, its logarithm, tr C."""

MOST_CASES = 16
"""Of larger combinations the mean probabilities of an answer are used, not all cases of who is blocked."""

LARGEST = 1e300

BLOCK = 64
"""Episodes whose candidates are weighed in one go."""


class Outlook(NamedTuple):
    """Who is expected to answer in the h scans to come; leading axes broadcast.

    Attributes:
        blocked: [e, n] probability of being blocked at the first of them.
        if_clear, if_blocked: [..., h, n] probability of an answer at each, if clear or blocked at the first.
    """

    blocked: Any
    if_clear: Any
    if_blocked: Any


# -- the kernels -------------------------------------------------------------------------------------------------------


@helper
def absorb_sum(P, row, var, column, d, size):
    """Condition the first `size` rows and columns of P [2d, 2d] on a range sum of slope row [d], in place."""
    S = 0.0
    for a in range(size):
        column[a] = 0.0
        for b in range(d):
            column[a] += P[a, b] * row[b]
    for a in range(d):
        S += row[a] * column[a]
    S = max(S, 0.0) * (1.0 + 1e-12) + var
    for a in range(size):
        for b in range(a + 1):
            P[a, b] -= column[a] * column[b] / S
            P[b, a] = P[a, b]


@helper
def criterion_of(P, d, kind):
    """A number of the position's covariance (see `CRITERIA_SUMS`), finite for every P."""
    trace = 0.0
    for a in range(d):
        trace += P[a, a]
    trace = min(max(trace, 1e-6), LARGEST) if trace == trace else LARGEST
    if kind == 0:
        return math.sqrt(trace)
    return 0.5 * math.log(trace) if kind == 1 else trace


@helper
def lay_out(path, receiver, sites, limits, rows, var, d):
    """Slopes rows [n, d] of all range sums at the expected place path [d], and their variances [n]."""
    r = distance(path, receiver, d)
    for i in range(sites.shape[0]):
        range_sum_row(path, receiver, sites[i], rows[i], d)
        std = sum_std(r, distance(path, sites[i], d), limits[1], limits[2], limits[3])
        var[i] = std * std


@kernel("(y,y),(h,d),(h,d),(n,d),(n),(n),(h,n),(h,n),(c,k),(l),(w)->(c)", "FFFFFFFFIFFF")
def _promises(P, path, receivers, sites, wait, blocked, if_clear, if_blocked, combinations, limits, noise, cost):
    (h, d), n, k = path.shape, sites.shape[0], combinations.shape[1]
    T, kind = limits[0], int(limits[4])
    rows, var, begin = np.empty((h, n, d)), np.empty((h, n)), np.empty((2 * d, 2 * d))
    trial, x = np.empty((2 * d, 2 * d)), np.zeros((2, 2 * d))
    for j in range(h):
        lay_out(path[j], receivers[j], sites, limits, rows[j], var[j], d)
    begin[:] = P
    move_axes(x[0], begin, T, d)
    add_axis_noise(begin, T, noise, 1.0, d)
    cases = 2**k if 2**k <= MOST_CASES else 1
    for c in range(combinations.shape[0]):
        cost[c] = 0.0
        for case in range(cases):
            weight = 1.0
            for m in range(k):
                b = blocked[combinations[c, m]]
                weight *= (b if (case >> m) & 1 else 1.0 - b) if cases > 1 else 1.0
            if weight <= 0.0:
                continue
            trial[:] = begin
            for j in range(h):
                if j > 0:
                    move_axes(x[0], trial, T, d)
                    add_axis_noise(trial, T, noise, 1.0, d)
                for m in range(k):
                    i = combinations[c, m]
                    share = if_blocked[j, i] if (case >> m) & 1 else if_clear[j, i]
                    if cases == 1:
                        share = blocked[i] * if_blocked[j, i] + (1.0 - blocked[i]) * if_clear[j, i]
                    if share > 0.0 and wait[i] - (j + 1) * T < 1e-6 * T:
                        # after the last scan only the position counts
                        absorb_sum(trial, rows[j, i], var[j, i] / share, x[1], d, 2 * d if j < h - 1 else d)
                cost[c] += weight * criterion_of(trial, d, kind) / h


# -- who will answer ---------------------------------------------------------------------------------------------------


def everyone(belief: RadarBelief, scans: int) -> Outlook:
    """Every transmitter that is listened to answers."""
    blocked = np.zeros_like(belief.blocked_probability)
    return Outlook(blocked, np.ones((scans, 1)), np.zeros((scans, 1)))


class Blockage:
    """What the belief in blocked transmitters lets expect (`passive_env.blockage`).

    Args:
        scenario: supplies durations and the probability of an echo.
    """

    def __init__(self, scenario: Any):
        self.to_blocked, self.to_clear = scenario.stretches.leaving(scenario.step_s)
        self.echo = float(scenario.echo_probability)

    def next(self, belief: RadarBelief) -> np.ndarray:
        """Probability [e, n] of being blocked at the next scan."""
        b = belief.blocked_probability
        return b * (1.0 - self.to_clear) + (1.0 - b) * self.to_blocked

    def __call__(self, belief: RadarBelief, scans: int) -> Outlook:
        """Outlook on some scans; of a single one, cases are whether an echo comes, not whether it could."""
        blocked = self.next(belief)
        if scans == 1:
            return Outlook(1.0 - self.echo * (1.0 - blocked), np.ones((1, 1)), np.zeros((1, 1)))
        clear = self.to_clear / max(self.to_blocked + self.to_clear, 1e-12)
        same = (1.0 - self.to_blocked - self.to_clear) ** np.arange(scans)[:, None]
        return Outlook(blocked, self.echo * (clear + (1.0 - clear) * same), self.echo * clear * (1.0 - same))


# -- promises ----------------------------------------------------------------------------------------------------------


def expected_path(belief: RadarBelief, scans: int, step_s: float) -> np.ndarray:
    """Places [e, h, d] of the track at the scans to come, straight on."""
    return _straight_on(belief.mean[:, 0], scans, step_s)


def expected_receiver(belief: RadarBelief, scans: int, step_s: float) -> np.ndarray:
    """Places [e, h, d] of the receiver at the scans to come, straight on."""
    return _straight_on(belief.platforms[:, 0], scans, step_s)


def _straight_on(state: np.ndarray, scans: int, step_s: float) -> np.ndarray:
    d = state.shape[-1] // 2
    time = step_s * np.arange(1, scans + 1)[:, None]
    return state[:, None, :d] + time * state[:, None, d:]


class SumPrediction:
    """What combinations of transmitters promise if they are listened to in all of the scans to come.

    Args:
        scenario: supplies noise, combinations and scans.
        scans: looked ahead.
        criterion: one of `CRITERIA_SUMS`.
    Raises:
        ValueError: fewer than one scan, or an unknown criterion.
    """

    def __init__(self, scenario: Any, scans: int = 1, criterion: str = "position_std"):
        if isinstance(scans, bool) or not isinstance(scans, (int, np.integer)) or scans < 1:
            raise ValueError(f"scans = {scans!r}: must be an integer of at least 1")
        if criterion not in CRITERIA_SUMS:
            raise ValueError(f"criterion {criterion!r}: must be one of {', '.join(CRITERIA_SUMS)}")
        self.scans, self.step_s = int(scans), float(scenario.step_s)
        self.combinations = np.ascontiguousarray(scenario.combinations, dtype=np.int64)
        noise = (scenario.range_sum_std_m, scenario.std_range_m, scenario.std_floor_m)
        self._limits = np.array([self.step_s, *noise, CRITERIA_SUMS.index(criterion)])
        self._noise = np.array(scenario.process_noise)

    def __call__(
        self, belief: RadarBelief, outlook: Outlook, path: Any = None, receiver: Any = None, waits: bool = True
    ) -> np.ndarray:
        """Criterion [e, c] of every combination.

        Args:
            belief: where the track, the receiver and its channels are now.
            outlook: who will answer.
            path, receiver: [e, h, d] where the target and the receiver will be; None: straight on.
            waits: whether retuning takes its time.
        """
        h, n = self.scans, belief.transmitters.shape[1]
        path = expected_path(belief, h, self.step_s) if path is None else path
        receiver = expected_receiver(belief, h, self.step_s) if receiver is None else receiver
        shape = (len(belief.mean), h, n)
        shares = (np.broadcast_to(part, shape) for part in (outlook.if_clear, outlook.if_blocked))
        wait = belief.wait_s if waits else np.zeros_like(belief.wait_s)
        columns = (belief.cov[:, 0], path, receiver, belief.transmitters, wait, outlook.blocked, *shares)

        def weigh(rows: slice) -> np.ndarray:
            return _promises(*(part[rows] for part in columns), self.combinations, self._limits, self._noise)

        blocks = Blocks(len(belief.mean), block=BLOCK)
        return np.concatenate(blocks.map(weigh, blocks.slices))
