"""Learning down the gradient of the bound: no luck of draws, no critic, no guessing which of sixty actions was good.

Along the true course what sensors on carriers do now decides, by known equations, what the filter's covariance will be
at every later scan. So the reward's terms, the bound standing for the error, have a gradient with respect to every
action of an episode, the others being as they were; the actor's mean action follows it. The truth serves as it does in
a reward: while learning. What the actor sees is the observation.

How later actions would answer a changed one is left out. Where none can be better alone, both gradients are 0.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor

from agents.torch_bound import promised_std
from passive_env.mobile_observation import course_of
from passive_env.placement import Task
from passive_env.velocities import SHORTEST_M

ACTIONS = "velocities"
"""The kind of actions that it learns."""

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
        courses: [e, k, 2] unit vectors that actions were told by (`passive_env.mobile_observation.course_of`).
    """

    scenario: Any
    task: Task
    path: np.ndarray
    courses: np.ndarray


class BoundGradient(PPO):
    """An actor that follows the gradient of the bound; Stable-Baselines3's, with another way to fly and to learn.

    Of `PPO`'s arguments those count that say how much is flown and how the network is changed: learning_rate, n_steps,
    batch_size, n_epochs, max_grad_norm and policy_kwargs. It explores with the spread that the policy begins with.
    A rollout is an episode of all environments, which are `agents.sb3.Sb3VecEnv` of sensors on carriers.

    Args:
        args, kwargs: `PPO`'s.
        max_slope: norm to which the gradient with respect to one action is cut. Where sensors are installed counts a
            hundred times more than one step of their carriers, and few draws more than all the others together.
    Raises:
        ValueError: a norm that is not positive.
    """

    def __init__(self, *args: Any, max_slope: float = 0.5, **kwargs: Any):
        if not max_slope > 0.0:
            raise ValueError(f"max_slope {max_slope}: must be positive")
        self.max_slope = max_slope
        super().__init__(*args, **kwargs)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_seen", "_flown", "_flights"]

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        """Fly an episode of all environments, and keep what its gradient needs."""
        self.policy.set_training_mode(False)
        callback.on_rollout_start()
        parts: list[Any] = [part.env for part in getattr(env, "parts", [env])]
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
        """Change the actor along the gradient of what was flown."""
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        ends = np.cumsum([len(flight.path) for flight in self._flights])[:-1]
        found = [
            gradient(actions, flight)
            for actions, flight in zip(np.split(self._flown, ends), self._flights, strict=True)
        ]
        slope, bound = (np.concatenate(parts) for parts in zip(*found, strict=True))
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
    places = carried(a.unflatten(-1, (scenario.sensors, 3)), flight)
    bound = promised_std(
        places, torch.as_tensor(flight.path), torch.as_tensor(np.asarray(flight.task.std)),
        torch.as_tensor(scenario.ranging), scenario.make_tracker(), scenario.step_s, EDGE_M,
    )  # fmt: skip
    loss(bound, scenario).sum().backward()
    assert a.grad is not None
    return a.grad.numpy(), bound.detach().numpy()


def loss(bound: Tensor, scenario: Any) -> Tensor:
    """What episodes [e] lose by the weights of their scenario's reward, bounds [e, k] m standing for errors.

    It knows the terms that a bound can stand for: the position's errors and their logarithms, at every scan and at the
    last, and the bound's own. They are neither floored nor cut.
    """
    log, far = torch.log(bound / 1e3), bound / 1e3
    logs, errors, final_log, final = (
        scenario.reward_log_position_error + scenario.reward_log_position_bound, scenario.reward_position_error,
        scenario.reward_final_log_position_error, scenario.reward_final_position_error,
    )  # fmt: skip
    return (logs * log + errors * far).sum(dim=1) + final_log * log[:, -1] + final * far[:, -1]


# -- where actions take carriers ---------------------------------------------------------------------------------------


