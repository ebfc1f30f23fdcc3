"""Episodes as objects of Stone Soup, and back: its metrics on our tracks, its trackers on our detections.

States are ordered as Stone Soup's motion models have them: x, vx, y, vy (, z, vz), positions at `MAPPING`. A detection
carries the measurement model of its station at its instant; angles are `Bearing` and `Elevation`. Numbers stay the same
bit for bit there and back.
Source: Stone Soup, https://stonesoup.readthedocs.io (extra ``stonesoup``).
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from passive_env.episode_arrays import EpisodeArrays, Returns
from passive_env.extras import needs

EXTRA = "stonesoup"
START = datetime(2000, 1, 1)
"""Time of the first scan, unless another one is given."""

MAPPING = {4: (0, 2), 6: (0, 2, 4)}
"""Places of the positions in states of so many numbers."""

MODEL = "measurement_model"
"""Its name in the metadata of a station's states."""

GENERATORS = ("gospa", "ospa", "siap")


class Episode(NamedTuple):
    """One episode as objects of Stone Soup.

    Attributes:
        truths: a `GroundTruthPath` per target.
        platforms: a `GroundTruthPath` per station; the metadata of its states have the measurement model and the
            number of slots of its scans. Of a passive radar stations are the transmitters, and its receiver, which
            has no model of its own, comes last.
        detections: per instant a set of `TrueDetection` and `Clutter`; their metadata say station and slot.
        tracks: a `Track` per target, of `GaussianState`.
    """

    truths: Any
    platforms: Any
    detections: Any
    tracks: Any


def to_stone_soup(recording: EpisodeArrays, start: datetime = START) -> list[Episode]:
    """Recorded episodes as objects of Stone Soup.

    Args:
        recording: as `passive_env.episode_arrays.record` makes it.
        start: time of the first scan.
    Raises:
        ImportError: Stone Soup is not installed.
    """
    needs("stonesoup", EXTRA)
    times = [start + timedelta(seconds=float(t)) for t in recording.times_s]
    return [_episode(recording, e, times) for e in range(len(recording.truth))]


def from_stone_soup(episodes: Sequence[Episode]) -> EpisodeArrays:
    """Episodes of Stone Soup's objects as arrays, such as tracks that one of its trackers made of our detections.

    Args:
        episodes: as of `to_stone_soup`, all of the same length, numbers of stations and targets. Where a track has
            several states of one instant, the last one counts.
    Raises:
        ImportError: Stone Soup is not installed; ValueError: episodes that differ in shape, tracks that are not one per
            truth, a state or detection that is missing or belongs nowhere, named.
    """
    needs("stonesoup", EXTRA)
    if not episodes:
        raise ValueError("episodes: there are none")
    for e, episode in enumerate(episodes):
        _check_paths(episode, f"episode {e}")
    times = [state.timestamp for state in episodes[0].truths[0]]
    parts = [_arrays(episode, f"episode {e}", times) for e, episode in enumerate(episodes)]
    shapes = [tuple(np.shape(array) for array in part) for part in parts]
    if len(set(shapes)) > 1:
        other = next(e for e, shape in enumerate(shapes) if shape != shapes[0])
        raise ValueError(f"episode {other} has arrays of shapes {shapes[other]}, episode 0 of {shapes[0]}: must agree")
    platforms, truth, mean, cov, transmitters, *returns = (np.stack(column) for column in zip(*parts, strict=True))
    seconds = np.array([(time - times[0]).total_seconds() for time in times])
    return EpisodeArrays(seconds, platforms, truth, mean, cov, Returns(*returns), transmitters)


def metrics(episode: Episode, cutoff_m: float = 10e3, order: float = 2.0) -> dict[str, dict[str, Any]]:
    """GOSPA, OSPA and SIAP metrics of an episode's tracks, by Stone Soup's generators.

    Args:
        episode: its tracks are compared with its truths.
        cutoff_m: distance c beyond which a target counts as missed and a track as false.
        order: p of GOSPA and OSPA.
    Returns:
        Stone Soup's metrics by the names `GENERATORS`, then by title.
    Raises:
        ImportError: Stone Soup is not installed; ValueError: a cutoff that is not positive, an order below 1, or
            no truths.
    """
    if not episode.truths:
        raise ValueError("the episode has no truths: must have at least one")
    if not (np.isfinite(cutoff_m) and cutoff_m > 0.0) or not order >= 1.0:
        raise ValueError(f"cutoff_m = {cutoff_m}, order = {order}: must be positive, and at least 1")
    mapping = MAPPING[episode.truths[0][0].ndim]
    place = _soup("measures").Euclidean(mapping)
    speed = _soup("measures").Euclidean(tuple(i + 1 for i in mapping))
    ospa, siap = _soup("metricgenerator.ospametric"), _soup("metricgenerator.tracktotruthmetrics")
    manager = _soup("metricgenerator.manager").MultiManager(
        [
            ospa.GOSPAMetric(c=cutoff_m, p=order, measure=place, generator_name=GENERATORS[0]),
            ospa.OSPAMetric(c=cutoff_m, p=order, measure=place, generator_name=GENERATORS[1]),
            siap.SIAPMetrics(position_measure=place, velocity_measure=speed, generator_name=GENERATORS[2]),
        ],
        associator=_soup("dataassociator.tracktotrack").TrackToTruth(association_threshold=cutoff_m, measure=place),
    )
    manager.add_data({"tracks": set(episode.tracks), "groundtruth_paths": set(episode.truths)})
    return manager.generate_metrics()


