"""Trackers of a maneuvering target: one step of ours per track, and of filterpy's IMM on the same fixes."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from agents.benchmark.results import Result, Section
from agents.benchmark.timing import Effort, Task, take_turns
from trackers import BearingScan, FixTracker, Imm3, ImmMie
from trackers.compiled import Blocks
from trackers.measurement import bearing
from trackers.motion import process_noise, transition
from trackers.position_fix import fix_bearings

TRACKS = 1024
STEP_S = 1.0
BEARING_STD = 1e-3
WARM_SCANS = 12
"""Scans before the timed one: windows are full, and half of the targets are turning."""

CHAIN = np.array([[0.8, 0.2], [0.2, 0.8]])
NOISE_M_S2 = (1.0, 10.0)
"""Of filterpy's two constant-velocity models."""


class Chase(NamedTuple):
    """Scans [k] of b targets 20 km from two stations 10 km apart."""

    scans: list[BearingScan]


def make_chase(tracks: int = TRACKS, seed: int = 0) -> Chase:
    """Targets on straight courses; every other one accelerates by 30 m/s² after half of the scans."""
    rng = np.random.default_rng(seed)
    stations = np.broadcast_to([[-5e3, -20e3], [5e3, -20e3]], (tracks, 2, 2)).copy()
    std, seen = np.full((tracks, 2), BEARING_STD), np.ones((tracks, 2), dtype=bool)
    start, velocity = rng.normal(0.0, 3e3, (tracks, 2)), rng.normal(0.0, 150.0, (tracks, 2))
    push = np.where(np.arange(tracks)[:, None] % 2 == 0, 30.0, 0.0) * np.array([0.6, 0.8])
    scans = []
    for k in range(WARM_SCANS + 1):
        late = STEP_S * max(k - WARM_SCANS // 2, 0)
        target = start + STEP_S * k * velocity + 0.5 * late**2 * push
        z = bearing(target[:, None], stations) + BEARING_STD * rng.standard_normal((tracks, 2))
        scans.append(BearingScan(z, seen, stations, std))
    return Chase(scans)


def followed(tracker: FixTracker, chase: Chase) -> Any:
    """The tracker's state before the last scan."""
    state = tracker.initiate(chase.scans[0])
    for scan in chase.scans[1:-1]:
        state = tracker.update(tracker.predict(state, STEP_S), scan).posterior
    return state


def _ours(tracker: FixTracker, chase: Chase, batches: int) -> Task:
    """One thread, block by block, as in an environment's step: fix, mixing, prediction, update."""
    state, scan = followed(tracker, chase), chase.scans[-1]
    blocks = Blocks(len(scan.bearings), threads=1)

    def step(rows: slice) -> None:
        own = type(state)(*(part[rows] for part in state))
        tracker.update(tracker.predict(own, STEP_S), BearingScan(*(part[rows] for part in scan)))

    def run() -> None:
        for _ in range(batches):
            blocks.map(step, blocks.slices)

    return lambda: run


def filterpy_imm_steps(chase: Chase, count: int) -> Callable[[], list[np.ndarray]]:
    """Prepare one IMM step of filterpy for the first targets: two constant-velocity filters, fixes made beforehand.

    Returns:
        predict and update of all; they give the posterior means, each [4].
    Raises:
        ImportError: filterpy is not installed.
    """
    kalman = import_module("filterpy.kalman")
    first, last = (fix_bearings(*chase.scans[k]) for k in (0, -1))
    F, H = transition(STEP_S), np.eye(2, 4)
    banks = []
    for b in range(count):
        filters = []
        for noise in NOISE_M_S2:
            one = kalman.KalmanFilter(dim_x=4, dim_z=2)
            one.x, one.F, one.H, one.R = np.append(last.position[b], (0.0, 0.0)), F, H, last.cov[b]
            one.P = np.zeros((4, 4))
            one.P[:2, :2], one.P[2:, 2:] = first.cov[b], 200.0**2 * np.eye(2)
            one.Q = process_noise(STEP_S, noise * STEP_S)
            filters.append(one)
        banks.append((kalman.IMMEstimator(filters, np.full(2, 0.5), CHAIN), last.position[b]))

    def run() -> list[np.ndarray]:
        for bank, z in banks:
            bank.predict()
            bank.update(z)
        return [np.ravel(bank.x) for bank, _ in banks]

    return run


def measure_maneuvers(effort: Effort) -> Section:
    """Time of a step of IMM-MIE and of IMM3 per track, and filterpy's IMM over ours, in turns."""
    chase = make_chase()
    tasks = {
        "imm_mie_step": _ours(ImmMie(), chase, effort.batches),
        "imm3_step": _ours(Imm3(), chase, effort.batches),
    }
    count, notes = effort.single_updates, []
    try:
        filterpy_imm_steps(chase, 1)
        tasks["filterpy_imm_step"] = lambda: filterpy_imm_steps(chase, count)
    except ImportError:
        notes = ["filterpy is not installed, so its IMM is not compared: `pip install passive-env[bench]`."]
    times = take_turns(tasks, effort.rounds)
    theirs = times.pop("filterpy_imm_step", None)
    each = {name: taken / (effort.batches * TRACKS) for name, taken in times.items()}
    results = [Result(name, 1e6 * float(np.median(taken)), "µs") for name, taken in each.items()]
    if theirs is not None:
        ratio = float(np.median(theirs / count / each["imm_mie_step"]))
        results.append(Result("filterpy_imm_step", 1e6 * float(np.median(theirs)) / count, "µs"))
        results.append(Result("filterpy_imm_step_over_ours", ratio, "×", ">= 50"))
    return Section(results, notes)