def carried(actions: Tensor, flight: Flight) -> Tensor:
    """Places [e, k, n, 3] m at the scans, by `passive_env.velocities` and `passive_env.mobile_simulation.drive`.

    Args:
        actions: [e, k, n, 3] in [−1, 1]: first the places of installation, then ahead, left and up.
        flight: supplies tasks, courses and the carriers' speeds.
    """
    s, limits = flight.scenario, _limits(flight.task)
    reach, climb = s.speed_m_s * s.step_s, s.climb_m_s * s.step_s
    courses = torch.as_tensor(flight.courses)
    places = [_installed(actions[:, 0], limits)]
    for t in range(1, actions.shape[1]):
        c, q = courses[:, t, :1], courses[:, t, 1:]
        ahead, left, up = actions[:, t].unbind(dim=-1)
        way = torch.stack([reach * (c * ahead - q * left), reach * (q * ahead + c * left), climb * up], dim=-1)
        places.append(_driven(places[-1], _inside(_across(places[-1], way, limits), limits), reach, climb))
    return torch.stack(places, dim=1)


class _Limits(NamedTuple):
    """Where carriers may be sent, each [e, 1] m or rad: distances from the entry and the entry's own from the site."""

    distance: tuple[Tensor, Tensor]
    azimuth: Tensor
    top: Tensor
    entry: Tensor


def _limits(task: Task) -> _Limits:
    column: Callable[[Any], Tensor] = lambda part: torch.as_tensor(np.asarray(part, dtype=float))[:, None]  # noqa: E731
    near, far = column(task.distance_m[:, 0]), column(task.distance_m[:, 1])
    return _Limits(
        (near, far), column(task.azimuth_limit_rad), column(task.height_limit_m), column(task.entry_distance_m)
    )


def _installed(actions: Tensor, limits: _Limits) -> Tensor:
    """Places [e, n, 3] of sensors by distance, azimuth and height [e, n, 3] in [−1, 1]."""
    (near, far), (distance, azimuth, height) = limits.distance, actions.unbind(dim=-1)
    distance = near + 0.5 * (distance + 1.0) * (far - near)
    return _site(distance, azimuth * limits.azimuth, 0.5 * (height + 1.0) * limits.top, limits)


def _site(distance: Tensor, azimuth: Tensor, height: Tensor, limits: _Limits) -> Tensor:
    """Places [e, n, 3]; `passive_env.placement.site`."""
    return torch.stack([limits.entry - distance * torch.cos(azimuth), -distance * torch.sin(azimuth), height], dim=-1)


def _across(here: Tensor, way: Tensor, limits: _Limits) -> Tensor:
    """Where ways [e, n, 3] from places [e, n, 3] lead, as in `passive_env.velocities`."""
    (x, y, _), (u, v, _) = here.unbind(dim=-1), way.unbind(dim=-1)
    x = x - limits.entry
    a, b, c = u * u + v * v, x * u + y * v, x * x + y * y - limits.distance[0] ** 2
    crosses = (a + 2.0 * b + c < 0.0) & (a > SHORTEST_M**2)
    far = ((b * b - a * c).clamp(min=1.0).sqrt() - b) / a.clamp(min=SHORTEST_M**2)
    share = torch.where(crosses, far, torch.ones_like(far))
    return here + torch.stack([share * u, share * v, way[..., 2]], dim=-1)


def _inside(places: Tensor, limits: _Limits) -> Tensor:
    """The places [e, n, 3] that carriers are sent to: distance, azimuth and height each cut to its limits."""
    x, y, z = places.unbind(dim=-1)
    along = limits.entry - x
    distance = _level(along, y).clamp(*limits.distance)
    azimuth = torch.atan2(-y, along).clamp(-limits.azimuth, limits.azimuth)
    return _site(distance, azimuth, z.clamp(torch.zeros_like(limits.top), limits.top), limits)


def _driven(here: Tensor, goal: Tensor, reach: float, climb: float) -> Tensor:
    """Places [e, n, 3] after a step on the straight way to a goal."""
    x, y, z = (goal - here).unbind(dim=-1)
    share = (reach / _level(x, y)).clamp(max=1.0)
    return here + torch.stack([share * x, share * y, z.clamp(-climb, climb)], dim=-1)


def _level(x: Tensor, y: Tensor) -> Tensor:
    return (x * x + y * y).clamp(min=1e-12).sqrt()
