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

from agents.steering import level_flight
from passive_env.belief import Belief
from passive_env.core import World
from passive_env.kinematics import fly_legs
from passive_env.steering import course, towards
from trackers.compiled import Blocks, helper, kernel
from trackers.linalg import cholesky_4
from trackers.measurement import NOISE_FLOOR, slope

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

LARGE_PRODUCT = 1e200
"""Variances [m²] multiplied beyond this are replaced by their logarithm: another factor must not overflow."""

LARGEST = 1e24
"""Variances [m²] are cut here: a diverged track's must not overflow a product of several."""

WORST = 1e6
"""Cost of a plan whose prediction is no finite number."""


class Situation(NamedTuple):
    """Where a plan begins; e environments, s platforms, m tracks.

    Attributes:
        platforms: [e, s, n] as in `passive_env.belief.Belief`.
        paths: [e, k, m, n / 2] target positions [m] after 1 … k steps.
        cov: [e, m, n, n] covariances now.
        discs: [e, d, 3] no-go discs: x, y, radius [m].
        steps: [e] steps to look ahead, at most k.
        share: [e, s] share of scans in which a platform is expected to see the target; in the plane the scenario says.
    """

    platforms: Any
    paths: Any
    cov: Any
    discs: Any
    steps: Any
    share: Any = None

    def rows(self, index: Any) -> Situation:
        """The situations of some environments."""
        return Situation(*(None if part is None else part[index] for part in self))


def situation(belief: Belief, step_s: float, horizon: int) -> Situation:
    """What the belief says: tracks fly on at their mean velocities.

    Args:
        belief: of e environments.
        step_s: s.
        horizon: steps to look ahead, fewer where the episode ends before.
    """
    steps = np.clip(belief.steps_left, 1, horizon)
    times = step_s * np.arange(1, int(steps.max(initial=1)) + 1)[:, None, None]
    place = belief.mean.shape[-1] // 2
    paths = belief.mean[:, None, :, :place] + times * belief.mean[:, None, :, place:]
    return Situation(belief.platforms, paths, belief.cov, belief.discs, steps)


@helper
def _depth(dx, dy, radius):
    """How deep a point lies within a circle, 0 at its edge or outside, 1 in the middle."""
    d2 = dx * dx + dy * dy
    return 1.0 - math.sqrt(d2) / max(radius, 1.0) if d2 < radius * radius else 0.0


@helper
def intrusion(platforms, targets, discs, guard, guard_cost, standoff, standoff_cost):
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
def predict_numbers(P, T, q):
    """`trackers.motion.predict_in_place` of a covariance given by its ten numbers, row by row."""
    p00, p01, p02, p03, p11, p12, p13, p22, p23, p33 = P
    q2 = q * q
    half, quarter = 0.5 * T * q2, 0.25 * T * T * q2
    c02, c03, c12, c13 = p02 + T * p22, p03 + T * p23, p12 + T * p23, p13 + T * p33
    p00 += T * (p02 + c02) + quarter
    p01 += T * (p12 + c03)
    p11 += T * (p13 + c13) + quarter
    return p00, p01, c02 + half, c03, p11, c12, c13 + half, p22 + q2, p23, p33 + q2


@helper
def _condition(P, a, b, var):
    """P − PHᵀ (HPHᵀ + σ²)⁻¹ HP for H = [a, b, 0, 0], ten numbers in, ten out.

    The short form: a filter's covariance needs the Joseph form's care, a forecast that lasts an episode does not.
    """
    p00, p01, p02, p03, p11, p12, p13, p22, p23, p33 = P
    f0, f1, f2, f3 = a * p00 + b * p01, a * p01 + b * p11, a * p02 + b * p12, a * p03 + b * p13
    hph = a * f0 + b * f1
    per_S = 1.0 / (hph + max(var, NOISE_FLOOR * hph))
    k0, k1, k2, k3 = f0 * per_S, f1 * per_S, f2 * per_S, f3 * per_S
    return (
        p00 - k0 * f0, p01 - k0 * f1, p02 - k0 * f2, p03 - k0 * f3, p11 - k1 * f1,
        p12 - k1 * f2, p13 - k1 * f3, p22 - k2 * f2, p23 - k2 * f3, p33 - k3 * f3,
    )  # fmt: skip


@helper
def _range_variance(P, target, platform):
    """`trackers.bounds.range_variance` of a covariance given by its ten numbers."""
    dx, dy = target[0] - platform[0], target[1] - platform[1]
    r2 = max(dx * dx + dy * dy, 1.0)
    return max((dx * dx * P[0] + 2.0 * dx * dy * P[1] + dy * dy * P[4]) / r2, 0.0)


