"""Registers every scenario of the catalogue with Gymnasium."""

from __future__ import annotations

import gymnasium as gym

from passive_env.catalogue import SCENARIOS, environment_id


def register_all() -> None:
    """Register ``passive/NAME-v0`` for all scenarios; calling it again changes nothing."""
    for name in SCENARIOS:
        env_id = environment_id(name)
        if env_id not in gym.registry:
            gym.register(
                env_id,
                entry_point="passive_env.env:PassiveEnv",
                vector_entry_point="passive_env.vector_env:PassiveVectorEnv",
                kwargs={"scenario": name},
            )
