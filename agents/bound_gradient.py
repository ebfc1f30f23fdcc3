"""Learning down the gradient of the bound: no luck of draws, no critic, no guessing which of sixty actions was good.

Along the true course what sensors on carriers do now decides, by known equations, what the filter's covariance will be
at every later scan. So the reward's terms, the bound standing for the error, have a gradient with respect to every
action of an episode, the others being as they were; the actor's mean action follows it. The truth serves as it does in
a reward: while learning. What the actor sees is the observation.

How later actions would answer a changed one is left out, and that the target's estimated course, by which actions are
told, would be another one.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor

from agents.mixture import parts_of
from agents.sb3 import Sb3VecEnv
from agents.torch_bound import promised_std
from agents.torch_carriers import carried
from passive_env.mobile_observation import course_of
from passive_env.placement import Task, entry_prior

ACTIONS = "velocities"
"""The kind of actions that it learns."""

TERMS = (
    "log_position_error", "log_position_bound", "position_error", "final_log_position_error", "final_position_error",
)  # fmt: skip
"""The reward's terms that a bound can stand for."""

EDGE_M = 1e3
"""Width over which a sensor's information fades in above the minimum range: carriers keep off it."""

BLOCK = 256
"""Episodes whose gradient is taken at once."""


class Flight(NamedTuple):
    """Episodes of one scenario, flown to their end; e environments, k decisions, n sensors.

    Attributes:
        scenario: theirs.
        task: what was known of them at first.
        path: [e, k, 3] m, where the target was at the scans.
        courses: [e, k, 2] unit vectors that actions were told by.
    """

    scenario: Any
    task: Task
    path: np.ndarray
    courses: np.ndarray


class BoundGradient(PPO):
    """An actor that follows the gradient of the bound; Stable-Baselines3's, with another way to fly and to learn.

    Of `PPO`'s arguments those count that say how much is flown and how the network is changed: learning_rate, n_steps,
    batch_size, n_epochs, max_grad_norm and policy_kwargs. It explores with the spread that the policy begins with.
    A rollout is an episode of all environments, which are `agents.sb3.Sb3VecEnv` of sensors on carriers, or several of
    them as one (`agents.mixture`).

    Args:
        args, kwargs: `PPO`'s.
        max_slope: norm to which the gradient with respect to one action is cut. Where sensors are installed counts far
            more than one step of their carriers, and few draws more than all the others together.
    Raises:
        ValueError: a norm that is not positive, environments of other kinds, rollouts that are not one episode.
    """

    def __init__(self, *args: Any, max_slope: float = 0.5, **kwargs: Any):
        if not max_slope > 0.0:
            raise ValueError(f"max_slope {max_slope}: must be positive")
        self.max_slope = max_slope
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        if self.env is not None:
            _check_environment(self.env, self.n_steps)
        super()._setup_model()

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_seen", "_flown", "_flights"]

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        """Fly an episode of all environments, and keep what its gradient needs."""
        self.policy.set_training_mode(False)
        callback.on_rollout_start()
        parts = [part.env for part in parts_of(env)]
        if any(np.any(part.world.step) for part in parts):
            raise ValueError("a rollout must begin with an episode, and the environments are within one: reset them")
        begun = [(part.scenario, part.world.tape) for part in parts]
        seen, flown, courses = [], [], []
        learner: Any = self  # its last observation, which Stable-Baselines3 types for every kind of environment
        for _ in range(n_rollout_steps):
            courses.append([course_of(part.belief()) for part in parts])
            with torch.no_grad():
                acted = self.policy.get_distribution(torch.as_tensor(learner._last_obs, device=self.device)).sample()
            actions = acted.clamp(-1.0, 1.0).cpu().numpy()
            seen.append(learner._last_obs)
            flown.append(actions)
            learner._last_obs, _, dones, infos = env.step(actions)
            self.num_timesteps += env.num_envs
            callback.update_locals(locals())
            if not callback.on_step():
                return False
            self._update_info_buffer(infos, dones)
        self._seen, self._flown = np.stack(seen, axis=1), np.stack(flown, axis=1)
        self._flights = [
            Flight(scenario, tape.task, tape.targets[:, 1:, 0, :3], np.stack(course, axis=1))
            for (scenario, tape), course in zip(begun, zip(*courses, strict=True), strict=True)
        ]
        callback.on_rollout_end()
        return True

    def train(self) -> None:
        """Change the actor along the gradient of what was flown.

        Raises:
            FloatingPointError: a gradient that is not finite; the actor is as it was.
        """
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        ends = np.cumsum([len(flight.path) for flight in self._flights])[:-1]
        found = [
            gradient(actions, flight)
            for actions, flight in zip(np.split(self._flown, ends), self._flights, strict=True)
        ]
        slope, bound = (np.concatenate(parts) for parts in zip(*found, strict=True))
        if not np.isfinite(slope).all():
            raise FloatingPointError(
                f"the gradient of the bound is not finite in {(~np.isfinite(slope)).any(axis=(1, 2)).sum()} of "
                f"{len(slope)} episodes, the last before {self.num_timesteps} steps: nothing was learned from them"
            )
        x = torch.as_tensor(self._seen, device=self.device).flatten(0, 1)
        g = torch.as_tensor(slope, dtype=torch.float32, device=self.device).flatten(0, 1)
        g = torch.renorm(g, p=2, dim=0, maxnorm=self.max_slope)
        for _ in range(self.n_epochs):
            for rows in torch.randperm(len(x), device=self.device).split(self.batch_size):
                self._descend(x[rows], g[rows])
        self._n_updates += self.n_epochs
        self.logger.record("train/position_bound_m", float(bound.mean()))
        self.logger.record("train/final_position_bound_m", float(bound[:, -1].mean()))
        self.logger.record("train/gradient", float(np.linalg.norm(slope, axis=-1).mean()))

    def _descend(self, x: Tensor, g: Tensor) -> None:
        mean = self.policy.get_distribution(x).mode()
        outwards = ((mean >= 1.0) & (g < 0.0)) | ((mean <= -1.0) & (g > 0.0))
        loss = (mean * g.masked_fill(outwards, 0.0)).sum(dim=1).mean()
        self.policy.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
        self.policy.optimizer.step()


