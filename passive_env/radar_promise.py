"""The error that listening to a combination of transmitters promises, by a belief about who of them is blocked.

The tracker of range sums is predicted along an expected path, from scan to scan:

    P ← A P Aᵀ + Q,     then P⁻¹ ← P⁻¹ + Σᵢ pᵢ hᵢᵀhᵢ / σᵢ²      hᵢ slope of the range sum at the expected place

where pᵢ is the probability that transmitter i answers (information reduction). How it goes on depends on whether a
transmitter is blocked now, for that lasts: the promise is the mean over all cases of who is, weighted with their
probabilities, or, to save time, that of the case in between.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from passive_env.blockage import blocked_next
from passive_env.radar_sensors import RadarBelief, distance, sum_std
from passive_env.renewal import Renewal
from trackers.axis_motion import add_axis_noise, move_axes
from trackers.compiled import Blocks, helper, kernel
from trackers.range_sum import absorb_sum, range_sum_row

CRITERIA_SUMS = ("position_std", "log_position_std", "position_variance")
"""What is averaged over scans and cases: √tr C of the position's covariance C, its logarithm, tr C."""

MOST_CASES = 16
"""With more cases than these only the one in between is weighed."""

LARGEST = 1e300

BLOCK = 64
"""Episodes whose candidates are weighed in one go."""


class Outlook(NamedTuple):
    """Who is expected to answer at the h instants to come; leading axes broadcast.

    Attributes:
        blocked: [e, n] probability of being blocked at the first of them.
        if_clear, if_blocked: [..., h, n] probability of an answer at each, if clear or blocked at the first.
    """

    blocked: Any
    if_clear: Any
    if_blocked: Any


# -- the kernels -------------------------------------------------------------------------------------------------------


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
    T, kind, weighed, together = limits[0], int(limits[4]), limits[5] > 0.0, int(limits[6])
    span = T * together  # between instants, each of which stands for some scans
    rows, var, begin = np.empty((h, n, d)), np.empty((h, n)), np.empty((2 * d, 2 * d))
    trial, x = np.empty((2 * d, 2 * d)), np.zeros((2, 2 * d))
    for j in range(h):
        lay_out(path[j], receivers[j], sites, limits, rows[j], var[j], d)
    begin[:] = P
    move_axes(x[0], begin, span, d)
    add_axis_noise(begin, span, noise, 1.0, d)
    cases = 2**k if weighed and 2**k <= MOST_CASES else 1
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
                    move_axes(x[0], trial, span, d)
                    add_axis_noise(trial, span, noise, 1.0, d)
                for m in range(k):
                    i = combinations[c, m]
                    share = if_blocked[j, i] if (case >> m) & 1 else if_clear[j, i]
                    if cases == 1:
                        share = blocked[i] * if_blocked[j, i] + (1.0 - blocked[i]) * if_clear[j, i]
                    first = max(math.ceil(wait[i] / T - 1e-6), 1)  # of the scans to come
                    tuned = min(max((j + 1) * together - first + 1, 0), together)
                    if share > 0.0 and tuned > 0:
                        # after the last instant only the position counts
                        size = 2 * d if j < h - 1 else d
                        absorb_sum(trial, rows[j, i], var[j, i] / (share * tuned), x[1], d, size)
                cost[c] += weight * criterion_of(trial, d, kind) / h


# -- who will answer ---------------------------------------------------------------------------------------------------


class Ahead(NamedTuple):
    """The instants looked ahead to: so many, each of which stands for some scans."""

    instants: int
    scans: int


def everyone(belief: RadarBelief, ahead: Ahead) -> Outlook:
    """Every transmitter that is listened to answers."""
    return Outlook(np.zeros_like(belief.blocked_probability), np.ones((ahead.instants, 1)), np.zeros((1, 1)))


class Blockage:
    """What the belief in blocked transmitters lets expect (`passive_env.blockage`).

    Args:
        scenario: supplies durations and the probability of an echo.
    """

    def __init__(self, scenario: Any):
        self._stretches, self._step_s, self._echo = scenario.stretches, scenario.step_s, scenario.echo_probability

    def __call__(self, belief: RadarBelief, ahead: Ahead) -> Outlook:
        """Outlook; on a single scan, cases are whether an echo comes, not whether it could."""
        blocked = blocked_next(belief.blocked_probability, self._stretches, self._step_s)
        if ahead == (1, 1):
            return Outlook(1.0 - self._echo * (1.0 - blocked), np.ones((1, 1)), np.zeros((1, 1)))
        to_blocked, to_clear = self._stretches.leaving(self._step_s)
        clear = to_clear / (to_blocked + to_clear)
        same = (1.0 - to_blocked - to_clear) ** (ahead.scans * np.arange(ahead.instants)[:, None])
        return Outlook(blocked, self._echo * (clear + (1.0 - clear) * same), self._echo * clear * (1.0 - same))


