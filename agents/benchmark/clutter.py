"""Scans full of false returns: our pairwise PDAF over the number of returns, and Stone Soup's PDA on the same scans."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from datetime import datetime
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from agents.benchmark.results import Result, Section
from agents.benchmark.timing import Effort, Task, take_turns
from trackers import AngleEkf, AngleFilter, AnglePdaf, AngleScan, Gaussian
from trackers.compiled import Blocks
from trackers.direction import direction, gate

TRACKS = 1024
ANGLE_STD = math.radians(0.5)
GAMMA = 16.0
RETURNS = (1, 5, 9, 17, 33)
"""Returns in each sensor's gate; 9 are the paper's dense clutter."""

COMPARED = 9
DETECTION = 0.9


class Scene(NamedTuple):
    """Predicted tracks [b, 1, 6] that await a scan of two sensors."""

    state: Gaussian
    scan: AngleScan


def make_scene(returns: int, tracks: int = TRACKS, seed: int = 0) -> Scene:
    """Targets some 25 km ahead of two platforms 6 km abreast; one own and otherwise false returns, in the gates."""
    rng = np.random.default_rng(seed)
    mean = np.array([25e3, -3e3, 8e3, -150.0, 0.0, 0.0]) + rng.normal(
        0.0, [2e3, 2e3, 5e2, 30.0, 30.0, 5.0], (tracks, 6)
    )
    spread = np.array([1e3, 250.0, 200.0, 60.0, 40.0, 20.0]) * rng.uniform(0.7, 1.3, (tracks, 6))
    cov = np.eye(6) * np.square(spread)[:, None]
    platforms = np.broadcast_to([[0.0, 0.0, 6e3], [0.0, -6e3, 6e3]], (tracks, 2, 3)).copy()
    std = np.full((tracks, 2, 2), ANGLE_STD)
    search = gate(mean, cov, platforms, std, GAMMA)
    truth = mean + 0.5 * spread * rng.standard_normal((tracks, 6))
    own = direction(truth[:, None], platforms) + 0.5 * ANGLE_STD * rng.standard_normal((tracks, 2, 2))
    radius = np.sqrt(0.98 * GAMMA * rng.random((tracks, 2, returns - 1)))
    turn = rng.uniform(0.0, 2.0 * math.pi, radius.shape)
    disk = radius[..., None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    false = search.angles[..., None, :] + disk @ np.swapaxes(np.linalg.cholesky(search.cov), -1, -2)
    angles = np.concatenate([own[..., None, :], false], axis=-2)
    density = max(returns - 1, 1) / search.area
    scan = AngleScan(angles, np.ones(angles.shape[:-1], bool), platforms, std, np.ones((tracks, 2, 2), bool), density)
    return Scene(Gaussian(mean[:, None], cov[:, None]), scan)


def _ours(tracker: AngleFilter, scene: Scene, batches: int) -> Task:
    """One thread; results are dropped block by block, as in an environment's step."""
    blocks = Blocks(TRACKS, threads=1)

    def update(rows: slice) -> None:
        tracker.update(Gaussian(*(part[rows] for part in scene.state)), AngleScan(*(part[rows] for part in scene.scan)))

    def run() -> None:
        for _ in range(batches):
            blocks.map(update, blocks.slices)

    return lambda: run


class GivenPrediction:
    """Stands in for a predictor: predictions are made beforehand and not timed."""

    def predict(self, prediction: Any, **_: Any) -> Any:
        """What was handed in."""
        return prediction


