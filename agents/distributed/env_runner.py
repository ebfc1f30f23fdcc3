"""RLlib on the native vector environment: whole batches in a step, whole episodes in a sample.

RLlib's own runner adds every observation of every sub-environment to an episode's lists, step by step. Here a step
costs one call of the network and one of the environment, and episodes are cut from finished arrays at the end.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from ray.rllib.core.columns import Columns
from ray.rllib.env.single_agent_env_runner import SingleAgentEnvRunner
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.utils.metrics import EPISODE_LEN_MEAN, EPISODE_RETURN_MEAN, SAMPLE_TIMER

from agents.mixture import RECORDED
from agents.sb3 import observation_space
from passive_env.vector_env import PassiveVectorEnv

FINAL_ERROR = "final_range_error_m"
"""Metric: mean range error at the end of the episodes flown since the last report."""


class PassiveEnvRunner(SingleAgentEnvRunner):
    """Samples whole episodes of all sub-environments; for ``config.env_runners(env_runner_cls=PassiveEnvRunner)``.

    The horizon is part of the task and the time left is observed, so an episode's last step is terminal.

    ``config.environment(id, env_config={…})`` takes the scenario's fields, and besides

        first_seed: of the first episode of a training; without it ``config.seed``, or 0. Rollouts count on from it, so
            a resumed training flies the episodes that come next, and all runners others.
        truth: append what a critic may know (`passive_env.truth`) to the observations.
        flights_share: share of rollouts in which targets fly recorded courses (`agents.mixture` mixes within each).

    Which episodes are flown and which actions are drawn follows from the seed, the steps flown so far by all runners,
    and the runner's place among them.
    """

    def make_env(self) -> None:
        """Make the vector environment in ``self.env``; on one core, for the others have their own runners."""
        config: Any = self.config
        fields = dict(config.env_config)
        self._first_seed = int(fields.pop("first_seed", config.seed or 0))
        with_truth = fields.pop("truth", False)
        self._flights_share = float(fields.pop("flights_share", 0.0))
        name = str(config.env).removeprefix("passive_env:")
        width = config.num_envs_per_env_runner
        self.env: Any = PassiveVectorEnv(name, num_envs=width, autoreset_mode="disabled", threads=1, **fields)
        self._kinds = [self.env]
        if self._flights_share > 0.0:
            recorded = fields | RECORDED
            self._kinds.append(PassiveVectorEnv(name, num_envs=width, autoreset_mode="disabled", threads=1, **recorded))
        self._truth = self.env.scenario.make_truth_observation() if with_truth else None
        for env in self._kinds:
            env.single_observation_space = observation_space(env, self._truth)
        self.num_envs = width
        self._begun_at, self._again = -1, 0
        torch.set_num_threads(1)

    def sample(
        self, *, num_timesteps: int | None = None, num_episodes: int | None = None, explore: bool | None = None,
        random_actions: bool = False, force_reset: bool = False,
    ) -> list[SingleAgentEpisode]:  # fmt: skip
        """Fly whole episodes of all sub-environments, as often as it takes for so many steps or episodes, once if both
        are None.
        """
        explore = bool(self.config.explore) if explore is None else explore
        length = self.env.scenario.steps
        wanted = max(num_episodes or 0, -(-(num_timesteps or 0) // length), 1)
        with self.metrics.log_time(SAMPLE_TIMER):
            rollouts = [self._rollout(explore, random_actions) for _ in range(-(-wanted // self.num_envs))]
        return [episode for rollout in rollouts for episode in rollout]

    def get_metrics(self) -> Any:
        """What was logged since the last call."""
        return self.metrics.reduce()

    def _rollout(self, explore: bool, random_actions: bool) -> list[SingleAgentEpisode]:
        """One episode of every sub-environment."""
        seed = self._next_seed()
        torch.manual_seed(seed)
        self.env = self._kinds[int(np.random.default_rng(seed).random() < self._flights_share)]
        self.env.action_space.seed(seed)
        observation, info = self.env.reset(seed=seed)
        columns: dict[str, list[np.ndarray]] = {Columns.OBS: [self._seen(observation)], Columns.REWARDS: []}
        for _ in range(self.env.scenario.steps):
            decided = self._decide(columns[Columns.OBS][-1], explore, random_actions)
            observation, reward, _, _, info = self.env.step(self._flyable(decided[Columns.ACTIONS]))
            columns[Columns.OBS].append(self._seen(observation))
            columns[Columns.REWARDS].append(reward)
            for name, values in decided.items():
                columns.setdefault(name, []).append(values)
        arrays = {name: np.stack(values, axis=1) for name, values in columns.items()}
        self._log(arrays[Columns.REWARDS], info)
        rows = ({name: array[i] for name, array in arrays.items()} for i in range(self.num_envs))
        return [self._episode(seed + i, row) for i, row in enumerate(rows)]

    def _next_seed(self) -> int:
        """Seed of the next rollout's first episode; another one too if all steps so far are as many as the last time.

        Steps of all runners are counted in rollouts of them all, so no two share an episode.
        """
        steps, runners = self.num_env_steps_sampled_lifetime, max(self.config.num_env_runners or 0, 1)
        self._begun_at, self._again = steps, self._again + 1 if steps == self._begun_at else 0
        place = self._again * runners + max((self.worker_index or 1) - 1, 0)
        return self._first_seed + steps + place * self.num_envs

    def _seen(self, observation: np.ndarray) -> np.ndarray:
        return observation if self._truth is None else np.hstack([observation, self._truth(self.env.world)])

    def _flyable(self, actions: np.ndarray) -> np.ndarray:
        """Actions inside their Box; what is learned from are those that were drawn."""
        box = self.env.single_action_space
        return np.clip(actions, box.low, box.high) if isinstance(box, spaces.Box) else actions

    def _decide(self, observation: np.ndarray, explore: bool, random_actions: bool) -> dict[str, np.ndarray]:
        """Actions [e, a] and, unless they are random, what the learner wants to know of them."""
        if random_actions or self.module is None:
            return {Columns.ACTIONS: self.env.action_space.sample()}
        batch = {Columns.OBS: torch.from_numpy(observation)}
        with torch.no_grad():
            if explore:
                inputs = self.module.forward_exploration(batch)[Columns.ACTION_DIST_INPUTS]
                drawn = self.module.get_exploration_action_dist_cls().from_logits(inputs)
            else:
                inputs = self.module.forward_inference(batch)[Columns.ACTION_DIST_INPUTS]
                drawn = self.module.get_inference_action_dist_cls().from_logits(inputs).to_deterministic()
            actions = drawn.sample()
            decided = {Columns.ACTIONS: actions, Columns.ACTION_DIST_INPUTS: inputs}
            if explore:
                decided[Columns.ACTION_LOGP] = drawn.logp(actions)
        return {name: value.numpy() for name, value in decided.items()}

    def _episode(self, seed: int, arrays: dict[str, np.ndarray]) -> SingleAgentEpisode:
        """A finished episode, as RLlib's learners take them."""
        observations, rewards = arrays.pop(Columns.OBS), arrays.pop(Columns.REWARDS)
        actions = arrays.pop(Columns.ACTIONS)
        episode = SingleAgentEpisode(
            id_=str(seed), observations=list(observations), actions=list(actions), rewards=list(rewards),
            extra_model_outputs={name: list(array) for name, array in arrays.items()},
            observation_space=self.env.single_observation_space, action_space=_unbounded(self.env.single_action_space),
            terminated=True, len_lookback_buffer=0,
        )  # fmt: skip
        return episode.to_numpy()

    def _log(self, rewards: np.ndarray, info: dict[str, Any]) -> None:
        """Log a rollout; rewards [e, k]."""
        self._increase_sampled_metrics(rewards.size, len(rewards))
        self.metrics.log_value(EPISODE_LEN_MEAN, rewards.shape[1], window=1)
        self.metrics.log_value(EPISODE_RETURN_MEAN, float(rewards.sum(axis=1).mean()), window=1)
        self.metrics.log_value(FINAL_ERROR, float(info["range_error_m"].mean()), window=1)


def _unbounded(space: Any) -> Any:
    """The same Box without bounds: drawn actions may lie outside."""
    return spaces.Box(-np.inf, np.inf, space.shape, np.float32) if isinstance(space, spaces.Box) else space
