"""What a plan of headings or turns would do to the tracks: their covariance is predicted along imagined flights.

Targets follow given paths (the tracks' means at constant velocity, unless someone knows better), platforms fly the
plan along true arcs, and the filter's own covariance recursion runs with every bearing linearised on the paths. A
plan's cost is the logarithm of an error figure [nepers] plus penalties for coming too near.

Source: covariance recursion as in `trackers.bounds` (Tichavský et al. 1998, with predicted in place of true states);
observer maneuvers by predicted information after Passerieux and Van Cappel, "Optimal observer maneuver for
bearings-only tracking", IEEE Trans. Aerospace and Electronic Systems 34(3), 1998.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from passive_env.belief import Belief
from trackers.angles import wrap, wrap_scalar
from trackers.bounds import range_variance
from trackers.compiled import Blocks, helper, kernel
from trackers.linalg import cholesky_4
from trackers.measurement import condition_into, slope
from trackers.motion import predict_in_place

CRITERIA = ("range_std", "range_variance", "trace", "log_determinant", "mean_log_std")
"""What a plan minimises. At the plan's end, summed over tracks, then the logarithm: range standard deviation [m],
range variance [m²], trace of the position covariance [m²]. At the end, summed over tracks: half the log-determinant of
the covariance. Along the way: log range standard deviation, averaged over time and summed over tracks."""

_RANGE_STD, _RANGE_VARIANCE, _TRACE, _LOG_DETERMINANT, _MEAN_LOG_STD = range(len(CRITERIA))

CONTROLS = ("headings", "turns")
"""What the numbers of a plan are: headings [rad] to turn to at the limit, or turn rates held, as shares in [−1, 1]."""

GUARD_PER_S, STANDOFF_PER_S = 1.0, 10.0
"""Penalties [nepers per second and unit depth] for being within the guard, and within a stand-off ring or disc. Depth
grows from 0 at the edge to 1 at the middle. The guard bends a plan, the others are all but forbidden."""

WORST = 1e6
"""Cost of a plan whose prediction is no finite number."""


class Situation(NamedTuple):
    """Where a plan begins; e environments, s platforms, m tracks.

    Attributes:
        platforms: [e, s, 4] x, y [m], vx, vy [m/s].
        paths: [e, k, m, 2] target positions [m] after 1 … k steps.
        cov: [e, m, 4, 4] covariances now.
        discs: [e, d, 3] no-go discs: x, y, radius [m].
        steps: [e] steps to look ahead, at most k.
    """

    platforms: Any
    paths: Any
    cov: Any
    discs: Any
    steps: Any

    def rows(self, index: Any) -> Situation:
        """The situations of some environments."""
        return Situation(*(part[index] for part in self))


def situation(belief: Belief, step_s: float, horizon: int) -> Situation:
    """What the belief says: tracks fly on at their mean velocities.

    Args:
        belief: of e environments.
        step_s: s.
        horizon: steps to look ahead, fewer where the episode ends before.
    """
    steps = np.clip(belief.steps_left, 1, horizon)
    times = step_s * np.arange(1, int(steps.max(initial=1)) + 1)[:, None, None]
    paths = belief.mean[:, None, :, :2] + times * belief.mean[:, None, :, 2:]
    return Situation(belief.platforms, paths, belief.cov, belief.discs, steps)


@helper
def _fly(state, turned, T):
    """Move a platform [4] along an arc of T seconds that turns it by `turned` rad (`passive_env.kinematics.arc`)."""
    vx, vy = state[2], state[3]
    along, across = T, 0.0
    if abs(turned) > 1e-9:
        c, s = math.cos(turned), math.sin(turned)
        along, across = T * s / turned, T * (1.0 - c) / turned
        state[2], state[3] = c * vx - s * vy, s * vx + c * vy
    state[0] += along * vx - across * vy
    state[1] += along * vy + across * vx


@helper
def _depth(dx, dy, radius):
    """How deep a point lies within a circle, 0 at its edge or outside, 1 in the middle."""
    d2 = dx * dx + dy * dy
    return 1.0 - math.sqrt(d2) / max(radius, 1.0) if d2 < radius * radius else 0.0


@helper
def _intrusion(platforms, targets, discs, guard, guard_cost, standoff, standoff_cost):
    """Penalty per second of all platforms' places."""
    total = 0.0
    for s in range(platforms.shape[0]):
        x, y = platforms[s, 0], platforms[s, 1]
        for m in range(targets.shape[0]):
            dx, dy = x - targets[m, 0], y - targets[m, 1]
            total += guard_cost * _depth(dx, dy, guard) + standoff_cost * _depth(dx, dy, standoff)
        for d in range(discs.shape[0]):
            total += standoff_cost * _depth(x - discs[d, 0], y - discs[d, 1], discs[d, 2])
    return total


@helper
def _half_log_det(P):
    l00, _, l11, _, _, l22, _, _, _, l33 = cholesky_4(P)
    return math.log(l00) + math.log(l11) + math.log(l22) + math.log(l33)


@helper
def _figure(P, target, platform, criterion):
    """One track's part of the criterion."""
    if criterion == 2:
        return P[0, 0] + P[1, 1]
    if criterion == 3:
        return _half_log_det(P)
    variance = range_variance(P, target[0], target[1], platform[0], platform[1])
    if criterion == 4:
        return 0.5 * math.log(max(variance, 1.0))
    return math.sqrt(variance) if criterion == 0 else variance


