"""Recorded bearings that do not say which target they are of, tracked by the bank of range hypotheses."""

from __future__ import annotations

from typing import Any

import numpy as np

from passive_env.core import World, map_rows
from passive_env.playback import Fit, Playback, first_scan, fit_of, turn_commands
from passive_env.recording import Recording
from passive_env.sensors import Sighting
from trackers.adaptive_rp_ekf import ModelBank
from trackers.angles import circular_mean, wrap
from trackers.contract import Scan


class BearingPlayback(Playback):
    """Unlabelled bearings; the last station is the reference, and its first bearings start the tracks."""

    def __init__(self, scenario: Any, recording: Recording):
        if len(recording.stations) > 2:
            raise ValueError(
                f"{recording.source}: has {len(recording.stations)} stations, {', '.join(recording.stations)}; the "
                "bank weighs bearings of one or two: leave stations out"
            )
        super().__init__(scenario, recording)
        self._std = scan_std(scenario, recording)

    def begin(self) -> tuple[int, World]:
        """Tracks in the order of the reference's bearings, counter-clockwise about their middle."""
        index = first_scan(self.recording)
        scan = _counter_clockwise(self._scan_at(index, True))
        tracks = int(scan.valid[0, -1].sum())
        state = self.tracker.initiate(scan)
        state = map_rows(lambda part: np.ascontiguousarray(part[:, :tracks]), state)
        estimate = self.tracker.estimate(state)
        reports = self.sensors.acquired(
            Sighting(_cut(scan, tracks), np.zeros_like(estimate.mean), np.full(scan.valid.shape, -1)), state
        )
        return index, self._world(index, state, estimate, reports)

    def sighting(self, index: int, world: World, predicted: Any, heard: bool) -> Sighting:
        """The bearings of an instant."""
        return Sighting(self._scan_at(index, heard), world.truth, None)

    def flown(self, before: np.ndarray, after: np.ndarray, time_s: float) -> np.ndarray:
        """Turns of all stations."""
        return turn_commands(before, after, np.radians(self.scenario.max_turn_rate_deg_s), time_s)

    def maneuver(self, command: np.ndarray) -> dict[str, float | str]:
        """Turns of all stations."""
        return self.turns(command)

    def fit(self, scan: Scan, update: Any) -> Fit:
        """Stations count one by one, as they are used."""
        used = update.assignment >= 0
        nis = np.where(used, np.square(update.innovation) / update.innovation_var, 0.0).sum(-1)
        stations = len(self.recording.stations)
        told = np.concatenate([np.zeros((*used.shape[:2], stations - used.shape[2]), dtype=bool), used], axis=-1)
        return fit_of(nis, used.sum(-1), update.log_likelihood, told)

    def weights(self, state: Any) -> tuple[np.ndarray, np.ndarray]:
        """Of range hypotheses, and of the motion models of an adaptive bank."""
        weight = np.exp(state.log_weights)[0]
        if isinstance(state, ModelBank):
            return weight.sum(-1), weight.sum(-2)
        return weight, np.empty((len(weight), 0))

    def _scan_at(self, index: int, heard: bool) -> Scan:
        r = self.recording
        valid = r.valid[None, index] & heard
        bearings = np.where(valid, r.angles[None, index, ..., 0], 0.0)
        return Scan(bearings, valid, r.platforms[None, index, :, :2], self._std[index])


def scan_std(scenario: Any, recording: Recording) -> np.ndarray:
    """[k] rad, the bearings' standard deviation in every scan.

    Raises:
        ValueError: stations that differ in it, which the bank does not take.
    """
    std = np.where(np.isnan(recording.std[..., 0]), np.radians(scenario.bearing_std_deg), recording.std[..., 0])
    shown = recording.valid.any(-1)
    highest = np.where(shown, std, -np.inf).max(-1)
    apart = np.flatnonzero(highest > np.where(shown, std, np.inf).min(-1))
    if len(apart):
        raise ValueError(
            f"{recording.source}: at {recording.time_s[apart[0]]:g} s stations differ in their bearings' standard "
            "deviation; the bank takes one for all: give the larger one to both"
        )
    return np.where(shown.any(-1), highest, np.radians(scenario.bearing_std_deg))


def _counter_clockwise(scan: Scan) -> Scan:
    """A scan of one episode with every station's returns in order about their mean direction, and no empty slots."""
    bearings, valid = np.zeros_like(scan.bearings), np.zeros_like(scan.valid)
    for s in range(bearings.shape[1]):
        own = scan.bearings[0, s][scan.valid[0, s]]
        own = own[np.argsort(wrap(own - circular_mean(own)), kind="stable")] if len(own) else own
        bearings[0, s, : len(own)], valid[0, s, : len(own)] = own, True
    return _cut(Scan(bearings, valid, scan.stations, scan.bearing_std), int(valid.sum(-1).max()))


def _cut(scan: Scan, slots: int) -> Scan:
    """The first slots of a scan."""
    return scan._replace(
        bearings=np.ascontiguousarray(scan.bearings[..., :slots]), valid=np.ascontiguousarray(scan.valid[..., :slots])
    )
