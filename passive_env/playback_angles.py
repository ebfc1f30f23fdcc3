"""Recorded azimuths and elevations of one target, tracked in space."""

from __future__ import annotations

from typing import Any

import numpy as np

from passive_env.angle_sensors import CLEAN_DENSITY, AngleSighting
from passive_env.core import World
from passive_env.playback import Fit, Playback, fit_of, turn_commands
from passive_env.recording import Recording
from trackers.angle_contract import AngleScan
from trackers.gaussian import Gaussian


class AnglePlayback(Playback):
    """Azimuths and elevations of one target, perhaps among false returns; ranges count from the first platform."""

    def __init__(self, scenario: Any, recording: Recording):
        super().__init__(scenario, recording)
        told = np.radians([scenario.azimuth_std_deg, scenario.elevation_std_deg])
        self._std = np.where(np.isnan(recording.std), told, recording.std)
        density = recording.clutter_density
        self._density = np.where(np.isnan(density), self._usual_density(), density)

    def _usual_density(self) -> float:
        """False returns per rad² where the file does not tell; 0: unknown, the returns in a gate are counted."""
        s = self.scenario
        if s.clutter_density_per_deg2 > 0.0 and s.clutter_known:
            return s.clutter_density_per_deg2 * (180.0 / np.pi) ** 2
        clean = s.clutter_mean == 0.0 and s.clutter_density_per_deg2 == 0.0 and self.recording.valid.shape[-1] == 1
        return CLEAN_DENSITY if clean else 0.0

    def begin(self) -> tuple[int, World]:
        """The track starts at the first return with azimuth and elevation."""
        r = self.recording
        ready = np.flatnonzero((r.valid.any(-1) & r.available.all(-1)).any(-1))
        if not len(ready):
            raise ValueError(f"{r.source}: has no return with azimuth and elevation, a track starts from one")
        index = int(ready[0])
        scan = self._scan_at(index, True)
        state = self.tracker.initiate(scan)
        estimate = self.tracker.estimate(state)
        nothing = Gaussian(np.zeros_like(estimate.mean), np.zeros_like(estimate.cov))
        reports = self.sensors.acquired(AngleSighting(scan, nothing.mean, None, nothing), state)
        return index, self._world(index, state, estimate, reports)

    def sighting(self, index: int, world: World, predicted: Any, heard: bool) -> AngleSighting:
        """The returns of an instant."""
        return AngleSighting(self._scan_at(index, heard), world.truth, None, self.tracker.estimate(predicted))

    def flown(self, before: np.ndarray, after: np.ndarray, time_s: float) -> np.ndarray:
        """Turns of all platforms, then climbs."""
        turns = turn_commands(before, after, np.radians(self.scenario.max_turn_rate_deg_s), time_s)
        climbs = (after[..., 2] - before[..., 2]) / (time_s * max(self.scenario.max_climb_m_s, 1e-9))
        return np.concatenate([turns, np.clip(climbs, -1.0, 1.0)], axis=-1)

    def maneuver(self, command: np.ndarray) -> dict[str, float | str]:
        """Turns of all platforms, then climbs."""
        names = self.recording.stations
        climbs = self.scenario.max_climb_m_s * command[len(names) :]
        return self.turns(command) | {
            f"climb_{name}_m_s": float(climb) for name, climb in zip(names, climbs, strict=True)
        }

    def fit(self, scan: AngleScan, update: Any) -> Fit:
        """The sum of the sensors' own, of averaged innovations; that sensors share the track's error is left out."""
        used = update.assignment >= 0
        counted = used[..., None] & scan.available[:, None]
        nu = np.where(counted, update.innovation, 0.0)
        S = np.where(counted[..., None] & counted[..., None, :], update.innovation_cov, np.eye(2))
        nis = (nu * np.linalg.solve(S, nu[..., None])[..., 0]).sum((-2, -1))
        return fit_of(nis, counted.sum((-2, -1)), update.log_likelihood, used)

    def _scan_at(self, index: int, heard: bool) -> AngleScan:
        r = self.recording
        valid, available = r.valid[None, index] & heard, r.available[None, index] & heard
        angles = np.where(valid[..., None], r.angles[None, index], 0.0)
        places = np.ascontiguousarray(r.platforms[None, index, :, :3])
        return AngleScan(angles, valid, places, self._std[None, index], available, self._density[None, index])
