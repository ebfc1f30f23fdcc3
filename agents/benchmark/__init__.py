"""``passive-env benchmark``: filter updates, environments and training, beside other libraries where installed.

Goals are stated beside every figure; a missed one is reported, never raised. `benchmarks/README.md` says how each
figure is measured.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from tqdm import tqdm

from agents.benchmark.clutter import measure_clutter
from agents.benchmark.environments import (
    measure_agents,
    measure_carriers,
    measure_decisions,
    measure_memory,
    measure_one_platform,
    measure_passive_radar,
    measure_placements,
    measure_resets,
    measure_single,
    measure_stations,
    measure_two_aircraft,
    measure_vector,
)
from agents.benchmark.filters import measure_monte_carlo, measure_rivals, measure_updates
from agents.benchmark.learning import measure_ppo
from agents.benchmark.maneuvers import measure_maneuvers
from agents.benchmark.results import Result, Section, as_json, as_markdown, machine, write_benchmark
from agents.benchmark.timing import FULL, QUICK, Effort
from agents.files import make_folder

MEASUREMENTS: Mapping[str, Callable[[Effort], Section]] = {
    "bearing updates": measure_updates,
    "other libraries": measure_rivals,
    "Table 1 Monte Carlo": measure_monte_carlo,
    "false returns": measure_clutter,
    "maneuvering target": measure_maneuvers,
    "vector environment": measure_vector,
    "one platform": measure_one_platform,
    "two aircraft": measure_two_aircraft,
    "stations": measure_stations,
    "placements": measure_placements,
    "carriers": measure_carriers,
    "passive radar": measure_passive_radar,
    "decisions": measure_decisions,
    "resets": measure_resets,
    "single environment": measure_single,
    "several agents": measure_agents,
    "memory": measure_memory,
    "PPO": measure_ppo,
}
"""What is measured, in this order; training comes last because torch's threads stay awake for a while."""


def run_benchmark(
    out: Path | None = None,
    quick: bool = False,
    measurements: Mapping[str, Callable[[Effort], Section]] = MEASUREMENTS,
) -> dict[str, Any]:
    """Measure, print the table, and write ``benchmark.json`` and ``benchmark.md``.

    Args:
        out: folder for the files; None writes none.
        quick: shorter measurements, for a check that everything runs.
        measurements: functions to call, by the title the progress bar shows.
    Returns:
        what ``benchmark.json`` holds: {"results": {name: {"value", "unit", "goal"}}, "machine": {…}}.
    Raises:
        FileExistsError: `out` is a file.
    """
    if out is not None:
        make_folder(out)
    results: list[Result] = []
    notes: list[str] = []
    with tqdm(measurements.items(), unit="measurement", leave=False) as bar:
        for title, measure in bar:
            bar.set_description(title)
            section = measure(QUICK if quick else FULL)
            results += section.results
            notes += section.notes
    about = machine(quick)
    text = as_markdown(results, about, notes)
    print(text)
    if out is not None:
        for path in write_benchmark(out, results, about, text):
            print(path)
    return as_json(results, about)