@kernel("(s,x),(k,m,p),(m,x,x),(d,r),(),(g,s),(g),(l)->()", "ffffififf")
def _plan_cost(platforms, paths, cov, discs, steps, controls, ends, model, cost):
    T, limit, q, var = model[0], model[1], model[2], model[3]
    first, criterion, turns = int(model[4]), int(model[5]), model[6] > 0.0
    n, reference = cov.shape[0], platforms.shape[0] - 1
    state, P, still = platforms.copy(), cov.copy(), np.zeros(4)
    heading = np.empty(platforms.shape[0])
    for s in range(platforms.shape[0]):
        heading[s] = math.atan2(platforms[s, 3], platforms[s, 2])
    leg, penalty, figure = 0, 0.0, 0.0
    for k in range(steps):
        while leg < ends.shape[0] - 1 and k >= ends[leg]:
            leg += 1
        for s in range(platforms.shape[0]):
            if turns:
                turned = controls[leg, s] * limit
            else:
                turned = min(max(wrap_scalar(controls[leg, s] - heading[s]), -limit), limit)
            _fly(state[s], turned, T)
            heading[s] += turned
        penalty += T * _intrusion(state, paths[k], discs, model[7], model[8], model[9], model[10])
        for m in range(n):
            predict_in_place(still, P[m], T, q)
            for s in range(first, platforms.shape[0]):
                a, b = slope(paths[k, m, 0], paths[k, m, 1], state[s, 0], state[s, 1])
                condition_into(still, P[m], 0.0, a, b, var, still, P[m])
            if criterion == 4 or k == steps - 1:
                figure += _figure(P[m], paths[k, m], state[reference], criterion)
    if criterion == 4:
        figure /= steps
    elif criterion < 3:
        figure = math.log(max(figure, 1.0))
    total = figure + penalty
    cost[0] = total if abs(total) < WORST else WORST


class Prediction:
    """Costs of plans in a scenario.

    Args:
        scenario: supplies step, turn limit, noises, whose bearings count and the stand-off distance.
        criterion: one of `CRITERIA`.
        guard_m: predicted ranges below this are penalised: bearings-only filters break down in close passes.
        controls: one of `CONTROLS`.
    Raises:
        ValueError: unknown criterion or controls, negative or infinite guard.
    """

    def __init__(
        self, scenario: Any, criterion: str = "mean_log_std", guard_m: float = 8e3, controls: str = "headings"
    ):
        if criterion not in CRITERIA:
            raise ValueError(f"criterion {criterion!r}: must be one of {', '.join(map(repr, CRITERIA))}")
        if controls not in CONTROLS:
            raise ValueError(f"controls {controls!r}: must be one of {', '.join(map(repr, CONTROLS))}")
        if not 0.0 <= guard_m < math.inf:
            raise ValueError(f"guard_m = {guard_m!r}: must be a distance of at least 0 m")
        self.step_s = float(scenario.step_s)
        self.turn_per_step = math.radians(scenario.max_turn_rate_deg_s) * self.step_s
        std = math.radians(scenario.bearing_std_deg) / math.sqrt(scenario.detection_probability)
        self._reference_only = scenario.bearings == "reference"
        self._settings = (
            self.step_s, self.turn_per_step, float(scenario.process_noise_m_s), std * std,
            CRITERIA.index(criterion), float(controls == "turns"), float(guard_m), GUARD_PER_S,
            float(scenario.standoff_m), STANDOFF_PER_S,
        )  # fmt: skip

    def cost(self, start: Situation, controls: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Costs [e, c] in nepers of c plans for each of e environments, in one compiled call.

        Args:
            start: where the plans begin.
            controls: [e, c, g, s] headings [rad] or turn rates in [−1, 1] of g legs.
            ends: [e, c, g] step at which a leg ends; the last leg lasts to the end.
        """
        model = self._model(start.platforms.shape[1])
        blocks = Blocks(len(controls))

        def run(rows: slice) -> np.ndarray:
            begin = [part[rows, None] for part in start]
            with np.errstate(all="ignore"):  # a diverged track costs `WORST`
                return _plan_cost(*begin, controls[rows], ends[rows], model)

        return np.concatenate(blocks.map(run, blocks.slices))

    def _model(self, stations: int) -> np.ndarray:
        """Numbers the kernel reads, in its order."""
        T, limit, q, var, *rest = self._settings
        return np.array([T, limit, q, var, stations - 1 if self._reference_only else 0, *rest])


def towards(headings: np.ndarray, platforms: np.ndarray, turn_per_step: float) -> np.ndarray:
    """Commands [..., s] in [−1, 1] that turn platforms [..., s, 4] towards headings [..., s] rad, then hold them."""
    heading = np.arctan2(platforms[..., 3], platforms[..., 2])
    return np.clip(wrap(headings - heading) / max(turn_per_step, 1e-12), -1.0, 1.0)


def line_of_sight(platforms: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Directions [..., s] rad from platforms [..., s, 4] to the middle of tracks [..., m, 4]."""
    to_middle = mean[..., None, :, :2].mean(-2) - platforms[..., :2]
    return np.arctan2(to_middle[..., 1], to_middle[..., 0])
