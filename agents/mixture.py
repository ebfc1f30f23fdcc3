"""Training on a mixture: some environments' targets fly drawn courses, the others' recorded ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from agents.sb3 import Sb3VecEnv

RECORDED: dict[str, Any] = {"course": "flights", "flight_split": "train"}
"""Fields of a scenario whose targets fly recorded courses, those of the training part."""


def recorded_environments(envs: int, share: float) -> int:
    """How many environments' targets fly recorded courses, so that both kinds are there.

    Raises:
        ValueError: a share outside (0, 1), or too few environments for two kinds.
    """
    if not 0.0 < share < 1.0:
        raise ValueError(f"flights_share {share}: must lie between 0 and 1; leave it out for one kind of course")
    if envs < 2:
        raise ValueError(f"--envs {envs}: must be at least 2 for drawn and recorded courses side by side")
    return min(max(round(share * envs), 1), envs - 1)


def parts_of(env: VecEnv) -> list[Any]:
    """The vector environments of which one is made: `JoinedVecEnv`'s parts, or itself."""
    return env.parts if isinstance(env, JoinedVecEnv) else [env]


class JoinedVecEnv(VecEnv):
    """Vector environments whose spaces agree, as one; sub-environments stand in the order of the parts.

    Args:
        parts: stepped one after the other.
    Raises:
        ValueError: no parts, or spaces that differ.
    """

    def __init__(self, parts: Sequence[Sb3VecEnv]):
        if not parts:
            raise ValueError("JoinedVecEnv needs at least one vector environment")
        first, *others = parts
        for part in others:
            if (part.observation_space, part.action_space) != (first.observation_space, first.action_space):
                raise ValueError(
                    f"spaces differ: {part.observation_space}, {part.action_space} instead of "
                    f"{first.observation_space}, {first.action_space}"
                )
        self.parts = list(parts)
        self.truth = first.truth
        self.render_mode = first.render_mode
        self._begins = np.cumsum([0, *(part.num_envs for part in parts)])
        super().__init__(int(self._begins[-1]), first.observation_space, first.action_space)

    def reset(self) -> VecEnvObs:
        """Begin all episodes, with the seeds of the last `seed` call if there was one."""
        for part, begin in zip(self.parts, self._begins[:-1], strict=True):
            if self._seeds[begin] is not None:
                part.seed(self._seeds[begin])
        self._reset_seeds()
        observations: list[Any] = [part.reset() for part in self.parts]
        return np.concatenate(observations)

    def step_async(self, actions: np.ndarray) -> None:
        """Remember the actions."""
        for part, own in zip(self.parts, np.split(actions, self._begins[1:-1]), strict=True):
            part.step_async(own)

    def step_wait(self) -> VecEnvStepReturn:
        """Fly the step."""
        observations, rewards, dones, infos = zip(*(part.step_wait() for part in self.parts), strict=True)
        joined = [info for part in infos for info in part]
        return np.concatenate(observations), np.concatenate(rewards), np.concatenate(dones), joined

    def close(self) -> None:
        """Close all parts."""
        for part in self.parts:
            part.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of the parts, once per chosen sub-environment."""
        return [getattr(self._part(i).env, attr_name) for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of all parts; sub-environments have none of their own."""
        for part in self.parts:
            part.set_attr(attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method of every part once; the results for every chosen sub-environment."""
        results = [getattr(part.env, method_name)(*method_args, **method_kwargs) for part in self.parts]
        return [results[self.parts.index(self._part(i))] for i in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """No wrappers: all False."""
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        """One picture per sub-environment (needs render_mode='rgb_array')."""
        return [picture for part in self.parts for picture in part.get_images()]

    def _part(self, index: int) -> Sb3VecEnv:
        """The part that a sub-environment belongs to."""
        return self.parts[int(np.searchsorted(self._begins, index, side="right")) - 1]
