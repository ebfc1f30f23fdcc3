"""Filter updates: our bank on one core and on two, Stone Soup's and filterpy's EKF, and the paper's Monte Carlo."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from agents.benchmark.results import Result, Section
from agents.benchmark.timing import Effort, Task, take_turns
from agents.reproduction.two_station.monte_carlo import READINGS, table_1_errors
from trackers import Bank, rp_ekf
from trackers.compiled import Blocks, available_cores, kernel
from trackers.measurement import bearing
from trackers.rp_ekf import BankUpdate
from trackers.triangulation import RangeInterval

BANKS, HYPOTHESES, STATIONS = 2048, 8, 2
UPDATES = BANKS * HYPOTHESES * STATIONS
"""Scalar bearing updates of one full batch."""

BEARING_STD = math.radians(0.5)
KEEP_ALL = 1e-300
"""Pruning threshold that removes nothing: every update is made."""

ALL_SEEN = np.ones(STATIONS, dtype=bool)

TABLE_1_RUNS = 50


class Problem(NamedTuple):
    """Banks that await one bearing from each station: bank [b, n], bearings [b, s] rad, stations [b, s, 2] m."""

    bank: Bank
    bearings: np.ndarray
    stations: np.ndarray


def make_problem(banks: int = BANKS, seed: int = 0) -> Problem:
    """Targets 60–80 km from two stations 14 km apart; every bank spans ranges around its target."""
    rng = np.random.default_rng(seed)
    stations = np.broadcast_to([[14e3, 0.0], [0.0, 0.0]], (banks, STATIONS, 2)).copy()
    angle, distance = rng.uniform(0.5, 2.5, banks), rng.uniform(60e3, 80e3, banks)
    target = np.stack([distance * np.cos(angle), distance * np.sin(angle)], axis=-1)
    truth = bearing(target[:, None], stations)
    first, second = (truth + BEARING_STD * rng.standard_normal(truth.shape) for _ in range(2))
    interval = RangeInterval(np.full(banks, 40e3), np.full(banks, 120e3))
    bank = rp_ekf.initiate(first[:, -1], stations[:, -1], BEARING_STD, interval, HYPOTHESES)
    return Problem(rp_ekf.predict(bank, 2.0, 15.0), second, stations)


# -- ours ------------------------------------------------------------------------------------------------------------


def update_banks(problem: Problem, blocks: Blocks) -> list[BankUpdate]:
    """Every hypothesis of every bank takes both stations' bearings; blocks run on the threads of `blocks`."""
    return blocks.map(lambda rows: _update_rows(problem, rows), blocks.slices)


def _update_rows(problem: Problem, rows: slice) -> BankUpdate:
    bank = Bank(*(part[rows] for part in problem.bank))
    bearings, stations = problem.bearings[rows], problem.stations[rows]
    return rp_ekf.update(bank, bearings, ALL_SEEN, stations, BEARING_STD, KEEP_ALL)


def _ours(problem: Problem, threads: int, batches: int) -> Task:
    """Results are dropped block by block, as in an environment's step: the filter is timed, not fresh memory."""
    blocks = Blocks(len(problem.bearings), threads=threads)

    def update(rows: slice) -> None:
        _update_rows(problem, rows)

    def run() -> None:
        for _ in range(batches):
            blocks.map(update, blocks.slices)

    return lambda: run


@kernel("(k)->(k)")
def _busy(start, out):
    out[:] = start
    for _ in range(200):
        for i in range(out.shape[0]):
            out[i] = 0.5 * (out[i] + 1.0 / out[i])


