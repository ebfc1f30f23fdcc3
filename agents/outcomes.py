"""What is kept of a policy's flights: its record, and of it the figures of every episode.

Errors, bounds and who was lost, with the scales by which a track counts as lost, collapsed or honest.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2

from agents.pictures import EpisodePaths
from passive_env.core import World

COLLAPSE_M = 15e3
COLLAPSE_LEVEL = 0.9999
"""A track that ends farther off than the one, or with a NEES above this quantile of an honest tracker's, has
collapsed."""

LATE_STEPS, LATE_ERROR_M = 5, 1e3
"""A track in space counts as lost if its position error averaged over the last steps exceeds this: Wang, Wang and Yang
(2004) as specified, "lost A"."""

PARTIAL = ("turn_position_error_m",)
"""Errors that not every episode has."""


class NeesScale(NamedTuple):
    """What an honest tracker's NEES would be: χ² with as many degrees of freedom as the state has numbers.

    Attributes:
        degrees: of freedom, also the mean.
        median: what half of them lie below.
        band: where 95 % of them lie.
        collapse: what 99.99 % of them lie below.
    """

    degrees: int
    median: float
    band: tuple[float, float]
    collapse: float


def nees_scale(degrees: int) -> NeesScale:
    """The scale of states of so many numbers."""
    low, high = chi2.ppf([0.025, 0.975], df=degrees)
    collapse = chi2.ppf(COLLAPSE_LEVEL, df=degrees)
    return NeesScale(degrees, float(chi2.median(df=degrees)), (float(low), float(high)), float(collapse))


@dataclass(frozen=True)
class Outcomes:
    """What tables are made of: a policy's figures of e episodes, without their course.

    Attributes:
        score: the error that counts, "range" or "position".
        errors: what policies are compared by, each [e] m (or m/s²): final and average errors, those of maneuvers, NaN
            in episodes without any; by name in reports.
        bounds: [e] m Cramér–Rao bounds at the end; by name in reports.
        lost, collapsed, nees, standoff, nogo, state_size, decision_time_us, lost_late: as in `Record`.
    """

    score: str
    errors: dict[str, np.ndarray]
    bounds: dict[str, np.ndarray]
    lost: np.ndarray
    collapsed: np.ndarray
    nees: np.ndarray
    standoff: np.ndarray
    nogo: np.ndarray
    state_size: int
    decision_time_us: float
    lost_late: Any = None

    @property
    def samples(self) -> dict[str, np.ndarray]:
        """The errors of the episodes that have them."""
        return {
            name: values[np.isfinite(values)] if name in PARTIAL else values for name, values in self.errors.items()
        }


@dataclass(frozen=True)
class Record:
    """What a policy achieved; e episodes, k steps.

    Where sensors are placed and then a track is run, errors and bounds have a column per scan (range_crlb_m only the
    last one), and `paths` is the first episode's last world.

    Attributes:
        range_error_m: [e, k + 1] mean over targets, index 0 before the first decision.
        range_crlb_m: [e, k + 1] the same of the posterior Cramér–Rao bound.
        lost, collapsed: [e] share of tracks at the end.
        decision_time_us: wall time of a decision per step and episode, in batches.
        paths: the first episode's geometry.
        nees: [e, m] normalised estimation error squared of every track at the end.
        off_sight_rad: [e, k + 1, s] each platform's course from its line of sight to the middle of the true targets,
            left positive, in [−π, π].
        turns: [e, k, s] turn commands flown, as shares of the limit, left positive.
        standoff, nogo: [e] share of the steps that end with a platform inside a stand-off ring, a no-go disc.
        state_size: numbers of a track's state, the NEES's degrees of freedom.
        position_error_m, position_crlb_m: as those of the range, in scenarios that are scored by the position.
        lost_late: [e] share of tracks whose position error, averaged over the last `LATE_STEPS` steps, exceeds
            `LATE_ERROR_M`; in the same scenarios.
        turn_error_m: [e] position error averaged over the steps after decisions at which a target maneuvers, NaN in
            episodes without any; in scenarios whose figures tell who maneuvers.
        acceleration_error_m_s2: [e, k + 1] mean over targets; in the same scenarios.
        scored_error_m: [e] the position error that `info` shows at the end, where that is another than the last scan's.
        horizontal_error_m, height_error_m: [e, k + 1] mean over targets; in scenarios whose figures tell them.
        settled: column from which a track is taken to have settled, in the same scenarios.
    """

    range_error_m: np.ndarray
    range_crlb_m: np.ndarray
    lost: np.ndarray
    collapsed: np.ndarray
    decision_time_us: float
    paths: EpisodePaths | World
    nees: np.ndarray
    off_sight_rad: np.ndarray
    turns: np.ndarray
    standoff: np.ndarray
    nogo: np.ndarray
    state_size: int = 4
    position_error_m: Any = None
    position_crlb_m: Any = None
    lost_late: Any = None
    turn_error_m: Any = None
    acceleration_error_m_s2: Any = None
    scored_error_m: Any = None
    horizontal_error_m: Any = None
    height_error_m: Any = None
    settled: int = 1

    @property
    def score(self) -> str:
        """The error that counts, "range" or "position"."""
        return "range" if self.position_error_m is None else "position"

    @property
    def errors(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Per kind of error, the one that counts first: errors and bounds [e, k + 1]."""
        ranges = {"range": (self.range_error_m, self.range_crlb_m)}
        return ranges if self.score == "range" else {"position": (self.position_error_m, self.position_crlb_m)} | ranges

    @property
    def outcomes(self) -> Outcomes:
        """The figures of every episode, without its course."""
        named = {}
        for kind, (error, _) in self.errors.items():
            named[f"final_{kind}_error_m"] = error[:, -1]
            named[f"mean_{kind}_error_m"] = error[:, 1:].mean(axis=1)
        if self.scored_error_m is not None:
            named["scored_position_error_m"] = self.scored_error_m
        if self.turn_error_m is not None and np.isfinite(self.turn_error_m).any():
            named["turn_position_error_m"] = self.turn_error_m
        if self.acceleration_error_m_s2 is not None:
            named["mean_acceleration_error_m_s2"] = self.acceleration_error_m_s2[:, 1:].mean(axis=1)
        bounds = {f"final_{kind}_crlb_m": bound[:, -1] for kind, (_, bound) in self.errors.items()}
        return Outcomes(
            self.score, named | self._level_samples(), bounds, self.lost, self.collapsed, self.nees, self.standoff,
            self.nogo, self.state_size, self.decision_time_us, self.lost_late,
        )  # fmt: skip

    @property
    def samples(self) -> dict[str, np.ndarray]:
        """What policies are compared by, each [e]: final and average errors, those of maneuvers; by name in reports."""
        return self.outcomes.samples

    def _level_samples(self) -> dict[str, np.ndarray]:
        """Averages of level errors, also of settled tracks, and in space of height errors."""
        level, height = self.horizontal_error_m, self.height_error_m
        if level is None:
            return {}
        named = {"mean_horizontal_error_m": level[:, 1:].mean(axis=1)}
        if self.settled < level.shape[1]:
            named["settled_horizontal_error_m"] = level[:, self.settled :].mean(axis=1)
        return named | ({"mean_height_error_m": height[:, 1:].mean(axis=1)} if height.any() else {})

    @property
    def error_m(self) -> np.ndarray:
        """[e, k + 1] the error that counts."""
        return self.errors[self.score][0]

    @property
    def bound_m(self) -> np.ndarray:
        """[e, k + 1] the bound on it."""
        return self.errors[self.score][1]

    @property
    def final(self) -> np.ndarray:
        """[e] the error that counts after the last step."""
        return self.error_m[:, -1]

    @property
    def mean(self) -> np.ndarray:
        """[e] the same averaged over all steps after decisions."""
        return self.error_m[:, 1:].mean(axis=1)


def steps_axis(scenario: Any) -> np.ndarray:
    """Times s of a record's columns."""
    return scenario.step_s * np.arange(scenario.instants)
