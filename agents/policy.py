"""The one protocol of all decision makers, and the registry of those known by name.

A policy sees the belief (and the observation made of it), never the truth. It decides for whole batches: arrays'
first axis is the environment. Adding one is one class and one line in its file's table of makers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np

from passive_env.catalogue.angle_fusion import AngleFusion
from passive_env.catalogue.bearings import BearingScenario
from passive_env.catalogue.maneuvering import ManeuveringTarget
from passive_env.catalogue.mobile_placement import MobilePlacement
from passive_env.catalogue.ownship import Ownship
from passive_env.catalogue.passive_radar import PassiveRadar
from passive_env.catalogue.placement import RadarPlacement
from passive_env.catalogue.two_station import TwoStation


@runtime_checkable
class Policy(Protocol):
    """Decides where the platforms go. A belief is a `passive_env.belief.Belief`, or a family's own tuple."""

    def reset(self, belief: Any) -> None:
        """Begin episodes; called once before the first `act`."""
        ...

    def act(self, belief: Any, observation: np.ndarray) -> np.ndarray:
        """Commands [e, a] in [−1, 1] for a belief and its observations [e, d]."""
        ...


def make_policy(name: str, scenario: Any, seed: int = 0) -> Policy:
    """A policy by its name.

    Args:
        name: one of `policy_names(scenario)`.
        scenario: the scenario it acts in.
        seed: of policies that draw random numbers.
    Raises:
        ValueError: a name that the scenario does not offer.
    """
    makers = _makers(scenario)
    if name not in makers:
        raise ValueError(
            f"unknown policy {name!r}: {type(scenario).__name__} offers {', '.join(makers)}, "
            "or name a run folder made by train, a file FILE.npz made by pack or FILE.onnx made by export"
        )
    return makers[name](scenario, seed)


def policy_names(scenario: Any) -> list[str]:
    """Names of all policies that need no training and can fly a scenario."""
    return list(_makers(scenario))


def sees_world(policy: Any) -> bool:
    """Whether it is an oracle: it reads the truth through ``see(world)`` and is no policy one could fly."""
    return getattr(policy, "needs_world", False)


def _makers(scenario: Any) -> dict[str, Callable[[Any, int], Policy]]:
    """Makers (scenario, seed) of the policies for a scenario's family."""
    from agents.fixed import FIXED, PAPER, PAPER_IN_SPACE, STEADY
    from agents.greedy import FIX_GREEDY, GREEDY, GREEDY_IN_SPACE
    from agents.mobile_placement import MOBILE
    from agents.placement import PLACEMENT
    from agents.planner import FIX_SEARCHES, PLANNERS, PLANNERS_IN_SPACE
    from agents.radar_planner import RADAR_PLANNERS
    from agents.radar_policies import radar_makers
    from agents.rules import IN_SPACE, ONE_PLATFORM, OPEN_BASELINE, TURN_APART

    if isinstance(scenario, PassiveRadar):
        return {**RADAR_PLANNERS, **radar_makers(scenario), "random": STEADY["random"]}
    searching = {**GREEDY, **PLANNERS}
    families = {
        TwoStation: {**PAPER, **STEADY, **TURN_APART, **searching},
        Ownship: {**STEADY, **ONE_PLATFORM, **searching},
        BearingScenario: {**STEADY, **searching},
        ManeuveringTarget: {**FIXED, **OPEN_BASELINE, **FIX_GREEDY, **FIX_SEARCHES},
        RadarPlacement: {**PLACEMENT, "random": STEADY["random"]},
        MobilePlacement: {**MOBILE, "random": STEADY["random"]},
        AngleFusion: {**PAPER_IN_SPACE, **STEADY, **IN_SPACE, **GREEDY_IN_SPACE, **PLANNERS_IN_SPACE},
    }
    return next((makers for family, makers in families.items() if isinstance(scenario, family)), STEADY)
