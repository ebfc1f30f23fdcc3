"""What all scenarios share in which a tracker follows targets: the tracker, limits of the platforms, rewards."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

from passive_env.catalogue.course import CourseScenario
from passive_env.rewards import TERMS
from passive_env.scenario import free, number


@dataclass(frozen=True, kw_only=True)
class TrackingScenario(CourseScenario, ABC):
    """Base of scenarios that are tracked; a family adds its own fields and the parts that `passive_env.core` names."""

    discs: ClassVar[int] = 0
    """Number of no-go discs; a property where there is a choice."""
    trackers: ClassVar[Mapping[str, Any]] = {}
    """Makers of the family's trackers by name."""
    tracker_verbs: ClassVar[tuple[str, ...]] = ()
    """What the family's trackers do besides `VERBS`."""

    score: ClassVar[str] = "range"
    """The error that policies are compared by: "range", from the reference, or "position"."""
    reference: ClassVar[int] = -1
    """Index of the platform from which ranges are measured: the last one, unless a family says otherwise."""

    tracker: Any = free(None, "name of a tracker, or an object with the tracker contract")
    range_floor_m: float = number(5e3, 1.0, 1e7, "nearest range the tracker looks for a target at first")
    range_cap_m: float = number(2e5, 1.0, 1e7, "farthest")
    max_turn_rate_deg_s: float = number(5.0, 0.0, 45.0, "turn rate at action ±1")
    standoff_m: float = number(0.0, 0.0, 1e5, "distance platforms should keep from targets; 0 for none")
    reward_log_range_error: float = number(1.0, 0.0, 1e6, "weight")
    reward_relative_range_error: float = number(0.0, 0.0, 1e6, "weight")
    reward_range_error: float = number(0.0, 0.0, 1e6, "weight")
    reward_final_range_error: float = number(0.0, 0.0, 1e6, "weight")
    reward_log_range_bound: float = number(0.0, 0.0, 1e6, "weight")
    reward_final_log_range_bound: float = number(0.0, 0.0, 1e6, "weight")
    reward_information_gain: float = number(0.0, 0.0, 1e6, "weight")
    reward_maneuver: float = number(0.0, 0.0, 1e6, "weight")
    reward_standoff: float = number(1.0, 0.0, 1e6, "weight; counts only when standoff_m > 0")
    reward_lost_track: float = number(0.0, 0.0, 1e6, "weight")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.range_floor_m >= self.range_cap_m:
            raise self._error("range_floor_m", f"must lie below range_cap_m = {self.range_cap_m}")
        self.make_tracker()

    @property
    def moves(self) -> bool:
        """Whether platforms move."""
        return True

    def make_tracker(self) -> Any:
        """The tracker object; a name is made with this scenario's settings.

        Raises:
            ValueError: unknown name; TypeError: an object that lacks a verb of the contract.
        """
        if not isinstance(self.tracker, str):
            return checked_tracker(self.tracker, self.tracker_verbs)
        if self.tracker not in self.trackers:
            raise self._error("tracker", f"must be one of {', '.join(map(repr, self.trackers))}")
        return self.trackers[self.tracker](**self.tracker_settings)

    @property
    @abstractmethod
    def tracker_settings(self) -> dict[str, Any]:
        """Keywords of the named tracker."""

    @cached_property
    def reward_weights(self) -> dict[str, float]:
        """Weights of the reward terms in use."""
        fields = {f.name for f in dataclasses.fields(self)}
        weights = {name: getattr(self, f"reward_{name}") for name in TERMS if f"reward_{name}" in fields}
        if self.standoff_m == 0.0:
            weights["standoff"] = 0.0
        if self.discs == 0:
            weights["nogo"] = 0.0
        return {name: weight for name, weight in weights.items() if weight > 0.0}


VERBS = ("initiate", "predict", "update", "estimate")
"""What every tracker has."""


def checked_tracker(tracker: Any, more: tuple[str, ...] = ()) -> Any:
    """A user's tracker object, as it is.

    Args:
        more: verbs that the family needs besides `VERBS`.

    Raises:
        TypeError: a class, or an object that lacks a verb of the contract.
    """
    if isinstance(tracker, type):
        raise TypeError(f"tracker is the class {tracker.__name__}, must be an object: tracker={tracker.__name__}(…)")
    verbs = VERBS + more
    missing = [verb for verb in verbs if not callable(getattr(tracker, verb, None))]
    if missing:
        raise TypeError(f"tracker {tracker!r} has no {', '.join(missing)}; a tracker needs {', '.join(verbs)}")
    return tracker