def retrack(episode: Episode, motion: Any, begin: int = 0, gate: float = 5.0) -> Episode:
    """The episode with tracks that Stone Soup makes of its detections, by extended Kalman filters, nearest neighbours.

    Args:
        episode: its tracks give the beginning; the detections after that are filtered station by station.
        motion: a transition model of Stone Soup, such as `constant_velocity` gives.
        begin: instant up to which the tracks are taken over.
        gate: Mahalanobis distance beyond which a detection is not the track's.
    Returns:
        an episode whose tracks have a state of every instant, updates and predictions of Stone Soup's types.
    Raises:
        ImportError: Stone Soup is not installed; ValueError: no such instant.
    """
    if not 0 <= begin < len(episode.detections):
        raise ValueError(f"begin = {begin}: must be an instant, 0 to {len(episode.detections) - 1}")
    predictor = _soup("predictor.kalman").ExtendedKalmanPredictor(motion)
    updater = _soup("updater.kalman").ExtendedKalmanUpdater(measurement_model=None)
    distance = _soup("hypothesiser.distance").DistanceHypothesiser(
        predictor, updater, measure=_soup("measures").Mahalanobis(), missed_distance=gate
    )
    associator = _soup("dataassociator.neighbour").GNNWith2DAssignment(distance)
    tracks = [_soup("types.track").Track(list(track[: begin + 1])) for track in episode.tracks]
    times = [state.timestamp for state in episode.truths[0]]
    for time, detections in zip(times[begin + 1 :], episode.detections[begin + 1 :], strict=True):
        stations = {detection.metadata["station"] for detection in detections}
        for station in sorted(stations) or [None]:
            seen = {detection for detection in detections if detection.metadata["station"] == station}
            for track, hypothesis in associator.associate(set(tracks), seen, time).items():
                track.append(updater.update(hypothesis) if hypothesis else hypothesis.prediction)
    return episode._replace(tracks=tracks)


def constant_velocity(dimensions: int, noise_density: float) -> Any:
    """Stone Soup's model of nearly constant velocity.

    Args:
        dimensions: 2 or 3.
        noise_density: of the white acceleration on every axis [m²/s³].
    """
    linear = _soup("models.transition.linear")
    return linear.CombinedLinearGaussianTransitionModel([linear.ConstantVelocity(noise_density)] * dimensions)


def _soup(module: str) -> Any:
    return needs(f"stonesoup.{module}", EXTRA)


# -- there -------------------------------------------------------------------------------------------------------------


def _episode(recording: EpisodeArrays, e: int, times: list[datetime]) -> Episode:
    returns = Returns(*(part[e] for part in recording.returns))
    stations, receivers = _stations(recording, e)
    models = _models(stations, returns.std, receivers)
    truths = [_path(times, states) for states in np.swapaxes(recording.truth[e], 0, 1)]
    slots = returns.valid.shape[-1]
    platforms = [
        _path(times, states, [{MODEL: row[s], "slots": slots} for row in models])
        for s, states in enumerate(np.swapaxes(stations, 0, 1))
    ] + [_path(times, states) for states in np.swapaxes(receivers, 0, 1)]
    detections = [_detections(returns, k, time, models[k], truths) for k, time in enumerate(times)]
    targets = range(recording.mean.shape[2])
    tracks = [_track(times, recording.mean[e, :, j], recording.cov[e, :, j]) for j in targets]
    return Episode(truths, platforms, detections, tracks)


def _order(size: int) -> np.ndarray:
    """Where Stone Soup's state numbers stand in ours: x, vx, y, vy of x, y, vx, vy."""
    return np.arange(size).reshape(2, -1).T.ravel()


def _path(times: list[datetime], states: np.ndarray, metadata: Sequence[Any] | None = None) -> Any:
    """A path of states [k + 1, d]."""
    soup = _soup("types.groundtruth")
    known = metadata or [{} for _ in times]
    ordered = states[:, _order(states.shape[1])]
    return soup.GroundTruthPath(
        [
            soup.GroundTruthState(state, timestamp=time, metadata=told)
            for state, time, told in zip(ordered, times, known, strict=True)
        ]
    )


