"""The vector environment: whole batches in compiled kernels, blocks of it on all cores."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from passive_env.belief import Belief
from passive_env.catalogue import make_scenario
from passive_env.core import Simulation, World, map_rows, replace_rows
from passive_env.observations import Field
from passive_env.scenario import Scenario
from trackers.compiled import Blocks

BLOCK = 512
"""Sub-environments stepped in one go: fewer would pay more for every call, more would outgrow a core's cache."""


class PassiveVectorEnv(VectorEnv):
    """`num_envs` episodes of a scenario at once; see `passive_env.env.PassiveEnv` for spaces, reward and info.

    Sub-environment i equals the single environment with seed + i, bit for bit, whatever the width of the batch.

    Args:
        scenario: catalogue name or a `Scenario`.
        num_envs: number of sub-environments.
        autoreset_mode: an `AutoresetMode` or its name; NEXT_STEP by default.
        threads: worker threads; None takes all cores, 1 none.
        render_mode: None or "rgb_array" (a tuple of pictures, one per sub-environment).
        max_episode_steps: given by `gymnasium.make_vec`; replaces the scenario's ``steps``. (`gymnasium.make` cuts
            episodes of the usual length with its TimeLimit wrapper instead; to shorten both alike use ``steps``.)
        **fields: scenario fields to override.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 8}  # noqa: RUF012  copied, never changed

    def __init__(
        self,
        scenario: str | Scenario = "TwoStation",
        num_envs: int = 1,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int | None = None,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        **fields: Any,
    ):
        if not isinstance(num_envs, int) or num_envs < 1:
            raise ValueError(f"num_envs = {num_envs!r}: must be a positive integer")
        if threads is not None and (not isinstance(threads, int) or threads < 1):
            raise ValueError(f"threads = {threads!r}: must be a positive integer or None")
        if render_mode not in (None, *type(self).metadata["render_modes"]):
            raise ValueError(f"render_mode = {render_mode!r}: must be None or 'rgb_array'")
        if max_episode_steps is not None:
            fields["steps"] = max_episode_steps
        self.scenario = make_scenario(scenario, fields)
        self.autoreset_mode = _mode(autoreset_mode)
        self.metadata = {**type(self).metadata, "autoreset_mode": self.autoreset_mode}
        self.render_mode = render_mode
        self.num_envs = num_envs
        self.scenario.check_flights()
        self.simulation: Simulation = self.scenario.make_simulation()
        self.single_observation_space = self.simulation.observation.space
        self.single_action_space = self.simulation.actions.space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.blocks = Blocks(num_envs, block=BLOCK, threads=threads)
        self._worlds: list[World] | None = None
        self._whole: World | None = None  # all blocks in one, once somebody has asked for it since the last step
        self._tape: tuple[list[Any], Any] = ([], None)  # the blocks' tapes and all in one, which many steps share
        self._views: list[np.ndarray] = []  # observations of the worlds, block by block
        self._done = np.zeros(num_envs, dtype=bool)
        self._generators: list[np.random.Generator] | None = None

    @property
    def observation_fields(self) -> tuple[Field, ...]:
        """Name, unit and scale of every number of the observation."""
        return self.simulation.observation.fields

    @property
    def world(self) -> World:
        """The true world of all sub-environments; for evaluation and pictures, never for policies."""
        if self._worlds is None:
            raise gym.error.ResetNeeded("call reset() before step(), render() or belief()")
        if self._whole is None:
            self._whole = self._joined(self._worlds) if len(self._worlds) > 1 else self._worlds[0]
        return self._whole

    def _joined(self, worlds: list[World]) -> World:
        """All blocks in one; tapes, by far their largest part, are joined when episodes begin only."""
        tapes = [world.tape for world in worlds]
        if [*map(id, tapes)] != [*map(id, self._tape[0])]:
            self._tape = tapes, _concatenated(tapes)
        return _concatenated([world._replace(tape=()) for world in worlds])._replace(tape=self._tape[1])

    def belief(self) -> Belief:
        """What the operators of all sub-environments know now."""
        return self.simulation.belief(self.world)

    def of_beliefs(self, function: Callable[[Any], np.ndarray]) -> np.ndarray:
        """What a function makes of beliefs, an array [num_envs, …], asked block by block."""
        if self._worlds is None:
            raise gym.error.ResetNeeded("call reset() before of_beliefs()")
        return np.concatenate([function(self.simulation.belief(world)) for world in self._worlds])

    def reset(self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None):
        """Begin episodes; ``options={"reset_mask": bool [num_envs]}`` begins some only (autoreset mode DISABLED).

        Raises:
            ValueError: a mask of the wrong shape or type, or a list of seeds of the wrong length.
        """
        mask = self._reset_mask(options)
        self._seed(seed, mask)
        if self._worlds is None and not mask.all():
            raise gym.error.ResetNeeded("the first reset must begin all sub-environments: leave reset_mask out")
        self._restart(mask)
        self._done = self._done & ~mask
        terms = {name: np.zeros(self.num_envs) for name in self.scenario.reward_weights}
        return self._observe(), self._info(terms)

    def step(self, actions: Any):
        """Fly one step in every sub-environment, with the autoreset mode's treatment of finished ones.

        Raises:
            ValueError: actions of the wrong shape or with values that are not finite.
            gymnasium.error.ResetNeeded: before the first reset, or (mode DISABLED) when an episode is over.
        """
        values = self.simulation.actions.decode(actions, self.num_envs)
        if self._worlds is None:
            raise gym.error.ResetNeeded("call reset() before step()")
        if self.autoreset_mode == AutoresetMode.DISABLED and self._done.any():
            raise gym.error.ResetNeeded("some episodes are over: reset them with options={'reset_mask': …}")
        fresh = self._done.copy() if self.autoreset_mode == AutoresetMode.NEXT_STEP else np.zeros(self.num_envs, bool)
        reward, terms = self._advance(values, fresh)
        truncated = np.concatenate([self.simulation.finished(world) for world in self._worlds])
        self._done = truncated.copy()
        observation, info = self._observe(), self._info(terms)
        if self.autoreset_mode == AutoresetMode.SAME_STEP and truncated.any():
            final = {"final_obs": observation, "final_info": info}
            final |= {f"_{name}": truncated.copy() for name in final}
            self._restart(truncated)
            self._done = np.zeros(self.num_envs, dtype=bool)
            terms = {name: np.where(truncated, 0.0, term) for name, term in terms.items()}
            observation, info = self._observe(), self._info(terms) | final
        return observation, reward, np.zeros(self.num_envs, dtype=bool), truncated, info

    def render(self):
        """One RGB picture per sub-environment."""
        if self.render_mode is None:
            return None
        from passive_env.render import Viewer

        world = self.world
        viewer = Viewer(self.simulation, "rgb_array")
        pictures = tuple(viewer.draw(map_rows(lambda a, i=i: a[i : i + 1], world)) for i in range(self.num_envs))
        viewer.close()
        return pictures

    # -- parts of reset and step -------------------------------------------------------------------------------------

    def _reset_mask(self, options: dict[str, Any] | None) -> np.ndarray:
        mask = (options or {}).get("reset_mask")
        if mask is None:
            return np.ones(self.num_envs, dtype=bool)
        if not isinstance(mask, np.ndarray) or mask.dtype != bool or mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(
                f"reset_mask must be a bool array of shape ({self.num_envs},) with at least one True, got {mask!r}"
            )
        return mask

    def _seed(self, seed: int | Sequence[int | None] | None, mask: np.ndarray) -> None:
        if isinstance(seed, (int, np.integer)) or (seed is None and self._generators is None):
            super().reset(seed=None if seed is None else int(seed))
            first = int(self.np_random.integers(2**31)) if seed is None else int(seed)
            seeds: list[int | None] = [first + i for i in range(self.num_envs)]
        elif seed is None:
            return
        elif not isinstance(seed, Sequence):
            raise ValueError(f"seed = {seed!r}: must be an integer, None or a list of {self.num_envs} of these")
        else:
            seeds = list(seed)
            if len(seeds) != self.num_envs:
                raise ValueError(f"seed: got {len(seeds)} seeds for {self.num_envs} sub-environments")
        old = self._generators or [None] * self.num_envs
        self._generators = [
            (seeding.np_random(s)[0] if (s is not None or g is None) and new else g) or seeding.np_random(s)[0]
            for s, g, new in zip(seeds, old, mask, strict=True)
        ]

    def _restart(self, mask: np.ndarray) -> None:
        """Begin new episodes in the masked rows."""
        assert self._generators is not None
        generators, worlds = self._generators, self._worlds or [None] * len(self.blocks.slices)

        def restart(rows: slice, world: World | None) -> World:
            chosen = np.flatnonzero(mask[rows])
            if world is not None and not len(chosen):
                return world
            fresh = self.simulation.begin([generators[rows.start + i] for i in chosen])
            return fresh if world is None or len(chosen) == len(mask[rows]) else replace_rows(world, chosen, fresh)

        self._worlds, self._whole = self.blocks.map(restart, self.blocks.slices, worlds), None
        self._views = self.blocks.map(self.simulation.observe, self._worlds)

    def _advance(self, values: np.ndarray, fresh: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Step every block; rows of finished episodes begin anew instead (reward 0, action ignored)."""
        assert self._worlds is not None
        terms = {name: np.zeros(self.num_envs) for name in self.scenario.reward_weights}
        reward = np.zeros(self.num_envs)
        if not fresh.all():

            def advance(rows: slice, world: World) -> tuple[World, Any, dict[str, Any], np.ndarray]:
                held = _hold(world, fresh[rows], self.scenario.steps)
                command = self.simulation.command(held, values[rows])
                new, earned, parts = self.simulation.advance(held, command)
                return new, earned, parts, self.simulation.observe(new)  # observed here: one wait for all blocks a step

            steps = self.blocks.map(advance, self.blocks.slices, self._worlds)
            self._worlds, self._views = [step[0] for step in steps], [step[3] for step in steps]
            self._whole = None
            keep = ~fresh
            reward = np.concatenate([step[1] for step in steps]) * keep
            terms = {name: np.concatenate([step[2][name] for step in steps]) * keep for name in terms}
        if fresh.any():
            self._restart(fresh)
        return reward, terms

    def _observe(self) -> np.ndarray:
        return np.concatenate(self._views)

    def _info(self, terms: dict[str, np.ndarray]) -> dict[str, Any]:
        assert self._worlds is not None
        parts = [self.simulation.info(world) for world in self._worlds]
        info: dict[str, Any] = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        info["reward_terms"] = terms
        return info | {f"_{name}": np.ones(self.num_envs, dtype=bool) for name in info}


def _concatenated(trees: Sequence[Any]) -> Any:
    return map_rows(lambda *parts: np.concatenate(parts), *trees)


def _hold(world: World, fresh: np.ndarray, steps: int) -> World:
    """Keep finished rows inside their tape: they are stepped with the batch and then replaced."""
    return world._replace(step=np.minimum(world.step, steps - 1)) if fresh.any() else world


def _mode(mode: AutoresetMode | str) -> AutoresetMode:
    if isinstance(mode, AutoresetMode):
        return mode
    names = {m.name.lower(): m for m in AutoresetMode} | {str(m.value).lower(): m for m in AutoresetMode}
    if str(mode).lower() in names:
        return names[str(mode).lower()]
    raise ValueError(f"autoreset_mode = {mode!r}: must be one of {', '.join(m.name for m in AutoresetMode)}")