@helper
def _half_log_det(P):
    """Half the log-determinant of a covariance given by its ten numbers."""
    full = np.empty((4, 4))
    i = 0
    for r in range(4):
        for c in range(r, 4):
            full[r, c] = full[c, r] = P[i]
            i += 1
    l00, _, l11, _, _, l22, _, _, _, l33 = cholesky_4(full)
    return math.log(l00) + math.log(l11) + math.log(l22) + math.log(l33)


@helper
def _scan(P, target, platforms, T, q, var, first):
    """Covariance after a step and the bearings of platforms [s, 2] from `first` on."""
    P = predict_numbers(P, T, q)
    for s in range(first, platforms.shape[0]):
        a, b = slope(target[0], target[1], platforms[s, 0], platforms[s, 1])
        P = _condition(P, a, b, var)
    return P


@helper
def _figure(P, target, platform, criterion):
    """One track's part of a criterion of the plan's end."""
    if criterion == 3:
        return _half_log_det(P)
    if criterion == 2:
        return P[0] + P[4]
    variance = _range_variance(P, target, platform)
    return math.sqrt(variance) if criterion == 0 else variance


@helper
def _two_figures(cov, path, flights, steps, T, q, var, first, criterion):
    """One track's part of the criterion for a path [k, 2] seen by two plans' platforms, flights [2, k, s, 2].

    Two recursions side by side: each waits for its own divisions, so that together they take little longer than one.
    """
    reference = flights.shape[2] - 1
    P = Q = (
        cov[0, 0], cov[0, 1], cov[0, 2], cov[0, 3], cov[1, 1],
        cov[1, 2], cov[1, 3], cov[2, 2], cov[2, 3], cov[3, 3],
    )  # fmt: skip
    log_p = log_q = 0.0
    product_p = product_q = 1.0  # one logarithm for many factors
    for k in range(steps):
        P = _scan(P, path[k], flights[0, k], T, q, var, first)
        Q = _scan(Q, path[k], flights[1, k], T, q, var, first)
        if criterion == 4:
            product_p *= max(_range_variance(P, path[k], flights[0, k, reference]), 1.0)
            product_q *= max(_range_variance(Q, path[k], flights[1, k, reference]), 1.0)
            if max(product_p, product_q) > LARGE_PRODUCT:
                log_p, log_q = log_p + math.log(product_p), log_q + math.log(product_q)
                product_p = product_q = 1.0
    if criterion == 4:
        return 0.5 * (log_p + math.log(product_p)) / steps, 0.5 * (log_q + math.log(product_q)) / steps
    last = steps - 1
    return (
        _figure(P, path[last], flights[0, last, reference], criterion),
        _figure(Q, path[last], flights[1, last, reference], criterion),
    )


@helper
def _flight_cost(platforms, paths, discs, steps, controls, ends, model, flight):
    """Fly a plan with controls [g, s] and ends [g], filling flight [k, s, 2]; returns its penalties."""
    for s in range(platforms.shape[0]):
        fly_legs(platforms[s], controls[:, s], ends, steps, model[0], model[1], model[6] > 0.0, flight[:, s])
    penalty = 0.0
    for k in range(steps):
        penalty += intrusion(flight[k], paths[k], discs, model[7], model[8], model[9], model[10])
    return model[0] * penalty


@helper
def _total(figure, penalty, criterion):
    """A plan's cost from its tracks' figures and its penalties."""
    total = penalty + (math.log(max(figure, 1.0)) if criterion < 3 else figure)
    return total if abs(total) < WORST else WORST


@kernel("(s,x),(k,m,p),(m,x,x),(d,r),(),(c,g,s),(c,g),(l),(t,k,s,p)->(c)", "FFFFiFiFFF")
def _plan_costs(platforms, paths, cov, discs, steps, controls, ends, model, flights, cost):
    """Costs of c plans, two at a time. `flights` [2, k, s, 2] is scratch, shared by all items of a call."""
    T, q, var, first, criterion = model[0], model[2], model[3], int(model[4]), int(model[5])
    for one in range(0, cost.shape[0], 2):
        other = min(one + 1, cost.shape[0] - 1)  # an odd last one is its own partner
        penalty = _flight_cost(platforms, paths, discs, steps, controls[one], ends[one], model, flights[0])
        other_penalty = _flight_cost(platforms, paths, discs, steps, controls[other], ends[other], model, flights[1])
        figure = other_figure = 0.0
        for m in range(cov.shape[0]):
            f, g = _two_figures(cov[m], paths[:, m], flights, steps, T, q, var, first, criterion)
            figure, other_figure = figure + f, other_figure + g
        cost[one], cost[other] = _total(figure, penalty, criterion), _total(other_figure, other_penalty, criterion)


