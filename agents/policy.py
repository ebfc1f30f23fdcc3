"""The one protocol of all decision makers, and the registry of those known by name.

A policy sees the belief (and the observation made of it), never the truth. It decides for whole batches: arrays'
first axis is the environment. Adding one is one class and one line in `POLICIES`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np

from passive_env.belief import Belief


@runtime_checkable
class Policy(Protocol):
    """Decides where the platforms go."""

    def reset(self, belief: Belief) -> None:
        """Begin episodes; called once before the first `act`."""
        ...

    def act(self, belief: Belief, observation: np.ndarray) -> np.ndarray:
        """Commands [e, a] in [−1, 1] for a belief and its observations [e, d]."""
        ...


def make_policy(name: str, scenario: Any, seed: int = 0) -> Policy:
    """A policy by its name.

    Args:
        name: a key of `POLICIES`.
        scenario: the scenario it acts in.
        seed: of policies that draw random numbers.
    Raises:
        ValueError: unknown name.
    """
    from agents.fixed import FIXED
    from agents.rules import RULES

    makers: dict[str, Callable[[Any, int], Policy]] = {**FIXED, **RULES}
    if name not in makers:
        raise ValueError(f"unknown policy {name!r}: known are {', '.join(makers)}, or a run folder made by train")
    return makers[name](scenario, seed)


def policy_names() -> list[str]:
    """Names of all policies that need no training."""
    from agents.fixed import FIXED
    from agents.rules import RULES

    return [*FIXED, *RULES]
