"""Episodes of a passive radar: a track started from several scans, then one choice of transmitters per scan."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from passive_env.core import Simulation, World, check_estimate
from passive_env.radar_sensors import RadarBelief, RadarSighting, coarse_guess, stack_scans
from trackers.gaussian import Gaussian


class RadarSimulation(Simulation):
    """A passive radar's parts, put together once; holds no state of any episode.

    Commands are the receiver's turn, where it moves, then a score per transmitter.
    """

    def begin(self, generators: Sequence[np.random.Generator]) -> World:
        """Draw a tape per generator, listen to every transmitter in its turn and start the track."""
        tape = self.scenario.draw_tape(generators)
        sightings, times = self.sensors.acquire(tape)
        guess = coarse_guess(tape.guess, self.scenario.guess_std)
        state = self._start(sightings, guess, times)
        if self.scenario.std_range_m > 0.0:  # the guess may be so far off that noise is ten times what it lets expect
            found = self.tracker.estimate(state).mean[:, 0].copy()
            d = found.shape[1] // 2
            found[:, :d] -= times[-1] * found[:, d:]
            sightings, times = self.sensors.acquire(tape, found)
            state = self._start(sightings, guess, times)
        estimate, truth = self.tracker.estimate(state), sightings[-1].truth
        reports = self.sensors.acquired(sightings)
        bound, metrics = self.metrics.begin(estimate, truth, sightings, guess, tape)
        batch = len(generators)
        return World(
            np.zeros(batch, dtype=np.int64), tape.platforms, tape, state, estimate, reports,
            np.zeros((batch, self.actions.size)), bound, truth, metrics,
            self.metrics.violations(tape.platforms, truth, tape),
        )  # fmt: skip

    def _start(self, sightings: list[RadarSighting], guess: Gaussian, times: Any) -> Any:
        """The tracker's state after the acquisition."""
        state = self.tracker.initiate(stack_scans(sightings), guess, times)
        check_estimate(self.tracker.estimate(state), sightings[-1].truth.shape, self.tracker)
        return state

    def belief(self, world: World) -> RadarBelief:
        """What an operator knows of the world."""
        told, known = world.reports, world.reports.listening
        return RadarBelief(
            self.scenario.steps - world.step, world.platforms, world.estimate.mean, world.estimate.cov,
            world.last_action, world.track_state, world.tape.discs, world.tape.transmitters, known.chosen,
            known.wait_s, known.answered, known.missed, known.since_answer_s, known.since_miss_s,
            known.blocked_probability, known.stretch, told.scan.std, told.statistic, told.maneuver,
        )  # fmt: skip

    def sense(self, world: World, step: Any, platforms: Any, predicted: Any, command: Any) -> Any:
        """The scan of the transmitters that the command's scores choose."""
        scores = command[:, -self.scenario.pool :]
        return self.sensors.sense(world.tape, step, platforms, predicted, scores, world.reports.listening)