def _arithmetic(threads: int, batches: int) -> Task:
    """Divisions in the nearest cache: what a second core is worth here and now, whatever the program."""
    start, blocks = np.ones((BANKS // 4, 16)), Blocks(BANKS // 4, block=128, threads=threads)

    def run() -> None:
        for _ in range(batches):
            blocks.map(lambda rows: _busy(start[rows]), blocks.slices)

    return lambda: run


# -- theirs: one position–velocity track, one bearing -----------------------------------------------------------------


def stone_soup_updates(problem: Problem, count: int, joseph: bool = True) -> Callable[[], list[np.ndarray]]:
    """Prepare updates by Stone Soup of the first banks' first hypotheses with the first station's bearing.

    Predictions, detections and hypotheses are made here, outside the timed part; each prediction is new, for Stone
    Soup remembers the predicted measurements of those it has seen.

    Args:
        problem: whose banks to update; count: how many updates, at most the number of banks.
        joseph: the Joseph form with a symmetric covariance, as ours and filterpy's; False takes the defaults.
    Returns:
        the updates, measurement prediction included; they give the posterior means, each [4].
    Raises:
        ImportError: Stone Soup is not installed.
    """
    kind = _stone_soup("updater.kalman").ExtendedKalmanUpdater
    updater, hypotheses = kind(use_joseph_cov=joseph, force_symmetric_covariance=joseph), []
    for b in range(count):
        model = _stone_soup("models.measurement.nonlinear").Cartesian2DToBearing(
            ndim_state=4,
            mapping=(0, 1),
            noise_covar=np.array([[BEARING_STD**2]]),
            translation_offset=problem.stations[b, 0][:, None],
        )
        mean, cov = problem.bank.mean[b, 0][:, None], problem.bank.cov[b, 0]
        prior = _stone_soup("types.prediction").GaussianStatePrediction(mean, cov)
        seen = _stone_soup("types.array").StateVector([[_stone_soup("types.angle").Bearing(problem.bearings[b, 0])]])
        detection = _stone_soup("types.detection").Detection(seen, measurement_model=model)
        hypotheses.append(_stone_soup("types.hypothesis").SingleHypothesis(prior, detection))
    return lambda: [updater.update(h).state_vector[:, 0] for h in hypotheses]


def _stone_soup(module: str) -> Any:
    return import_module(f"stonesoup.{module}")


def filterpy_updates(problem: Problem, count: int) -> Callable[[], list[np.ndarray]]:
    """Prepare the same updates by filterpy; the filters are made here, outside the timed part.

    Returns:
        the updates; they give the posterior means, each [4].
    Raises:
        ImportError: filterpy is not installed.
    """
    make = import_module("filterpy.kalman").ExtendedKalmanFilter
    filters = []
    for b in range(count):
        ekf = make(dim_x=4, dim_z=1)
        ekf.x, ekf.P, ekf.R = problem.bank.mean[b, 0], problem.bank.cov[b, 0], np.array([[BEARING_STD**2]])
        filters.append((ekf, problem.bearings[b, :1], tuple(map(float, problem.stations[b, 0]))))

    def run() -> list[np.ndarray]:
        for ekf, z, station in filters:
            ekf.update(z, _jacobian, _predicted, args=station, hx_args=station, residual=_residual)
        return [ekf.x for ekf, _, _ in filters]

    return run


def _jacobian(x: np.ndarray, sx: float, sy: float) -> np.ndarray:
    dx, dy = x[0] - sx, x[1] - sy
    r2 = dx * dx + dy * dy
    return np.array([[-dy / r2, dx / r2, 0.0, 0.0]])


def _predicted(x: np.ndarray, sx: float, sy: float) -> np.ndarray:
    return np.array([math.atan2(x[1] - sy, x[0] - sx)])


def _residual(z: np.ndarray, h: np.ndarray) -> np.ndarray:
    return np.array([math.remainder(z[0] - h[0], 2.0 * math.pi)])


# -- measurements -----------------------------------------------------------------------------------------------------


def measure_updates(effort: Effort) -> Section:
    """Scalar bearing updates per second on one core and on two."""
    problem = make_problem()
    if available_cores() < 2:
        one = take_turns({"one": _ours(problem, 1, effort.batches)}, effort.rounds)["one"]
        return Section([_rate("bearing_updates_one_core", one, effort, ">= 10")], ["Two cores: this process has one."])
    tasks = {"one": _ours(problem, 1, effort.batches), "two": _ours(problem, 2, effort.batches)}
    tasks |= {"one_idle": _arithmetic(1, effort.batches), "two_idle": _arithmetic(2, effort.batches)}
    times = take_turns(tasks, effort.rounds)
    return Section(
        [
            _rate("bearing_updates_one_core", times["one"], effort, ">= 10"),
            _rate("bearing_updates_two_cores", times["two"], effort, None),
            Result("bearing_updates_two_cores_over_one", float(np.median(times["one"] / times["two"])), "×", ">= 1.7"),
            Result("arithmetic_two_cores_over_one", float(np.median(times["one_idle"] / times["two_idle"])), "×"),
        ]
    )


def _rate(name: str, times: np.ndarray, effort: Effort, goal: str | None) -> Result:
    return Result(name, effort.batches * UPDATES / float(np.median(times)) / 1e6, "million/s", goal)


class Rival(NamedTuple):
    """Another library's update.

    Attributes:
        name: of the result; library: as written.
        prepare: gives what is timed, a number of updates of a problem.
        times_more: updates in a turn over the effort's `single_updates`.
        goal: of the ratio to our time.
    """

    name: str
    library: str
    prepare: Callable[[Problem, int], Callable[[], list[np.ndarray]]]
    times_more: int
    goal: str | None


RIVALS = (
    Rival("stone_soup_update", "Stone Soup", stone_soup_updates, 1, ">= 5000"),
    Rival("stone_soup_default_update", "Stone Soup", partial(stone_soup_updates, joseph=False), 1, None),
    Rival("filterpy_update", "filterpy", filterpy_updates, 10, ">= 200"),
)


def measure_rivals(effort: Effort) -> Section:
    """Time of one EKF update of the other libraries, and its ratio to one of ours in a full batch on one core."""
    problem = make_problem()
    rivals = [rival for rival in RIVALS if _installed(rival)]
    missing = dict.fromkeys(rival.library for rival in RIVALS if rival not in rivals)
    notes = [f"{name} is not installed, so it is not compared: `pip install passive-env[bench]`." for name in missing]
    if not rivals:
        return Section([], notes)
    counts = {rival.name: rival.times_more * effort.single_updates for rival in rivals}
    tasks = {r.name: partial(r.prepare, problem, counts[r.name]) for r in rivals}
    times = take_turns({"ours": _ours(problem, 1, effort.batches), **tasks}, effort.rounds)
    ours, results = times["ours"] / (effort.batches * UPDATES), []
    for rival in rivals:
        theirs = times[rival.name] / counts[rival.name]
        results.append(Result(rival.name, 1e6 * float(np.median(theirs)), "µs"))
        results.append(Result(f"{rival.name}_over_ours", float(np.median(theirs / ours)), "×", rival.goal))
    return Section(results, notes)


def _installed(rival: Rival) -> bool:
    try:
        rival.prepare(make_problem(1), 1)
    except ImportError:
        return False
    return True


def measure_monte_carlo(effort: Effort) -> Section:
    """The paper's Table 1: 50 runs of its filter on its scenario."""
    reading = READINGS["NATURAL"]

    def run() -> Any:
        return table_1_errors(reading.course, reading.tracker, TABLE_1_RUNS, np.random.default_rng(0))

    times = take_turns({"table": lambda: run}, effort.rounds)["table"]
    return Section([Result("table_1_monte_carlo_50_runs", float(np.median(times)), "s", "< 0.2")])
