"""Environments of several agents by their ids; PettingZoo is asked for only when one is made."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from passive_env.extras import needs
from passive_env.scenario import Scenario

if TYPE_CHECKING:
    from passive_env.pettingzoo_env import PassiveParallelEnv


def parallel_env(
    env_id: str | Scenario = "passive/TwoStation-v0",
    view: str = "common",
    reward: str = "team",
    render_mode: str | None = None,
    **fields: Any,
) -> PassiveParallelEnv:
    """Make an environment in which every platform is an agent, with PettingZoo's parallel interface.

    Args:
        env_id: id of an environment with at least two steered platforms, or a `Scenario`.
        view: what an agent sees: "common", the common track and all platforms, or "own", only what its platform knows
            by itself.
        reward: "team", the environment's, or "difference", by how much an agent has raised it.
        render_mode: None, "rgb_array" or "human".
        **fields: scenario fields to override.
    Raises:
        ImportError: PettingZoo is not installed; ValueError: bad values, or fewer than two steered platforms.
    """
    needs("pettingzoo", "pettingzoo")
    from passive_env.pettingzoo_env import PassiveParallelEnv

    return PassiveParallelEnv(env_id, view, reward, render_mode, **fields)