def stone_soup_scans(scene: Scene, count: int) -> Callable[[], list[np.ndarray]]:
    """Prepare scans for Stone Soup: probabilistic data association of one sensor after the other.

    Predictions and detections are made here, outside the timed part; gating, weights and the mixture's update are
    timed, as ours.

    Returns:
        the updates of the first `count` tracks; they give the posterior means, each [6].
    Raises:
        ImportError: Stone Soup is not installed.
    """
    now = datetime(2004, 8, 1)
    tasks = []
    for b in range(count):
        mean, cov = scene.state.mean[b, 0][:, None], scene.state.cov[b, 0]
        prior = _stone_soup("types.prediction").GaussianStatePrediction(mean, cov, timestamp=now)
        tasks.append((prior, [_sensor(scene, b, s, now) for s in range(2)]))

    def run() -> list[np.ndarray]:
        means = []
        for prior, sensors in tasks:
            state = prior
            for hypothesiser, detections in sensors:
                state = hypothesiser.updater.update(hypothesiser.hypothesise(state, detections, now))
            means.append(np.asarray(state.state_vector, dtype=float)[:, 0])
        return means

    return run


def _sensor(scene: Scene, b: int, s: int, now: datetime) -> tuple[Any, set[Any]]:
    """Hypothesiser and detections of one sensor's scan of one track."""
    model = _stone_soup("models.measurement.nonlinear").CartesianToElevationBearing(
        ndim_state=6,
        mapping=(0, 1, 2),
        noise_covar=np.diag([ANGLE_STD**2, ANGLE_STD**2]),
        translation_offset=scene.scan.platforms[b, s][:, None],
    )
    hypothesiser = _stone_soup("hypothesiser.probability").PDAHypothesiser(
        predictor=GivenPrediction(),
        updater=_stone_soup("updater.probability").PDAUpdater(measurement_model=model),
        clutter_spatial_density=float(scene.scan.clutter_density[b, s]),
        prob_detect=DETECTION,
        prob_gate=1.0 - math.exp(-0.5 * GAMMA),
    )
    angle, vector, detection = (_stone_soup(f"types.{name}") for name in ("angle", "array", "detection"))
    return hypothesiser, {
        detection.Detection(
            vector.StateVector([[angle.Elevation(elevation)], [angle.Bearing(azimuth)]]),
            measurement_model=model,
            timestamp=now,
        )
        for azimuth, elevation in scene.scan.angles[b, s]
    }


def _stone_soup(module: str) -> Any:
    return import_module(f"stonesoup.{module}")


def measure_clutter(effort: Effort) -> Section:
    """Time of a scan by the number of returns, of the EKF without clutter, and Stone Soup's PDA on the same scans."""
    scenes = {n: make_scene(n) for n in RETURNS}
    pdaf = AnglePdaf(gate=GAMMA, detection_probability=DETECTION)
    tasks = {f"pdaf_scan_{n}_returns": _ours(pdaf, scene, effort.batches) for n, scene in scenes.items()}
    tasks["angle_ekf_scan"] = _ours(AngleEkf(), scenes[1], effort.batches)
    count, notes = max(effort.single_updates // 10, 1), []
    try:
        stone_soup_scans(scenes[COMPARED], 1)
        tasks["stone_soup_pda_scan"] = lambda: stone_soup_scans(scenes[COMPARED], count)
    except ImportError:
        notes = ["Stone Soup is not installed, so its PDA is not compared: `pip install passive-env[bench]`."]
    times = take_turns(tasks, effort.rounds)
    theirs = times.pop("stone_soup_pda_scan", None)
    each = {name: taken / (effort.batches * TRACKS) for name, taken in times.items()}
    results = [Result(name, 1e6 * float(np.median(taken)), "µs") for name, taken in each.items()]
    results += _rival(theirs, count, each[f"pdaf_scan_{COMPARED}_returns"])
    return Section(results, notes)


def _rival(theirs: np.ndarray | None, count: int, ours: np.ndarray) -> Sequence[Result]:
    if theirs is None:
        return []
    ratio = float(np.median(theirs / count / ours))
    return [
        Result("stone_soup_pda_scan", 1e6 * float(np.median(theirs)) / count, "µs"),
        Result("stone_soup_pda_scan_over_ours", ratio, "×", ">= 300"),
    ]
