"""Episodes of sensors on carriers: the first action installs them, every later one says where they should go."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from passive_env.core import Simulation, World
from passive_env.placement import Task, positions
from trackers.compiled import helper, kernel


class MobileBelief(NamedTuple):
    """What an operator knows after a scan; e environments, n sensors.

    Attributes:
        steps_left: [e] decisions left in the episode.
        platforms: [e, n, 6] sensors m, m/s; until they are installed they stand at the site.
        mean: [e, 1, 6] the track; before its first scan what is expected of the target.
        cov: [e, 1, 6, 6] its covariance.
        last_action: [e, 3 n] the previous action, 0 at first.
        task: what is known of courses, accuracies and limits.
        installed: [e] bool, whether the sensors are.
        measured: [e, n] bool, whether a sensor measured the target at the last scan.
        track_state: the tracker's own state.
        measurement: [e, n, 3] what it measured: range [m], azimuth and elevation [rad]; 0 where it did not.
    """

    steps_left: Any
    platforms: Any
    mean: Any
    cov: Any
    last_action: Any
    task: Task
    installed: Any
    measured: Any
    track_state: Any
    measurement: Any


class MobileSimulation(Simulation):
    """A scenario's parts with sensors on carriers, put together once; holds no state of any episode."""

    def move(self, world: World, command: Any) -> np.ndarray:
        """Carriers [e, n, 6] after one step of commands [e, 3 n] in [−1, 1]; the first one sets them down."""
        goals = wanted(command, world.tape.task)
        s = self.scenario
        return drive(world.platforms, goals, world.step == 0, s.speed_m_s, s.climb_m_s, s.step_s)

    def belief(self, world: World) -> Any:
        """What an operator knows of the world."""
        return MobileBelief(
            self.scenario.steps - world.step, world.platforms, world.estimate.mean, world.estimate.cov,
            world.last_action, world.tape.task, world.step > 0, world.reports.measured, world.track_state,
            world.reports.measurement,
        )  # fmt: skip


def wanted(command: Any, task: Task) -> np.ndarray:
    """Places [e, ..., n, 3] m that commands [e, ..., 3 n] mean (`passive_env.placement.positions`)."""
    command = np.asarray(command, dtype=float)
    return positions(command.reshape(*command.shape[:-1], -1, 3), task)


@helper
def _drive_one(place, goal, speed, climb, T):
    """What a carrier at a place [3] flies towards its goal [3] in T seconds, level straight: dx, dy, dz [m]."""
    dx, dy = goal[0] - place[0], goal[1] - place[1]
    share = min(1.0, speed * T / max(math.hypot(dx, dy), 1e-9))
    return share * dx, share * dy, min(max(goal[2] - place[2], -climb * T), climb * T)


@kernel("(n,x6),(n,p3),(),(),(),()->(n,x6)", "FFbfffF")
def drive(platforms, goals, install, speed, climb, T, moved):
    """Carriers [n, 6] after T seconds on the straight way to their goals [n, 3], or set down there.

    speed: level [m/s]; climb: up or down [m/s].
    """
    for s in range(platforms.shape[0]):
        if install:
            for i in range(3):
                moved[s, i], moved[s, 3 + i] = goals[s, i], 0.0
        else:
            step = _drive_one(platforms[s], goals[s], speed, climb, T)
            for i in range(3):
                moved[s, i], moved[s, 3 + i] = platforms[s, i] + step[i], step[i] / T


@kernel("(n,x6),(n,p3),(),(),(),(),(k)->(k,n,p3)", "FFbfffFF")
def routes(platforms, goals, install, speed, climb, T, like, places):
    """Places [k, n, 3] of carriers at the next k scans, as `drive` moves them; `like` [k] says how many."""
    for s in range(platforms.shape[0]):
        for t in range(like.shape[0]):
            for i in range(3):
                places[t, s, i] = platforms[s, i] if t == 0 else places[t - 1, s, i]
            if install:
                for i in range(3):
                    places[t, s, i] = goals[s, i]
            else:
                step = _drive_one(places[t, s], goals[s], speed, climb, T)
                for i in range(3):
                    places[t, s, i] += step[i]