def gradient(actions: np.ndarray, flight: Flight) -> tuple[np.ndarray, np.ndarray]:
    """Derivative of every episode's loss with respect to its actions, and the bound that they led to.

    Args:
        actions: [e, k, 3 n] in [−1, 1].
        flight: the episodes in which they were flown.
    Returns:
        [e, k, 3 n], and standard deviations of the position [e, k] m after each scan.
    """
    blocks = [slice(at, at + BLOCK) for at in range(0, len(actions), BLOCK)]
    found = [_gradient(actions[rows], _rows(flight, rows)) for rows in blocks]
    slope, bound = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return slope, bound


def _rows(flight: Flight, rows: slice) -> Flight:
    return Flight(flight.scenario, flight.task.rows(rows), flight.path[rows], flight.courses[rows])


def _gradient(actions: np.ndarray, flight: Flight) -> tuple[np.ndarray, np.ndarray]:
    scenario = flight.scenario
    a = torch.tensor(actions, dtype=torch.float64, requires_grad=True)
    bound = bound_of(a, flight, EDGE_M)
    loss(bound, scenario).sum().backward()
    assert a.grad is not None
    return a.grad.numpy(), bound.detach().numpy()


def bound_of(actions: Tensor, flight: Flight, edge_m: float = 0.0) -> Tensor:
    """Standard deviations of the position [e, k] m that actions [e, k, 3 n] lead to; edge as `promised_std`'s."""
    s, task = flight.scenario, flight.task
    places = carried(
        actions.unflatten(-1, (s.sensors, 3)), torch.as_tensor(flight.courses), task,
        s.speed_m_s * s.step_s, s.climb_m_s * s.step_s,
    )  # fmt: skip
    path, std, prior = (torch.as_tensor(np.asarray(part)) for part in (flight.path, task.std, entry_prior(task).cov))
    return promised_std(places, path, std, torch.as_tensor(s.ranging), prior, s.make_tracker(), s.step_s, edge_m)


def loss(bound: Tensor, scenario: Any) -> Tensor:
    """What episodes [e] lose by the weights of their scenario's reward, bounds [e, k] m standing for errors.

    Its terms are those of `TERMS`, neither floored nor cut.
    """
    log, far = torch.log(bound / 1e3), bound / 1e3
    each_log, each_bound, each, last_log, last = (scenario.reward_weights.get(term, 0.0) for term in TERMS)
    return ((each_log + each_bound) * log + each * far).sum(dim=1) + last_log * log[:, -1] + last * far[:, -1]


def refusal(scenario: Any) -> str | None:
    """Why nothing can be learned from a scenario; None if it can."""
    if not hasattr(scenario, "climb_m_s"):
        return "needs sensors on carriers"
    if scenario.actions != ACTIONS:
        return f"follows what actions do by equations of actions={ACTIONS!r} only, not of {scenario.actions!r}"
    known = ", ".join(f"reward_{term}" for term in TERMS)
    unknown = [f"reward_{term}" for term in scenario.reward_weights if term not in TERMS]
    if unknown:
        return f"has no derivative of {', '.join(unknown)}: set it to 0 and weigh {known}"
    if not scenario.reward_weights:
        return f"has nothing to follow, all of the reward's weights are 0: set one of {known}"
    return None


def _check_environment(env: VecEnv, n_steps: int) -> None:
    """Refuse environments in which carriers do not fly velocities, and rollouts that are not one episode of all."""
    for part in parts_of(env):
        if not isinstance(part, Sb3VecEnv):
            raise ValueError(f"BoundGradient on {type(part).__name__}: needs an agents.sb3.Sb3VecEnv")
        scenario = part.env.scenario
        words = refusal(scenario)
        if words is not None:
            raise ValueError(f"BoundGradient on {type(scenario).__name__} {words}")
        if n_steps != scenario.steps:
            raise ValueError(f"n_steps {n_steps}: must be {scenario.steps}, the steps of an episode")
