"""What the agent earns: weighted terms, each a pure function of one instant with a unit. Truth may be used here.

A term maps a `Moment` to [e] numbers; larger is better. The scenario holds the weights; terms of weight 0 are not
computed, and every weighted one appears in ``info["reward_terms"]``. `log_position_bound` and `position_gain` are for
scenarios whose metrics have that bound, `turn_position_error` and `acceleration_error` for those with a maneuvering
target, those of horizontal and height errors for a passive radar.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from passive_env.metrics import Violations
from trackers.compiled import kernel


class Moment(NamedTuple):
    """All that a reward may depend on.

    Attributes:
        metrics, previous: figures of merit now and one step earlier, each [e, m].
        violations: intrusions into stand-off rings and no-go discs, each [e].
        command: [e, a] in [−1, 1].
        final: [e] bool, the episode's last step.
    """

    metrics: Any
    previous: Any
    violations: Violations
    command: Any
    final: Any


@kernel("(m),()->()")
def _mean_log(value, floor, out):
    total = 0.0
    for m in range(value.shape[0]):
        total += math.log(max(value[m], floor))
    out[0] = total / value.shape[0]


@kernel("(m),(m)->()")
def _mean_ratio(numerator, denominator, out):
    total = 0.0
    for m in range(numerator.shape[0]):
        total += min(numerator[m] / max(denominator[m], 1.0), 10.0)
    out[0] = total / numerator.shape[0]


@kernel("(m),()->()")
def _mean_cut(value, unit, out):
    total = 0.0
    for m in range(value.shape[0]):
        total += min(value[m] / unit, 10.0)
    out[0] = total / value.shape[0]


ERROR_FLOOR_M = 30.0
"""Errors below this earn no further log reward: luck of one draw, not geometry."""


def log_range_error(moment: Moment):
    """−log(range error / 1 km), mean over targets, errors floored at 30 m [nepers]."""
    return math.log(1e3) - _mean_log(moment.metrics.range_error_m, ERROR_FLOOR_M)


def relative_range_error(moment: Moment):
    """−range error / range, mean over targets, each at most 10 [1]."""
    return -_mean_ratio(moment.metrics.range_error_m, moment.metrics.range_m)


def range_error(moment: Moment):
    """−range error, mean over targets, each at most 100 km [10 km]: what a time-averaged error adds up."""
    return -_mean_cut(moment.metrics.range_error_m, 1e4)


def final_range_error(moment: Moment):
    """`range_error` at the episode's last step, 0 before [10 km]."""
    return np.where(moment.final, range_error(moment), 0.0)


def position_error(moment: Moment):
    """−position error, mean over targets, each at most 10 km [1 km]."""
    return -_mean_cut(moment.metrics.position_error_m, 1e3)


def final_position_error(moment: Moment):
    """`position_error` at the episode's last step, 0 before [1 km]."""
    return np.where(moment.final, position_error(moment), 0.0)


def log_position_error(moment: Moment):
    """−log(position error / 1 km), mean over targets, errors floored at 30 m [nepers]."""
    return math.log(1e3) - _mean_log(moment.metrics.position_error_m, ERROR_FLOOR_M)


def final_log_position_error(moment: Moment):
    """`log_position_error` at the episode's last step, 0 before [nepers]."""
    return np.where(moment.final, log_position_error(moment), 0.0)


def position_gain(moment: Moment):
    """Decrease of log position bound over the step, mean over targets [nepers]."""
    return _mean_log(moment.previous.position_crlb_m, 1.0) - _mean_log(moment.metrics.position_crlb_m, 1.0)


def relative_position_error(moment: Moment):
    """−position error / range, mean over targets, each at most 10 [1]."""
    return -_mean_ratio(moment.metrics.position_error_m, moment.metrics.range_m)


def log_position_bound(moment: Moment):
    """−log(position bound / 1 km), mean over targets: the geometry's quality without the draw's luck [nepers]."""
    return math.log(1e3) - _mean_log(moment.metrics.position_crlb_m, 1.0)


def log_horizontal_error(moment: Moment):
    """−log(horizontal error / 1 km), mean over targets, errors floored at 30 m [nepers]."""
    return math.log(1e3) - _mean_log(moment.metrics.horizontal_error_m, ERROR_FLOOR_M)


def horizontal_error(moment: Moment):
    """−horizontal error, mean over targets, each at most 10 km [1 km]."""
    return -_mean_cut(moment.metrics.horizontal_error_m, 1e3)


def height_error(moment: Moment):
    """−error of the height, mean over targets, each at most 10 km [1 km]."""
    return -_mean_cut(moment.metrics.height_error_m, 1e3)


def log_horizontal_bound(moment: Moment):
    """−log(horizontal bound / 1 km), mean over targets: the geometry's quality without the draw's luck [nepers]."""
    return math.log(1e3) - _mean_log(moment.metrics.horizontal_crlb_m, 1.0)


def turn_position_error(moment: Moment):
    """`position_error` of targets that maneuver, 0 for the others, mean over targets [1 km]."""
    return -_mean_cut(np.where(moment.metrics.maneuvering, moment.metrics.position_error_m, 0.0), 1e3)


def acceleration_error(moment: Moment):
    """−error of the estimated acceleration, mean over targets, each at most 100 m/s² [10 m/s²]."""
    return -_mean_cut(moment.metrics.acceleration_error_m_s2, 10.0)


def log_range_bound(moment: Moment):
    """−log(range bound / 1 km), mean over targets: the geometry's quality without the draw's luck [nepers]."""
    return math.log(1e3) - _mean_log(moment.metrics.range_crlb_m, 1.0)


def final_log_range_bound(moment: Moment):
    """`log_range_bound` at the episode's last step, 0 before [nepers]."""
    return np.where(moment.final, log_range_bound(moment), 0.0)


def information_gain(moment: Moment):
    """Decrease of log range bound over the step, mean over targets [nepers]."""
    return _mean_log(moment.previous.range_crlb_m, 1.0) - _mean_log(moment.metrics.range_crlb_m, 1.0)


def maneuver(moment: Moment):
    """−mean square command: 1 is every platform turning at its limit [1]."""
    return -np.square(moment.command).mean(axis=-1)


def standoff(moment: Moment):
    """−Σ over platform–target pairs of the relative depth of intrusion into the stand-off ring [1]."""
    return -moment.violations.standoff


def nogo(moment: Moment):
    """−Σ over platform–disc pairs of the relative depth of intrusion into the no-go disc [1]."""
    return -moment.violations.nogo


def lost_track(moment: Moment):
    """−share of lost tracks [1]."""
    return -moment.metrics.lost.mean(axis=-1)


TERMS: dict[str, Callable[[Moment], Any]] = {
    term.__name__: term
    for term in (
        log_range_error,
        relative_range_error,
        range_error,
        final_range_error,
        log_range_bound,
        final_log_range_bound,
        information_gain,
        maneuver,
        standoff,
        nogo,
        lost_track,
        log_position_error,
        final_log_position_error,
        position_gain,
        relative_position_error,
        position_error,
        final_position_error,
        log_position_bound,
        turn_position_error,
        acceleration_error,
        log_horizontal_error,
        horizontal_error,
        height_error,
        log_horizontal_bound,
    )
}
"""All reward terms by name."""


def evaluate(weights: Mapping[str, float], moment: Moment) -> tuple[Any, dict[str, Any]]:
    """Total reward [e] and its weighted terms, each [e]."""
    terms = {name: weight * TERMS[name](moment) for name, weight in weights.items()}
    total = sum(terms.values(), start=np.zeros(len(moment.command)))
    return total, terms
