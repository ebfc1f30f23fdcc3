"""Stable-Baselines3 on the native vector environment: no Python work per environment in a step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from passive_env.observations import LIMIT
from passive_env.team_vector_env import TeamVectorEnv
from passive_env.vector_env import PassiveVectorEnv


def observation_space(env: PassiveVectorEnv | TeamVectorEnv, truth: Any = None) -> Any:
    """Space of a sub-environment's observations, with a `passive_env.truth.TruthObservation` behind if there is one."""
    known: Any = env.single_observation_space
    if truth is None:
        return known
    more = np.full(len(truth.fields), LIMIT, dtype=np.float32)
    return spaces.Box(np.concatenate([known.low, -more]), np.concatenate([known.high, more]))


class Sb3VecEnv(VecEnv):
    """A `PassiveVectorEnv` or `TeamVectorEnv` with Stable-Baselines3's interface.

    The horizon is part of the task and the time left is observed, so by default the last step is terminal for the
    learner: values are not bootstrapped past it.

    Args:
        env: vector environment in autoreset mode SAME_STEP; rows of agents are environments to the learner.
        bootstrap_at_horizon: mark the last step as a time limit, past which values are bootstrapped.
        truth: append what a critic may know (`passive_env.truth`) to the observations; see `agents.asymmetric`.
    Raises:
        ValueError: another autoreset mode, or truth together with a bootstrap, which needs the belief alone, or with
            rows of agents.
    """

    def __init__(self, env: PassiveVectorEnv | TeamVectorEnv, bootstrap_at_horizon: bool = False, truth: bool = False):
        if env.autoreset_mode != AutoresetMode.SAME_STEP:
            raise ValueError(f"Sb3VecEnv needs autoreset_mode='same_step', got {env.autoreset_mode.name}")
        if truth and bootstrap_at_horizon:
            raise ValueError("truth=True goes with bootstrap_at_horizon=False: an episode's last truth is not kept")
        if truth and isinstance(env, TeamVectorEnv):
            raise ValueError("truth=True needs a PassiveVectorEnv: rows of agents have no truth of their own")
        self.env = env
        self.truth = env.scenario.make_truth_observation() if truth else None
        self.bootstrap_at_horizon = bootstrap_at_horizon
        self.render_mode = env.render_mode
        super().__init__(env.num_envs, observation_space(env, self.truth), env.single_action_space)
        self._returns = np.zeros(env.num_envs)
        self._lengths = np.zeros(env.num_envs, dtype=int)
        self._blank: list[dict[str, Any]] = [{} for _ in range(env.num_envs)]
        self._actions: np.ndarray | None = None

    def reset(self) -> VecEnvObs:
        """Begin all episodes, with the seed of the last `seed` call if there was one."""
        seed = self._seeds[0]
        observation, _ = self.env.reset(seed=seed)
        self._reset_seeds()
        self._returns[:] = 0.0
        self._lengths[:] = 0
        return self._with_truth(observation)

    def step_async(self, actions: np.ndarray) -> None:
        """Remember the actions."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Fly the step."""
        observation, reward, terminated, truncated, info = self.env.step(self._actions)
        self._returns += reward
        self._lengths += 1
        done = terminated | truncated
        infos = self._finish(done, truncated & ~terminated, info) if done.any() else self._blank
        return self._with_truth(observation), reward.astype(np.float32), done, infos

    def _with_truth(self, observation: np.ndarray) -> np.ndarray:
        return observation if self.truth is None else np.hstack([observation, self.truth(self.env.world)])

    def _finish(self, done: np.ndarray, timeout: np.ndarray, info: dict[str, Any]) -> list[dict[str, Any]]:
        infos = list(self._blank)
        final = info["final_info"]["range_error_m"].mean(axis=-1)
        for i in np.flatnonzero(done):
            infos[i] = {
                "episode": {
                    "r": float(self._returns[i]),
                    "l": int(self._lengths[i]),
                    "t": 0.0,
                    "final_range_error_m": float(final[i]),
                },
                "terminal_observation": info["final_obs"][i],
                "TimeLimit.truncated": bool(timeout[i] and self.bootstrap_at_horizon),
            }
        self._returns[done] = 0.0
        self._lengths[done] = 0
        return infos

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of the environment, once per chosen sub-environment."""
        return [getattr(self.env, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the whole environment; sub-environments have none of their own."""
        setattr(self.env, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method of the environment once; its result for every chosen sub-environment."""
        result = getattr(self.env, method_name)(*method_args, **method_kwargs)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """No wrappers: all False."""
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        """One picture per sub-environment (needs render_mode='rgb_array')."""
        pictures = self.env.render()
        return [None] * self.num_envs if pictures is None else list(pictures)
