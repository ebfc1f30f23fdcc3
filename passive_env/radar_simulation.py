"""Episodes of a passive radar: a track started from several scans, then one choice of transmitters per scan."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from passive_env.core import Simulation, World, check_estimate
from passive_env.radar_sensors import RadarBelief, coarse_guess, stack_scans


class RadarSimulation(Simulation):
    """A passive radar's parts, put together once; holds no state of any episode.

    Commands are the receiver's turn, where it moves, then a score per transmitter.
    """

    def begin(self, generators: Sequence[np.random.Generator]) -> World:
        """Draw a tape per generator, listen to every transmitter in its turn and start the track."""
        tape = self.scenario.draw_tape(generators)
        sightings, times = self.sensors.acquire(tape)
        guess = coarse_guess(tape.guess, self.scenario.guess_std)
        state = self.tracker.initiate(stack_scans(sightings), guess, times)
        estimate, truth = self.tracker.estimate(state), sightings[-1].truth
        check_estimate(estimate, truth.shape, self.tracker)
        reports = self.sensors.acquired(sightings)
        bound, metrics = self.metrics.begin(estimate, truth, sightings, guess, tape)
        batch = len(generators)
        return World(
            np.zeros(batch, dtype=np.int64), tape.platforms, tape, state, estimate, reports,
            np.zeros((batch, self.actions.size)), bound, truth, metrics,
            self.metrics.violations(tape.platforms, truth, tape),
        )  # fmt: skip

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