def _track(times: list[datetime], mean: np.ndarray, cov: np.ndarray) -> Any:
    """A track of means [k + 1, d] and covariances [k + 1, d, d]."""
    order, state = _order(mean.shape[1]), _soup("types.state").GaussianState
    ordered = zip(mean[:, order], cov[:, order][:, :, order], times, strict=True)
    return _soup("types.track").Track([state(x, P, timestamp=time) for x, P, time in ordered])


def _stations(recording: EpisodeArrays, e: int) -> tuple[np.ndarray, np.ndarray]:
    """States [k + 1, s, d] of what has a measurement model, and [k + 1, 1 or 0, d] of a passive radar's receiver."""
    platforms, sites = recording.platforms[e], recording.transmitters[e]
    if not len(sites):
        return platforms, platforms[:, :0]
    standing = np.concatenate([sites, np.zeros_like(sites)], axis=1)
    return np.broadcast_to(standing, (len(platforms), *standing.shape)), platforms


def _models(stations: np.ndarray, std: np.ndarray, receivers: np.ndarray) -> list[list[Any]]:
    """Measurement models of every instant and station, of states [k + 1, s, d] and std [k + 1, s, c]."""
    size, components, soup = stations.shape[-1], std.shape[-1], _soup("models.measurement.nonlinear")
    angles = soup.Cartesian2DToBearing if components == 1 else soup.CartesianToElevationBearing
    variance, places = std[..., ::-1] ** 2, stations[..., : size // 2, None]  # elevation stands before azimuth

    def model(k: int, s: int) -> Any:
        known = {"ndim_state": size, "mapping": MAPPING[size], "noise_covar": np.diag(variance[k, s])}
        if not receivers.size:
            return angles(**known, translation_offset=places[k, s])
        return range_sum_model()(**known, transmitter=places[k, s], receiver=receivers[k, 0, : size // 2, None])

    return [[model(k, s) for s in range(stations.shape[1])] for k in range(len(stations))]


@cache
def range_sum_model() -> Any:
    """The class of Stone Soup's measurement model of a bistatic range sum |p − R| + |p − T|, which it lacks itself.

    Its properties are those of `NonLinearGaussianMeasurement`, and ``transmitter`` and ``receiver`` [d, 1] m.
    """
    soup, base, array = _soup("models.measurement.nonlinear"), _soup("base"), _soup("types.array")

    class RangeSum(soup.NonLinearGaussianMeasurement):
        """Range sum from a transmitter by the target to a receiver."""

        transmitter: Any = base.Property(doc="Position of the transmitter, a column [m].")
        receiver: Any = base.Property(doc="Position of the receiver, a column [m].")

        @property
        def ndim_meas(self) -> int:
            """A range sum is one number."""
            return 1

        def function(self, state: Any, noise: Any = False, **_: Any) -> Any:
            """Range sums [1, n] m of states [d, n]; noise: False, True or added as it is."""
            places = np.asarray(state.state_vector, dtype=float)[list(self.mapping)]
            sums = sum(np.linalg.norm(places - np.asarray(end), axis=0) for end in (self.transmitter, self.receiver))
            added = self.rvs(num_samples=places.shape[1]) if noise is True else 0 if noise is False else noise
            return array.StateVectors([sums]) + added

    return RangeSum


def _detections(returns: Returns, k: int, time: datetime, models: list[Any], truths: list[Any]) -> set[Any]:
    """The detections of an instant."""
    soup, found = _soup("types.detection"), set()
    for s, b in np.argwhere(returns.valid[k]).tolist():
        known: dict[str, Any] = {
            "state_vector": _vector(returns.values[k, s, b], models[s]), "timestamp": time,
            "measurement_model": models[s],
            "metadata": {"station": s, "slot": b},
        }  # fmt: skip
        target = int(returns.origin[k, s, b])
        found.add(soup.Clutter(**known) if target < 0 else soup.TrueDetection(**known, groundtruth_path=truths[target]))
    return found


def _vector(values: np.ndarray, model: Any) -> Any:
    """What was measured [c] as Stone Soup's state vector: bearing; elevation and bearing; or range sum."""
    soup, vector = _soup("types.angle"), _soup("types.array").StateVector
    if isinstance(model, range_sum_model()):
        return vector([values[0]])
    kinds = (soup.Bearing,) if len(values) == 1 else (soup.Elevation, soup.Bearing)
    return vector([[_exactly(kind, value)] for kind, value in zip(kinds, values[::-1], strict=True)])


def _exactly(kind: Any, value: float) -> Any:
    """An angle that is in its range already: wrapping it once more would round it."""
    angle = kind(value)
    angle._value = float(value)
    return angle


# -- and back ----------------------------------------------------------------------------------------------------------


def _arrays(episode: Episode, where: str, times: list[datetime]) -> list[np.ndarray]:
    """Platforms, truth, means, covariances, transmitters, then the parts of `Returns`, of one episode."""
    kinds = {"platform": episode.platforms, "truth": episode.truths, "track": episode.tracks}
    states = {
        kind: [_states(path, f"{where}: {kind} {i}", times) for i, path in enumerate(paths)]
        for kind, paths in kinds.items()
    }
    platforms, truth, mean = (_vectors(states[kind]) for kind in kinds)
    back = np.argsort(_order(mean.shape[-1]))
    cov = np.array([[np.asarray(state.covar, dtype=float) for state in path] for path in states["track"]])
    cov = np.swapaxes(cov, 0, 1)[..., back, :][..., back]
    stations = [path for path in states["platform"] if MODEL in path[0].metadata]
    receiver, half = len(stations) < len(states["platform"]), platforms.shape[-1] // 2
    transmitters = platforms[0, : len(stations), :half] if receiver else np.empty((0, 0))
    platforms = platforms[:, len(stations) :] if receiver else platforms
    return [platforms, truth, mean, cov, transmitters, *_gathered(episode, where, times, stations)]


def _check_paths(episode: Episode, where: str) -> None:
    """Refuse an episode without truths or platforms, or without a track for each truth."""
    for kind, paths in (("truths", episode.truths), ("platforms", episode.platforms)):
        if not paths:
            raise ValueError(f"{where} has no {kind}: must have at least one")
    if len(episode.tracks) != len(episode.truths):
        raise ValueError(
            f"{where} has tracks of {len(episode.tracks)} targets, truths of {len(episode.truths)}: must have one "
            "track for each truth, in their order"
        )


def _states(path: Any, where: str, times: list[datetime]) -> list[Any]:
    """The last state of every instant."""
    found = {state.timestamp: state for state in path}
    missing = [time for time in times if time not in found]
    if missing or len(found) > len(times):
        what = f"no state of {missing[0]}" if missing else f"states of {len(found)} instants"
        raise ValueError(f"{where} has {what}: must have one of each of the {len(times)} instants of truth 0")
    return [found[time] for time in times]


def _vectors(paths: list[list[Any]]) -> np.ndarray:
    """State vectors [k + 1, paths, d] in our order."""
    vectors = np.array([[np.asarray(state.state_vector, dtype=float)[:, 0] for state in path] for path in paths])
    return np.swapaxes(vectors, 0, 1)[..., np.argsort(_order(vectors.shape[-1]))]


def _gathered(episode: Episode, where: str, times: list[datetime], stations: list[list[Any]]) -> Returns:
    """Returns of an episode; of detections whose target is not known the origin is −1."""
    if len(episode.detections) != len(times):
        raise ValueError(f"{where} has detections of {len(episode.detections)} instants, must be {len(times)}")
    told = [[state.metadata for state in path] for path in stations]
    variance = np.array([[np.diagonal(each[MODEL].noise_covar) for each in row] for row in told])
    std = np.sqrt(np.swapaxes(variance, 0, 1)[..., ::-1].astype(float))
    shape = (*std.shape[:2], told[0][0]["slots"])
    values, valid, origin = np.zeros((*shape, std.shape[-1])), np.zeros(shape, dtype=bool), np.full(shape, -1)
    targets = {id(path): j for j, path in enumerate(episode.truths)}
    for k, detections in enumerate(episode.detections):
        for detection in detections:
            at = (k, *_slot(detection, f"{where}, instant {k}", shape[1:], valid[k], times[k]))
            values[at] = np.asarray(detection.state_vector, dtype=float)[::-1, 0]
            valid[at] = True
            origin[at] = targets.get(id(getattr(detection, "groundtruth_path", None)), -1)
    return Returns(values, valid, origin, std)


def _slot(detection: Any, where: str, shape: tuple[int, ...], taken: np.ndarray, time: datetime) -> tuple[int, int]:
    """Station and slot of a detection.

    Raises:
        ValueError: it does not say, or they do not exist or are taken, or it is of another time.
    """
    at = (detection.metadata.get("station"), detection.metadata.get("slot"))
    if not all(isinstance(i, int) and 0 <= i < n for i, n in zip(at, shape, strict=True)):
        raise ValueError(
            f"{where}: a detection's metadata have station = {at[0]!r} and slot = {at[1]!r}, must be whole numbers "
            f"below {shape[0]} and {shape[1]}"
        )
    if detection.timestamp != time or taken[at]:
        wrong = f"is of {detection.timestamp}, not {time}" if detection.timestamp != time else "is the second one"
        raise ValueError(f"{where}: the detection of station {at[0]}, slot {at[1]} {wrong}")
    return at  # type: ignore[return-value]