class Durations:
    """What the belief that knows how long stretches last lets expect (`passive_env.renewal`).

    Args:
        scenario: supplies durations and the probability of an echo.
    """

    def __init__(self, scenario: Any):
        self._renewal = Renewal(scenario.stretches, scenario.step_s, scenario.echo_probability)
        self._echo = scenario.echo_probability
        self._tables: dict[Ahead, np.ndarray] = {}

    def __call__(self, belief: RadarBelief, ahead: Ahead) -> Outlook:
        """Outlook; on a single scan, cases are whether an echo comes, not whether it could."""
        e, n = belief.stretch.shape[:2]
        expected = belief.stretch.reshape(e, n, -1) @ self._table(ahead)
        blocked, both = expected[..., 0], np.moveaxis(expected[..., 1:], -1, 1)
        if ahead == (1, 1):
            return Outlook(1.0 - self._echo * (1.0 - blocked), np.ones((1, 1)), np.zeros((1, 1)))
        if_clear = both[:, : ahead.instants] / np.maximum(1.0 - blocked, 1e-12)[:, None]
        if_blocked = both[:, ahead.instants :] / np.maximum(blocked, 1e-12)[:, None]
        return Outlook(blocked, self._echo * np.minimum(if_clear, 1.0), self._echo * np.minimum(if_blocked, 1.0))

    def _table(self, ahead: Ahead) -> np.ndarray:
        """Columns of `Renewal.outlook_table`; an instant has the mean of the scans for which it stands."""
        if ahead not in self._tables:
            table = self._renewal.outlook_table(np.arange(ahead.instants * ahead.scans))
            means = table[:, 1:].reshape(len(table), 2 * ahead.instants, ahead.scans).mean(axis=2)
            self._tables[ahead] = np.column_stack([table[:, :1], means])
        return self._tables[ahead]


class Foresight:
    """Probabilities [e, n, q] of being clear so many scans on, by the belief that knows how long stretches last.

    Args:
        scenario: supplies durations and the probability of an echo.
        scans: [q] each at least 1.
    """

    def __init__(self, scenario: Any, scans: Sequence[int]):
        renewal = Renewal(scenario.stretches, scenario.step_s, scenario.echo_probability)
        table = renewal.outlook_table(np.array(scans) - 1)[:, 1:]
        self._table = table[:, : len(scans)] + table[:, len(scans) :]

    def __call__(self, belief: RadarBelief) -> np.ndarray:
        """[e, n, q] of beliefs."""
        e, n = belief.stretch.shape[:2]
        return belief.stretch.reshape(e, n, -1) @ self._table


# -- promises ----------------------------------------------------------------------------------------------------------


def straight_on(state: np.ndarray, times_s: np.ndarray) -> np.ndarray:
    """Places [e, h, d] at times [h] from now of states [e, 2d] that do not turn."""
    d = state.shape[-1] // 2
    return state[:, None, :d] + times_s[:, None] * state[:, None, d:]


class SumPrediction:
    """What combinations of transmitters promise if they are listened to in all of the scans to come.

    Args:
        scenario: supplies noise, combinations and scans.
        scans: looked ahead.
        criterion: one of `CRITERIA_SUMS`.
        together: scans that are taken as one, to save time; `scans` is a multiple of it.
        cases: weigh all cases of who is blocked, or only the one in between.
    Raises:
        ValueError: numbers of scans that are not positive integers, or do not fit; an unknown criterion.
    """

    def __init__(
        self, scenario: Any, scans: int = 1, criterion: str = "log_position_std", together: int = 1, cases: bool = True
    ):
        for name, value in (("scans", scans), ("together", together)):
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
                raise ValueError(f"{name} = {value!r}: must be an integer of at least 1")
        if scans % together:
            raise ValueError(f"scans = {scans}: must be a multiple of together = {together}")
        if criterion not in CRITERIA_SUMS:
            raise ValueError(f"criterion {criterion!r}: must be one of {', '.join(CRITERIA_SUMS)}")
        self.ahead = Ahead(int(scans // together), int(together))
        self.times_s = scenario.step_s * together * np.arange(1, self.ahead.instants + 1)
        self._combinations = np.ascontiguousarray(scenario.combinations, dtype=np.int64)
        noise = (scenario.range_sum_std_m, scenario.std_range_m, scenario.std_floor_m)
        rest = (CRITERIA_SUMS.index(criterion), cases, together)
        self._limits = np.array([scenario.step_s, *noise, *rest], dtype=float)
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
        path = straight_on(belief.mean[:, 0], self.times_s) if path is None else path
        receiver = straight_on(belief.platforms[:, 0], self.times_s) if receiver is None else receiver
        shape = (len(belief.mean), self.ahead.instants, belief.transmitters.shape[1])
        shares = (np.broadcast_to(part, shape) for part in (outlook.if_clear, outlook.if_blocked))
        wait = belief.wait_s if waits else np.zeros_like(belief.wait_s)
        columns = (belief.cov[:, 0], path, receiver, belief.transmitters, wait, outlook.blocked, *shares)

        def weigh(rows: slice) -> np.ndarray:
            return _promises(*(part[rows] for part in columns), self._combinations, self._limits, self._noise)

        blocks = Blocks(len(belief.mean), block=BLOCK)
        return np.concatenate(blocks.map(weigh, blocks.slices))


class Promise:
    """Logarithm of the error [e, c] that every combination promises if it is kept, by the belief alone.

    Args:
        scenario: what is acted in.
        scans: for how long it is kept; of more than three, two are taken as one.
        durations_known: by the belief that knows how long stretches last.
    """

    def __init__(self, scenario: Any, scans: int, durations_known: bool = False):
        together = 2 if scans > 3 and scans % 2 == 0 else 1
        self._prediction = SumPrediction(scenario, scans, together=together, cases=scans == 1)
        self._outlook = Durations(scenario) if durations_known else Blockage(scenario)

    def __call__(self, belief: RadarBelief) -> np.ndarray:
        """[e, c] of beliefs."""
        return self._prediction(belief, self._outlook(belief, self._prediction.ahead))
