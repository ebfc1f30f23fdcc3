"""The single environment: a batch of one."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

from passive_env.belief import Belief
from passive_env.catalogue import make_scenario
from passive_env.core import Simulation, World
from passive_env.observations import Field
from passive_env.scenario import Scenario


class PassiveEnv(gym.Env[np.ndarray, Any]):
    """One episode of a passive-tracking scenario.

    Observation: ``Box(-5, 5, (d,), float32)``, a function of the belief only; `observation_fields` names every number,
        `passive_env.observations.TrackObservation` (in space `passive_env.angle_observation.AngleObservation`, of a
        maneuvering target `passive_env.maneuver_observation.ManeuverObservation`, of sensors to be placed
        `passive_env.placement_observation.PlacementObservation`, of sensors on carriers
        `passive_env.mobile_observation.MobileObservation`, of a passive radar
        `passive_env.radar_observation.RadarObservation`) lists them with units and scales.
    Action: ``Box(-1, 1, (a,), float32)``, one turn rate per platform as a share of its limit, counter-clockwise +, in
        space then one climb rate per platform, against a maneuvering target one speed per platform
        (``actions="discrete"``: `MultiDiscrete`, three of each); or the place of the next sensor
        (`passive_env.catalogue.placement.RadarPlacement`), or the places that sensors on carriers should go to
        (`passive_env.catalogue.mobile_placement.MobilePlacement`); or a score per transmitter
        (`passive_env.catalogue.passive_radar.PassiveRadar`).
    Reward: weighted terms (`passive_env.rewards`); ``info["reward_terms"]`` shows each. Default: −log(range error /
        1 km), in space and of a maneuvering target of the position error, mean over targets.
    Episode end: truncated after ``steps`` decisions; never terminated.
    info: ``range_error_m, position_error_m, range_m, range_crlb_m, nees, lost``, each [targets];
        ``standoff_violation, nogo_violation``: relative depth of intrusion into stand-off rings and no-go discs, summed
        over pairs, 0 while every platform keeps clear; ``reward_terms``; in space also ``position_crlb_m`` and
        ``dropped_returns``, each [targets]; what those with a maneuvering target show besides stands with
        `passive_env.catalogue.maneuvering.ManeuveringTarget`.

    Args:
        scenario: catalogue name or a `Scenario`.
        render_mode: None, "rgb_array" or "human".
        **fields: scenario fields to override.
    Version history: v0, first release.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array", "human"], "render_fps": 8}

    def __init__(self, scenario: str | Scenario = "TwoStation", render_mode: str | None = None, **fields: Any):
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode = {render_mode!r}: must be None, 'rgb_array' or 'human'")
        self.scenario = make_scenario(scenario, fields)
        self.render_mode = render_mode
        self.scenario.check_flights()
        self.simulation: Simulation = self.scenario.make_simulation()
        self.observation_space = self.simulation.observation.space
        self.action_space = self.simulation.actions.space
        self._world: World | None = None
        self._viewer: Any = None

    @property
    def observation_fields(self) -> tuple[Field, ...]:
        """Name, unit and scale of every number of the observation."""
        return self.simulation.observation.fields

    @property
    def world(self) -> World:
        """The true world, a batch of one; for evaluation and pictures, never for policies."""
        if self._world is None:
            raise gym.error.ResetNeeded("call reset() before step(), render() or belief()")
        return self._world

    def belief(self) -> Belief:
        """What an operator knows now, a batch of one."""
        return self.simulation.belief(self.world)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Begin an episode; returns observation and info."""
        info = self.begin(seed)
        return self._observation(), info

    def begin(self, seed: int | None = None) -> dict[str, Any]:
        """Begin an episode without observing it; returns info."""
        super().reset(seed=seed)
        self._world = self.simulation.begin([self.np_random])
        if self._viewer is not None:
            self._viewer.clear()
        if self.render_mode == "human":
            self.render()
        return self._info(dict.fromkeys(self.scenario.reward_weights, 0.0))

    def step(self, action: Any):
        """Fly one step; returns observation, reward, terminated, truncated, info.

        Raises:
            ValueError: action of the wrong shape or with values that are not finite.
            gymnasium.error.ResetNeeded: before the first reset or after the episode's end.
        """
        reward, truncated, info = self.fly(action)
        return self._observation(), reward, False, truncated, info

    def fly(self, action: Any) -> tuple[float, bool, dict[str, Any]]:
        """Fly one step without observing it; returns reward, truncated and info. Raises as `step` does."""
        world = self.world
        values = self.simulation.actions.decode(action, None)
        if world.step[0] >= self.scenario.steps:
            raise gym.error.ResetNeeded("the episode is over: call reset() before the next step()")
        self._world, reward, terms = self.simulation.advance(world, self.simulation.command(world, values))
        truncated = bool(self._world.step[0] >= self.scenario.steps)
        if self.render_mode == "human":
            self.render()
        values = {name: float(term[0]) for name, term in terms.items()}
        return float(reward[0]), truncated, self._info(values)

    def render(self):
        """Picture of the moment: an RGB array, or a window for mode "human"."""
        if self.render_mode is None:
            gym.logger.warn("render() needs gym.make(..., render_mode='rgb_array' or 'human')")
            return None
        if self._viewer is None:
            from passive_env.render import Viewer

            self._viewer = Viewer(self.simulation, self.render_mode)
        return self._viewer.draw(self.world)

    def close(self):
        """Close the window, if any."""
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None

    def _observation(self) -> np.ndarray:
        return self.simulation.observe(self.world)[0]

    def _info(self, terms: dict[str, float]) -> dict[str, Any]:
        shown = {name: _own(values[0]) for name, values in self.simulation.info(self.world).items()}
        return shown | {"reward_terms": terms}


def _own(value: Any) -> Any:
    """A number as Python's own, an array as a copy: what is handed out never changes later."""
    return value.copy() if isinstance(value, np.ndarray) else value.item()
