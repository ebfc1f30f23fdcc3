"""Where actions take sensors on carriers, in PyTorch: with gradients with respect to the actions."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from passive_env.placement import Task
from passive_env.velocities import SHORTEST_M


def carried(actions: Tensor, courses: Tensor, task: Task, reach: float, climb: float) -> Tensor:
    """Places [e, k, n, 3] m at the scans, by `passive_env.velocities` and `passive_env.mobile_simulation.drive`.

    Args:
        actions: [e, k, n, 3] in [−1, 1]: first the places of installation, then ahead, left and up.
        courses: [e, k, 2] unit vectors that the actions are told by (`passive_env.mobile_observation.course_of`).
        task: limits of the places that carriers may be sent to.
        reach, climb: what a carrier can go in a step, level and up or down [m].
    """
    limits = _limits(task)
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
    near, far = _column(task.distance_m[:, 0]), _column(task.distance_m[:, 1])
    return _Limits(
        (near, far), _column(task.azimuth_limit_rad), _column(task.height_limit_m), _column(task.entry_distance_m)
    )


def _column(part: Any) -> Tensor:
    return torch.as_tensor(np.asarray(part, dtype=float))[:, None]


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
    near = limits.distance[0]
    a, b, c = u * u + v * v, x * u + y * v, x * x + y * y - near * near
    crosses = (a + 2.0 * b + c + near * near < (near - SHORTEST_M) ** 2) & (a > SHORTEST_M**2)
    far = ((b * b - a * c).clamp(min=1.0).sqrt() - b) / a.clamp(min=SHORTEST_M**2)  # a root of 0 has no slope
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
