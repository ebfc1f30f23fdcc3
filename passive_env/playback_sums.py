"""Recorded range sums of a passive radar's echoes, tracked from an operator's guess and several scans."""

from __future__ import annotations

from typing import Any

import numpy as np

from passive_env.core import World
from passive_env.playback import Fit, Playback, fit_of, turn_commands
from passive_env.radar_sensors import coarse_guess, stack_scans
from passive_env.recording import SumRecording


class SumPlayback(Playback):
    """Range sums of one target; the track starts from several scans and an operator's guess.

    Args:
        scenario, recording: as of `Playback`.
        guess: [2d] m, m/s, state at the first scan, its errors those of the scenario's fields.
    """

    def __init__(self, scenario: Any, recording: SumRecording, guess: np.ndarray):
        scans = len(recording.time_s)
        if scans < scenario.acquisition_scans:
            raise ValueError(
                f"{recording.source}: has {scans} scans, a track starts from acquisition_scans = "
                f"{scenario.acquisition_scans}: take fewer of them, 'acquisition_scans={scans}' among the fields"
            )
        super().__init__(scenario, recording)
        self._guess = coarse_guess(np.asarray(guess, dtype=float)[None], scenario.guess_std)
        self._sites = np.ascontiguousarray(recording.transmitters[None])

    def begin(self) -> tuple[int, World]:
        """The track starts at the last of the scenario's acquisition scans."""
        last = self.scenario.acquisition_scans - 1
        times = self.recording.time_s[: last + 1] - self.recording.time_s[0]
        sightings = self._acquire(self._guess.mean, times)
        state = self.tracker.initiate(stack_scans(sightings), self._guess, times)
        if self.scenario.std_range_m > 0.0:  # noise goes with the ranges: told anew for the track found
            found = self.tracker.estimate(state).mean[:, 0].copy()
            d = found.shape[1] // 2
            found[:, :d] -= times[-1] * found[:, d:]
            sightings = self._acquire(found, times)
            state = self.tracker.initiate(stack_scans(sightings), self._guess, times)
        reports = self.sensors.acquired(sightings)
        return last, self._world(last, state, self.tracker.estimate(state), reports, self._sites)

    def sighting(self, index: int, world: World, predicted: Any, heard: bool) -> Any:
        """The echoes of an instant, and what they tell of the transmitters."""
        mean = self.tracker.estimate(predicted).mean
        return self._told(index, world.reports.listening, mean, heard, tuned=False)

    def flown(self, before: np.ndarray, after: np.ndarray, time_s: float) -> np.ndarray:
        """The receiver's turn, where it moves; whom it listens to is known without."""
        command = np.zeros((1, self.simulation.actions.size))
        if self.scenario.moves:
            command[:, :1] = turn_commands(before, after, np.radians(self.scenario.max_turn_rate_deg_s), time_s)
        return command

    def maneuver(self, command: np.ndarray) -> dict[str, float | str]:
        """Whom to listen to, and the receiver's turn, where it moves."""
        scores = command[-len(self.recording.names) :]
        highest = np.sort(np.argsort(-scores, kind="stable")[: self.scenario.listened])
        listen: dict[str, float | str] = {"listen": " ".join(self.recording.names[n] for n in highest)}
        return (self.turns(command) if self.scenario.moves else {}) | listen

    def fit(self, scan: Any, update: Any) -> Fit:
        """The statistic of the maneuver test."""
        used = update.used
        likelihood = update.log_likelihood[:, None]
        return fit_of(update.statistic[:, None], used.sum(-1)[:, None], likelihood, used[:, None])

    def _acquire(self, expected: np.ndarray, times: np.ndarray) -> list[Any]:
        """The first scans, standard deviations told for a target's state [1, 2d] at the first of them."""
        known, sightings, d = self.sensors.nothing_known(1, len(self.recording.names)), [], expected.shape[1] // 2
        for index, time_s in enumerate(times):
            place = expected.copy()
            place[:, :d] += place[:, d:] * time_s
            sightings.append(self._told(index, known, place[:, None], heard=True, tuned=True))
            known = sightings[-1].listening
        sightings[-1] = sightings[-1]._replace(listening=self.sensors.settled(known))
        return sightings

    def _told(self, index: int, known: Any, mean: np.ndarray, heard: bool, tuned: bool) -> Any:
        r = self.recording
        listened, answered = r.listened[None, index] & heard, r.answered[None, index] & heard
        sighting = self.sensors.recorded(answered, listened, known, r.platforms[None, index], self._sites, mean, tuned)
        std = np.where(np.isnan(r.std[None, index]), sighting.scan.std, r.std[None, index])
        sums = np.where(answered, r.range_sums[None, index], 0.0)
        return sighting._replace(scan=sighting.scan._replace(range_sums=sums, valid=answered, std=std))
