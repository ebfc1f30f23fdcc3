"""Recorded bearings of one target whose lines of sight cross: a fix per scan, tracked through maneuvers."""

from __future__ import annotations

from typing import Any

import numpy as np

from passive_env.core import World
from passive_env.maneuver_sensors import ManeuverSighting
from passive_env.playback import Fit, Playback, first_scan, fit_of, turn_commands
from passive_env.recording import Recording
from trackers.fix_contract import BearingScan


class FixPlayback(Playback):
    """One target's bearings from stations whose lines of sight cross; the last station is the reference."""

    def __init__(self, scenario: Any, recording: Recording):
        super().__init__(scenario, recording)
        std = recording.std[..., 0]
        self._std = np.where(np.isnan(std), 1e-3 * scenario.azimuth_std_mrad, std)

    def begin(self) -> tuple[int, World]:
        """The track starts at the first bearing."""
        index = first_scan(self.recording, reference_only=False)
        scan = self._scan_at(index, True)
        state = self.tracker.initiate(scan)
        estimate = self.tracker.estimate(state)
        reports = self.sensors.acquired(self._told(scan, estimate.mean), state)
        return index, self._world(index, state, estimate, reports)

    def sighting(self, index: int, world: World, predicted: Any, heard: bool) -> ManeuverSighting:
        """The bearings of an instant."""
        return self._told(self._scan_at(index, heard), world.truth)

    def flown(self, before: np.ndarray, after: np.ndarray, time_s: float) -> np.ndarray:
        """Turns of all stations, then their speeds."""
        s = self.scenario
        turns = turn_commands(before, after, np.radians(s.max_turn_rate_deg_s), time_s)
        room = max(s.top_speed_m_s - s.min_speed_m_s, 1e-9)
        share = (np.hypot(after[..., 2], after[..., 3]) - s.min_speed_m_s) / room
        return np.concatenate([turns, np.clip(2.0 * share - 1.0, -1.0, 1.0)], axis=-1)

    def maneuver(self, command: np.ndarray) -> dict[str, float | str]:
        """Turns of all stations, then their speeds."""
        s, names = self.scenario, self.recording.stations
        speeds = s.min_speed_m_s + (s.top_speed_m_s - s.min_speed_m_s) * 0.5 * (command[len(names) :] + 1.0)
        return self.turns(command) | {
            f"speed_{name}_m_s": float(speed) for name, speed in zip(names, speeds, strict=True)
        }

    def fit(self, scan: BearingScan, update: Any) -> Fit:
        """Of the fix, which has two coordinates."""
        fixed = update.fixed
        whitened = np.linalg.solve(update.innovation_cov, update.innovation[..., None])[..., 0]
        nis = np.where(fixed, (update.innovation * whitened).sum(-1), 0.0)
        used = fixed[..., None] & scan.valid[:, None]
        return fit_of(nis, np.where(fixed, 2, 0), update.log_likelihood, used)

    def weights(self, state: Any) -> tuple[np.ndarray, np.ndarray]:
        """Probabilities of the filters."""
        return np.empty((1, 0)), state.probability[0]

    def _told(self, scan: BearingScan, mean: np.ndarray) -> ManeuverSighting:
        return ManeuverSighting(scan, np.zeros_like(mean), np.zeros((*mean.shape[:2], 2)))

    def _scan_at(self, index: int, heard: bool) -> BearingScan:
        r = self.recording
        valid = r.valid[None, index, :, 0] & heard
        bearings = np.where(valid, r.angles[None, index, :, 0, 0], 0.0)
        return BearingScan(bearings, valid, r.platforms[None, index, :, :2], self._std[None, index])
