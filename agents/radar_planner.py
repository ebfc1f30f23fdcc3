"""A planner for passive radar: it imagines how listening to each combination would go on.

From every candidate whole courses of events are drawn by the belief: who is blocked, becomes so and becomes clear
again, whose echoes come. What the receiver would do meanwhile is a simple rule that knows no more than the operator:
it gives up whom it takes for blocked, and tunes to the one that promises most instead. The candidate with the least
mean log error is chosen, and all is planned anew at the next scan.

Source: rollout after Bertsekas, "Rollout Algorithms for Stochastic Scheduling Problems", Journal of Heuristics 5, 1999.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from agents.policy import Policy
from agents.radar_policies import Selection
from passive_env.blockage import blocked_next, predict_blocked, update_blocked
from passive_env.radar_promise import BLOCK, criterion_of, lay_out, straight_on
from passive_env.radar_sensors import RadarBelief
from trackers.axis_motion import add_axis_noise, move_axes
from trackers.compiled import Blocks, helper, kernel
from trackers.range_sum import absorb_sum, sum_spread


@helper
def _worth(P, row, var, blocked, d):
    """Variance of a range sum that the track leaves, in units of the noise, times the chance to hear it."""
    return (1.0 - blocked) * sum_spread(P, row, d) / var


@helper
def _give_up(P, rows, var, blocked, member, wait, delay, threshold, d):
    """Replace members that are believed to be blocked, in place."""
    for m in range(member.shape[0]):
        if blocked[member[m]] > threshold:
            best, most = member[m], _worth(P, rows[member[m]], var[member[m]], blocked[member[m]], d)
            for i in range(rows.shape[0]):
                taken = False
                for q in range(member.shape[0]):
                    taken = taken or member[q] == i
                worth = _worth(P, rows[i], var[i], blocked[i], d)
                if not taken and worth > most:
                    best, most = i, worth
            wait[member[m]] = delay if best != member[m] else wait[member[m]]
            member[m] = best


@helper
def _would_answer(uniforms, blocked, to_blocked, to_clear, echo):
    """Whose echoes would come, [s, h, n], whoever is listened to: nobody's choice blocks anybody."""
    samples, h, n = uniforms.shape[0], uniforms.shape[1], uniforms.shape[2]
    answers = np.empty((samples, h, n), dtype=np.bool_)
    for s in range(samples):
        for i in range(n):
            share = blocked[i]
            for j in range(h):
                hidden = uniforms[s, j, i, 0] < share
                answers[s, j, i] = not hidden and uniforms[s, j, i, 1] < echo
                share = 1.0 - to_clear if hidden else to_blocked
    return answers


@helper
def _imagine_in(d, P, path, receivers, sites, wait, blocked, uniforms, combinations, limits, noise, cost):
    h, n, k, T = path.shape[0], sites.shape[0], combinations.shape[1], limits[0]
    echo, to_blocked, to_clear, delay, threshold = limits[4], limits[5], limits[6], limits[7], limits[8]
    rows, var, x = np.empty((h, n, d)), np.empty((h, n)), np.zeros((2, 2 * d))
    now, trial, member = np.empty((2, n)), np.empty((2 * d, 2 * d)), np.empty(k, dtype=np.int64)
    belief, left = now[0], now[1]
    answers = _would_answer(uniforms, blocked, to_blocked, to_clear, echo)
    for j in range(h):
        lay_out(path[j], receivers[j], sites, limits, rows[j], var[j], d)
    for c in range(combinations.shape[0]):
        cost[c] = 0.0
        for s in range(uniforms.shape[0]):
            trial[:], belief[:], left[:], member[:] = P, blocked, delay, combinations[c]
            for m in range(k):
                left[member[m]] = wait[member[m]]
            for j in range(h):
                move_axes(x[0], trial, T, d)
                add_axis_noise(trial, T, noise, 1.0, d)
                if j > 0:
                    for i in range(n):
                        belief[i] = predict_blocked(belief[i], to_blocked, to_clear)
                    _give_up(trial, rows[j], var[j], belief, member, left, delay, threshold, d)
                for m in range(k):
                    i = member[m]
                    left[i] = max(left[i] - T, 0.0)
                    if left[i] < 1e-6 * T:
                        if answers[s, j, i]:
                            absorb_sum(trial, rows[j, i], var[j, i], x[1], d, 2 * d)
                        belief[i] = update_blocked(belief[i], answers[s, j, i], 1.0 - echo)
                cost[c] += criterion_of(trial, d, 1) / (h * uniforms.shape[0])


