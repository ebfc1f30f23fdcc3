"""What learned policies are meant to reach: the ratios this package set itself when it took its environments in."""

from __future__ import annotations

from typing import NamedTuple

DRAWN, RECORDED = "random", "flights"
"""Courses of targets, as scenarios name them."""

LOST = "lost"
"""Stands for the share of lost tracks among the errors."""


class Goal(NamedTuple):
    """A ratio that a learned policy is to stay below.

    Attributes:
        course: of targets, `DRAWN` or `RECORDED`.
        error: a name that `agents.report.metrics_of` gives, or `LOST`.
        most: the largest ratio that will do.
        against: policies, of which the one of least mean counts; empty: the best fixed policy or rule by this error.
        what: "mean", "p95", or "high", the upper end of the interval of the ratio of means.
    """

    course: str
    error: str
    most: float
    against: tuple[str, ...] = ()
    what: str = "mean"


_BEFORE_RENEWAL = ("best_fixed", "repeat", "greedy", "skip", "bayes", "hysteresis", "hold10")
"""Receivers' policies of the time when the goal was set; those that know how long blockages last are newer."""

GOALS: dict[str, tuple[Goal, ...]] = {
    "passive/TwoStation-v0": (
        Goal(DRAWN, "final", 0.27, ("paper",)),
        Goal(DRAWN, "final", 1.03, ("rule",), "high"),
        Goal(DRAWN, "final", 1.0, ("rule",), "p95"),
        Goal(RECORDED, "final", 0.4, ("paper",)),
    ),
    "passive/Ownship-v0": (
        Goal(DRAWN, "final", 0.85),
        Goal(DRAWN, "time average", 0.78),
        Goal(DRAWN, "final", 0.9, (), "p95"),
        Goal(DRAWN, "final", 0.75, ("greedy",)),
        Goal(DRAWN, "time average", 0.92, ("greedy",)),
        Goal(DRAWN, "final", 1.0, ("planner",)),
        Goal(DRAWN, "time average", 0.99, ("planner",)),
        Goal(RECORDED, "time average", 0.85),
    ),
    "passive/OwnshipManeuvering-v0": (Goal(DRAWN, "final", 0.9), Goal(DRAWN, "time average", 0.85)),
    "passive/OwnshipMulti-v0": (Goal(DRAWN, "time average", 0.95, ("rule", "rule_average", "greedy", "planner")),),
    "passive/AngleFusion-v0": (
        Goal(DRAWN, "final", 0.23, ("paper",)),
        Goal(DRAWN, "time average", 0.45, ("paper",)),
        Goal(DRAWN, "final", 1.0, ("rule",)),
        Goal(DRAWN, "time average", 1.0, ("rule",)),
        Goal(DRAWN, "final", 1.01, ("greedy",)),
        Goal(DRAWN, "time average", 1.01, ("greedy",)),
        Goal(DRAWN, "final", 1.0, ("greedy",), "p95"),
        Goal(DRAWN, "time average", 1.0, ("greedy",), "p95"),
        Goal(RECORDED, "final", 1.0, ("rule",)),
        Goal(RECORDED, "time average", 1.0, ("rule",)),
    ),
    "passive/AngleFusionClutter-v0": (
        Goal(DRAWN, "time average", 1.0, ("rule",)),
        Goal(DRAWN, "time average", 1.0, ("greedy",)),
        Goal(DRAWN, LOST, 1.0, ("rule",)),
        Goal(DRAWN, LOST, 1.0, ("greedy",)),
    ),
    "passive/AngleFusionSlow-v0": (Goal(DRAWN, "final", 0.95), Goal(DRAWN, "final", 1.0, ("greedy",))),
    "passive/ManeuveringTarget-v0": (
        Goal(DRAWN, "while maneuvering", 0.25, ("fixed",)),
        Goal(DRAWN, "while maneuvering", 0.95, ("open",)),
        Goal(DRAWN, "time average", 1.0, ("open",)),
        Goal(RECORDED, "time average", 1.0, ("open",)),
    ),
    "passive/RadarPlacement-v0": (Goal(DRAWN, "final", 1.05, ("optimizer",)),),
    "passive/MobilePlacement-v0": (Goal(DRAWN, "time average", 0.9, ("optimizer",)),),
    "passive/PassiveRadar-v0": (
        Goal(DRAWN, "time average", 0.8, ("round_robin",)),
        Goal(DRAWN, "time average", 0.6, ("greedy",)),
        Goal(DRAWN, "time average", 0.88, ("skip",)),
        Goal(DRAWN, "time average", 1.01, ("bayes",)),
    ),
    "passive/PassiveRadarRetune-v0": (
        Goal(DRAWN, "time average", 0.95, _BEFORE_RENEWAL),
        Goal(DRAWN, "settled", 0.97, _BEFORE_RENEWAL),
        Goal(DRAWN, "time average", 0.95, (*_BEFORE_RENEWAL, "timed", "timed10")),
    ),
    "passive/MobileReceiver-v0": (
        Goal(DRAWN, "time average", 0.9, ("straight",)),
        Goal(DRAWN, "time average", 1.01, ("pursuit",)),
    ),
}
"""Of every environment as it is registered; goals of other scenarios, such as sensors that may stand 20 km high or a
paper's layout of transmitters, are judged in the environments' documents."""
