"""The receiver of a passive radar: which transmitters it listens to, whose echoes come back, and what misses tell."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from passive_env.blockage import Stretches, predict_blocked, update_blocked
from passive_env.radar_tape import Echoes, RadarTape
from passive_env.renewal import Renewal
from trackers.compiled import helper, kernel
from trackers.gaussian import Gaussian
from trackers.range_sum_contract import RangeSumScan, RangeSumUpdate

NEVER_S = 1e4
"""Time since what has not happened yet, and the most that is counted."""

LARGEST_STD_M = 1e6
"""Standard deviations of range sums are cut here."""


class RadarBelief(NamedTuple):
    """What an operator knows after a scan; e environments, n transmitters, d dimensions.

    Attributes:
        steps_left: [e] decisions left in the episode.
        platforms: [e, 1, 2d] the receiver's state m, m/s.
        mean: [e, 1, 2d] track mean.
        cov: [e, 1, 2d, 2d] track covariance.
        last_action: [e, a] the previous command, 0 at first.
        track_state: the tracker's own state.
        discs: [e, 0, 3] there are no no-go discs.
        transmitters: [e, n, d] m.
        chosen: [e, n] bool, selected for the last scan.
        wait_s: [e, n] time until an echo can come: of those chosen what is left of the retuning, of the others all of
            it.
        answered: [e, n] bool, whose echoes the last scan brought.
        missed: [e, n] bool, whose echoes it did not bring although the receiver listened.
        since_answer_s, since_miss_s: [e, n] time since the last echo and the last miss, at most `NEVER_S`.
        blocked_probability: [e, n] of being blocked at the last scan's instant (`passive_env.blockage`).
        stretch: [e, n, 2, r] probabilities of being blocked, and clear, for how much longer (`passive_env.renewal`).
        std: [e, n] m, standard deviations of the last scan's range sums, where the track was predicted.
        statistic: [e] of the tracker's maneuver test, 0 where the track coasted.
        maneuver: [e] bool, whether the test fired.
    """

    steps_left: Any
    platforms: Any
    mean: Any
    cov: Any
    last_action: Any
    track_state: Any
    discs: Any
    transmitters: Any
    chosen: Any
    wait_s: Any
    answered: Any
    missed: Any
    since_answer_s: Any
    since_miss_s: Any
    blocked_probability: Any
    stretch: Any
    std: Any
    statistic: Any
    maneuver: Any


class Listening(NamedTuple):
    """What is known of every transmitter after a scan; fields as in `RadarBelief`."""

    chosen: Any
    wait_s: Any
    answered: Any
    missed: Any
    since_answer_s: Any
    since_miss_s: Any
    blocked_probability: Any
    stretch: Any


class RadarSighting(NamedTuple):
    """A scan, and what only the world knows about it.

    Attributes:
        scan: what the tracker gets.
        listening: what the operator gets.
        truth: [e, m, 2d] true target state at this instant.
        blocked: [e, n] bool.
    """

    scan: RangeSumScan
    listening: Listening
    truth: Any
    blocked: Any


class RadarReports(NamedTuple):
    """What the last scan brought.

    Attributes:
        listening: as an operator sees it.
        statistic, maneuver: as in `RadarBelief`.
        scan: the scan itself.
        blocked: [e, n] bool, the truth, for figures and pictures only.
    """

    listening: Listening
    statistic: Any
    maneuver: Any
    scan: RangeSumScan
    blocked: Any


class Receiver(NamedTuple):
    """What a receiver can do.

    Attributes:
        channels: transmitters that it listens to in a scan.
        retune_delay_s: time from a choice until a newly chosen transmitter's echo can come.
        std_m: standard deviation of a range sum.
        std_range_m: ranges at which it is so: elsewhere it goes with the product of the target's distances from
            receiver and transmitter; 0 for the same everywhere.
        std_floor_m: least standard deviation.
        echo_probability: of an echo from a transmitter that is not blocked.
        step_s: time between scans.
    """

    channels: int
    retune_delay_s: float
    std_m: float
    std_range_m: float
    std_floor_m: float
    echo_probability: float
    step_s: float


@helper
def choose(scores, channels, chosen):
    """Mark the `channels` highest of scores [n]; of equal ones the first."""
    chosen[:] = False
    for _ in range(channels):
        best = -1
        for i in range(scores.shape[0]):
            if not chosen[i] and (best < 0 or scores[i] > scores[best]):
                best = i
        chosen[best] = True


@helper
def distance(a, b, d):
    """Distance of two points of d coordinates."""
    total = 0.0
    for i in range(d):
        total += (a[i] - b[i]) ** 2
    return math.sqrt(total)


@helper
def sum_std(r, r_i, std, std_range, floor):
    """Standard deviation of a range sum of distances r from the receiver and r_i from the transmitter."""
    if std_range == 0.0:
        return std
    value = std * r * r_i / (std_range * std_range)
    return min(value, LARGEST_STD_M) if value > floor else floor  # a diverged track's NaN reads as the least


@kernel(
    "(t,m,y),(t,n),(t,n),(t,n),(),(s,y),(n,d),(n),(n),(n),(n),(n),(n),(m,y),(l)"
    "->(n),(n),(n),(n),(n),(n),(n),(n),(n),(n),(m,y)",
    "FFBBiFFFBFFFFFFFBFBFBFFFBF",
)
def _listen(targets, noise, heard, blocked, t, platforms, transmitters, scores, was_chosen, was_waiting, was_answer,
            was_miss, was_blocked, predicted, limits, sums, answered, std, chosen, wait, missed, since_answer,
            since_miss, probability, blocked_now, truth):  # fmt: skip
    channels, delay, T, missing = int(limits[0]), limits[1], limits[2], 1.0 - limits[3]
    d, receiver = transmitters.shape[1], platforms[0]
    truth[:] = targets[t]
    r, r_predicted = distance(truth[0], receiver, d), distance(predicted[0], receiver, d)
    choose(scores, channels, chosen)
    for i in range(transmitters.shape[0]):
        wait[i] = max((was_waiting[i] if was_chosen[i] else delay) - T, 0.0) if chosen[i] else delay
        listened = chosen[i] and wait[i] < 1e-6 * T
        answered[i] = listened and heard[t, i] and not blocked[t, i]
        missed[i] = listened and not answered[i]
        r_i = distance(truth[0], transmitters[i], d)
        std[i] = sum_std(r_predicted, distance(predicted[0], transmitters[i], d), limits[4], limits[5], limits[6])
        sums[i] = 0.0
        if answered[i]:
            sums[i] = r + r_i + noise[t, i] * sum_std(r, r_i, limits[4], limits[5], limits[6])
        since_answer[i] = 0.0 if answered[i] else min(was_answer[i] + T, NEVER_S)
        since_miss[i] = 0.0 if missed[i] else min(was_miss[i] + T, NEVER_S)
        probability[i] = predict_blocked(was_blocked[i], limits[7], limits[8])
        if listened:
            probability[i] = update_blocked(probability[i], answered[i], missing)
        blocked_now[i] = blocked[t, i]


class SumReceiver:
    """Listens to the chosen transmitters and keeps account of who answered.

    Args:
        tracker: supplies the predicted track at which the scan's standard deviations are told.
        receiver: what the receiver can do.
        stretches: for how long transmitters are blocked and clear.
    """

    def __init__(self, tracker: Any, receiver: Receiver, stretches: Stretches):
        self._tracker, self._receiver = tracker, receiver
        r = receiver
        rest = (r.step_s, r.echo_probability, r.std_m, r.std_range_m, r.std_floor_m, *stretches.leaving(r.step_s))
        self._limits = np.array([r.channels, r.retune_delay_s, *rest])
        self._tuned = np.array([r.channels, 0.0, *rest])
        self._share, self._renewal = stretches.share, Renewal(stretches, r.step_s, r.echo_probability)

    def acquire(self, tape: RadarTape, expected: Any = None) -> tuple[list[RadarSighting], Any]:
        """The scans from which a track is started, every transmitter in its turn, and their times [t] s.

        Before the first decision receivers wait for nothing: each of these scans has all its echoes.

        Args:
            tape: of the episodes.
            expected: [e, 2d] target's state at the first scan, for which standard deviations are told; None: the guess.
        """
        expected = tape.guess if expected is None else expected
        a, n = tape.acquisition.noise.shape[1:]
        times = self._receiver.step_s * np.arange(a)
        d, platforms = tape.transmitters.shape[-1], tape.platforms
        known, sightings = self.nothing_known(*tape.noise.shape[::2]), []
        for t in range(a):
            turn = (np.arange(n) - t * self._receiver.channels) % n < self._receiver.channels
            at = platforms.copy()
            at[..., :d] += platforms[..., d:] * (times[t] - times[-1])
            place = expected.copy()
            place[:, :d] += place[:, d:] * times[t]
            scores = np.broadcast_to(turn.astype(float), (len(at), n))
            step = np.full(len(at), t)
            sightings.append(
                self._sense(tape.acquisition, step, at, tape.transmitters, scores, known, place[:, None], self._tuned)
            )
            known = sightings[-1].listening
        sightings[-1] = sightings[-1]._replace(listening=self.settled(known))
        return sightings, times

    def sense(self, tape: RadarTape, step, platforms, predicted: Any, scores, known: Listening) -> RadarSighting:
        """The scan of an instant: steps [e], receiver [e, 1, 2d], predicted state, scores [e, n], what was known."""
        mean = self._tracker.estimate(predicted).mean
        return self._sense(tape, step, platforms, tape.transmitters, scores, known, mean, self._limits)

    def recorded(
        self, answered: Any, listened: Any, known: Listening, platforms: Any, transmitters: Any, mean: Any, tuned: bool
    ) -> RadarSighting:
        """A scan of one episode in which it is known who was listened to and who answered, each [1, n] bool.

        Its range sums mean nothing. Whoever answers has been listened to, whatever was known of its tuning.

        Args:
            known: before the scan; platforms: [1, 1, 2d]; transmitters: [1, n, d].
            mean: [1, 1, 2d] of the predicted track, for which standard deviations are told.
            tuned: whether no retuning delays an echo, as while a track is started.
        """
        limits = (self._tuned if tuned else self._limits).copy()
        limits[0] = listened.sum()
        waiting = np.where(answered, 0.0, known.wait_s)
        known = known._replace(chosen=known.chosen | answered, wait_s=waiting)
        nobody, n = np.zeros((1, 1, 1, mean.shape[-1])), answered.shape[1]
        echoes = Echoes(nobody, np.zeros((1, 1, n)), answered[:, None], np.zeros((1, 1, n), dtype=bool))
        step, scores = np.zeros(1, dtype=np.int64), np.where(listened, 1.0, -1.0)
        return self._sense(echoes, step, platforms, transmitters, scores, known, mean, limits)

    def settled(self, known: Listening) -> Listening:
        """What is known at the first decision, for which receivers have waited."""
        return known._replace(wait_s=np.where(known.chosen, 0.0, self._receiver.retune_delay_s))

    def acquired(self, sightings: list[RadarSighting]) -> RadarReports:
        """What is known when the track has been started."""
        last = sightings[-1]
        e = len(last.truth)
        return RadarReports(last.listening, np.zeros(e), np.zeros(e, dtype=bool), last.scan, last.blocked)

    def report(self, sighting: RadarSighting, update: RangeSumUpdate) -> RadarReports:
        """What a scan brought, and what the tracker makes of it.

        Raises:
            ValueError: a statistic or a test's outcome of another shape than one per episode.
        """
        for name in ("statistic", "maneuver"):
            found, wanted = np.shape(getattr(update, name)), sighting.truth.shape[:1]
            if found != wanted:
                owner = type(self._tracker).__name__
                raise ValueError(f"tracker {owner}: update() gave {name} of shape {found}, must be {wanted}")
        return RadarReports(sighting.listening, update.statistic, update.maneuver, sighting.scan, sighting.blocked)

    def info(self, reports: RadarReports) -> dict[str, Any]:
        """Who was asked and answered, who was blocked, and the tracker's maneuver test."""
        told = reports.listening
        return {
            "chosen": told.chosen, "answered": told.answered, "missed": told.missed, "blocked": reports.blocked,
            "blocked_probability": told.blocked_probability, "maneuver": reports.maneuver[:, None],
        }  # fmt: skip

    def nothing_known(self, episodes: int, transmitters: int) -> Listening:
        """What is known before the first scan."""
        shape = (episodes, transmitters)
        none, never = np.zeros(shape, dtype=bool), np.full(shape, NEVER_S)
        stretch = np.broadcast_to(self._renewal.stationary, (*shape, *self._renewal.stationary.shape))
        return Listening(none, np.zeros(shape), none, none, never, never, np.full(shape, self._share), stretch)

    def _sense(self, echoes: RadarTape | Echoes, step, platforms, transmitters, scores, known, mean, limits):
        sums, answered, std, chosen, wait, missed, since_answer, since_miss, probability, blocked, truth = _listen(
            echoes.targets, echoes.noise, echoes.heard, echoes.blocked, step, platforms, transmitters, scores,
            known.chosen, known.wait_s, known.since_answer_s, known.since_miss_s, known.blocked_probability, mean,
            limits,
        )  # fmt: skip
        d = transmitters.shape[-1]
        scan = RangeSumScan(sums, answered, transmitters, np.ascontiguousarray(platforms[:, 0, :d]), std)
        stretch = self._renewal.follow(known.stretch, answered, missed)
        listening = Listening(chosen, wait, answered, missed, since_answer, since_miss, probability, stretch)
        return RadarSighting(scan, listening, truth, blocked)


def stack_scans(sightings: list[RadarSighting]) -> RangeSumScan:
    """The scans of an acquisition with an axis for time."""
    parts = zip(*(sighting.scan for sighting in sightings), strict=True)
    return RangeSumScan(*(np.stack(part, axis=1) for part in parts))


def coarse_guess(mean: Any, std: Any) -> Gaussian:
    """What an operator knows of a target before the first scan: mean [e, 2d] and standard deviations [2d]."""
    cov = np.broadcast_to(np.diag(np.square(std)), (*np.shape(mean), len(std)))
    return Gaussian(mean, np.ascontiguousarray(cov))