class Prediction:
    """Costs of plans in a scenario with bearings in the plane; other families derive theirs.

    Args:
        scenario: supplies step, turn limit, noises, whose bearings count and the stand-off distance.
        criterion: one of `criteria`; None is the family's usual one.
        guard_m: predicted ranges below this are penalised, for bearings-only filters break down in close passes; None
            is the family's usual one.
        controls: one of `CONTROLS`.
    Raises:
        ValueError: unknown criterion or controls, negative or infinite guard.
    """

    criteria = CRITERIA
    usual_criterion, usual_guard_m, usual_horizon, usual_headings = "mean_log_std", 8e3, 12, 24
    about_course = False
    """Whether headings are tried about the present course, as far as can be reached, or all about the line of sight."""
    stops_to_measure = False
    """Whether platforms measure only when they are slow."""

    def __init__(
        self, scenario: Any, criterion: str | None = None, guard_m: float | None = None, controls: str = "headings"
    ):
        criterion = self.usual_criterion if criterion is None else criterion
        guard_m = self.usual_guard_m if guard_m is None else guard_m
        if criterion not in self.criteria:
            raise ValueError(f"criterion {criterion!r}: must be one of {', '.join(map(repr, self.criteria))}")
        if controls not in CONTROLS:
            raise ValueError(f"controls {controls!r}: must be one of {', '.join(map(repr, CONTROLS))}")
        if not 0.0 <= guard_m < math.inf:
            raise ValueError(f"guard_m = {guard_m!r}: must be a distance of at least 0 m")
        self.step_s = float(scenario.step_s)
        self.turn_per_step = math.radians(scenario.max_turn_rate_deg_s) * self.step_s
        self._settings = (
            *self._numbers(scenario), float(self.criteria.index(criterion)), float(controls == "turns"),
            float(guard_m), GUARD_PER_S, float(scenario.standoff_m), STANDOFF_PER_S,
        )  # fmt: skip

    def situation(self, belief: Belief, horizon: int) -> Situation:
        """What the belief says (see `situation`)."""
        return situation(belief, self.step_s, horizon)

    def revealed(self, start: Situation, world: World) -> Situation:
        """The situation with the targets' true paths and the Cramér–Rao bound in place of the tracks' covariances."""
        last = world.tape.targets.shape[1] - 1
        at = np.minimum(world.step[:, None] + np.arange(1, start.paths.shape[1] + 1), last)
        paths = world.tape.targets[np.arange(len(at))[:, None], at, :, : start.paths.shape[-1]]
        return start._replace(paths=paths, cov=world.bound)

    def held(self, platforms: np.ndarray) -> np.ndarray:
        """Controls [e, a] by which platforms [e, s, n] go on as they do: their headings."""
        return course(platforms)

    def commands(self, controls: np.ndarray, belief: Belief) -> np.ndarray:
        """Commands [e, a] towards the controls [e, a] of a plan's present leg."""
        return level_flight(towards(controls, belief.platforms, self.turn_per_step), belief)

    def cost(self, start: Situation, controls: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Costs [e, c] in nepers of c plans for each of e environments, in one compiled call.

        Args:
            start: where the plans begin.
            controls: [e, c, g, s] headings [rad] or turn rates in [−1, 1] of g legs.
            ends: [e, c, g] step at which a leg ends; the last leg lasts to the end.
        """
        blocks = Blocks(len(controls))

        def run(rows: slice) -> np.ndarray:
            return self._costs(start.rows(rows), controls[rows], ends[rows])

        return np.concatenate(blocks.map(run, blocks.slices))

    def _numbers(self, scenario: Any) -> tuple[float, ...]:
        """The first numbers the family's kernel reads, in its order."""
        std = math.radians(scenario.bearing_std_deg) / math.sqrt(scenario.detection_probability)
        reference_only = float(scenario.bearings == "reference")
        return (self.step_s, self.turn_per_step, float(scenario.process_noise_m_s), std * std, reference_only)

    def _costs(self, start: Situation, controls: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Costs [e, c], on one thread."""
        stations = start.platforms.shape[1]
        model = np.array(self._settings)
        model[4] *= stations - 1  # the first station whose bearings count
        flights = np.empty((2, start.paths.shape[1], stations, 2))
        return _plan_costs(*start[:5], controls, ends, model, flights)