@kernel("(y,y),(h,d),(h,d),(n,d),(n),(n),(s,h,n,r),(c,k),(l),(w)->(c)", "FFFFFFFIFFF")
def _imagine(P, path, receivers, sites, wait, blocked, uniforms, combinations, limits, noise, cost):
    if path.shape[1] == 2:  # a number that the compiler knows halves the time
        _imagine_in(2, P, path, receivers, sites, wait, blocked, uniforms, combinations, limits, noise, cost)
    else:
        _imagine_in(3, P, path, receivers, sites, wait, blocked, uniforms, combinations, limits, noise, cost)


class Planner(Selection):
    """Listens to the combination from which imagined courses of events go on best.

    Args:
        scenario: what to act in.
        scans: looked ahead.
        samples: courses of events per combination, the same random numbers for all.
        threshold: probability of being blocked beyond which the imagined receiver gives a transmitter up.
        seed: of the random numbers.
    Raises:
        ValueError: numbers that are not positive integers, or a threshold outside (0, 1).
    """

    def __init__(self, scenario: Any, scans: int = 10, samples: int = 32, threshold: float = 0.7, seed: int = 0):
        super().__init__(scenario)
        s = scenario
        for name, value in (("scans", scans), ("samples", samples)):
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
                raise ValueError(f"{name} = {value!r}: must be an integer of at least 1")
        if not 0.0 < threshold < 1.0:
            raise ValueError(f"threshold = {threshold!r}: must lie in (0, 1)")
        self._times = s.step_s * np.arange(1, scans + 1)
        rng = np.random.default_rng(seed)
        strata = rng.permuted(np.tile(np.arange(samples)[:, None], scans * s.pool * 2), axis=0)
        uniforms = (strata + rng.random(strata.shape)) / samples  # as evenly spread as so few can be
        self._uniforms = uniforms.reshape(samples, scans, s.pool, 2)
        noise = (s.range_sum_std_m, s.std_range_m, s.std_floor_m)
        chain = s.stretches.leaving(s.step_s)
        self._limits = np.array([s.step_s, *noise, s.echo_probability, *chain, s.retune_delay_s, threshold])
        self._noise = np.array(s.process_noise)
        self._candidates = np.ascontiguousarray(s.combinations, dtype=np.int64)

    def costs(self, belief: RadarBelief) -> np.ndarray:
        """Mean log error [e, c] of the courses of events that begin with every combination."""
        s = self._scenario
        columns = (
            belief.cov[:, 0], straight_on(belief.mean[:, 0], self._times),
            straight_on(belief.platforms[:, 0], self._times), belief.transmitters, belief.wait_s,
            blocked_next(belief.blocked_probability, s.stretches, s.step_s),
        )  # fmt: skip

        def weigh(rows: slice) -> np.ndarray:
            own = (part[rows] for part in columns)
            return _imagine(*own, self._uniforms, self._candidates, self._limits, self._noise)

        blocks = Blocks(len(belief.mean), block=BLOCK)
        return np.concatenate(blocks.map(weigh, blocks.slices))

    def choose(self, belief: RadarBelief) -> np.ndarray:
        """Numbers [e] of the combinations to listen to."""
        return self.costs(belief).argmin(axis=1)


RADAR_PLANNERS: dict[str, Callable[[Any, int], Policy]] = {
    "planner": lambda scenario, seed: Planner(scenario, seed=seed)
}
"""Makers (scenario, seed) of planners for receivers that stand."""
