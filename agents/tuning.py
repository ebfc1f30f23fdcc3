"""Tunes the simple rules on seeds that no evaluation uses, so that learned policies meet the best of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from agents.evaluation import fly
from agents.rules import Zigzag

TUNING_SEED = 500_000
"""First seed of tuning episodes."""


class ZigzagScore(NamedTuple):
    """Mean range errors [m] of one zigzag: at the end, and averaged over time."""

    leg_s: float
    angle_deg: float
    final_m: float
    average_m: float


class ZigzagTable(NamedTuple):
    """All scores of a grid, and the best ones for the final and the time-averaged error."""

    scores: list[ZigzagScore]
    best_final: ZigzagScore
    best_average: ZigzagScore


def tune_zigzag(
    scenario: Any, legs_s: Sequence[float], angles_deg: Sequence[float], episodes: int = 1000,
    seed: int = TUNING_SEED, progress: bool = True,
) -> ZigzagTable:  # fmt: skip
    """Fly every zigzag of a grid on the same tapes.

    Args:
        scenario: what to fly.
        legs_s: leg times [s]; angles_deg: angles off the line of sight.
        episodes: flown per grid point, from `seed` on.
    Raises:
        ValueError: an empty grid, or a leg time or angle that `Zigzag` refuses.
    """
    grid = [(float(leg), float(angle)) for leg in legs_s for angle in angles_deg]
    if not grid:
        raise ValueError("nothing to tune: legs_s and angles_deg must name at least one value each")
    rules = [Zigzag(scenario, leg, angle) for leg, angle in grid]
    scores = []
    for (leg, angle), rule in zip(tqdm(grid, unit="zigzag", disable=not progress, leave=False), rules, strict=True):
        record = fly(scenario, rule, episodes, seed)
        scores.append(ZigzagScore(leg, angle, float(np.mean(record.final)), float(np.mean(record.mean))))
    return ZigzagTable(
        scores, min(scores, key=lambda score: score.final_m), min(scores, key=lambda score: score.average_m)
    )


def as_markdown(table: ZigzagTable) -> str:
    """The grid as a table, the best one of each column in bold."""
    lines = ["| leg [s] | angle [°] | final [m] | time-averaged [m] |", "|---:|---:|---:|---:|"]
    for score in table.scores:
        final, average = f"{score.final_m:.0f}", f"{score.average_m:.0f}"
        final = f"**{final}**" if score is table.best_final else final
        average = f"**{average}**" if score is table.best_average else average
        lines.append(f"| {score.leg_s:g} | {score.angle_deg:g} | {final} | {average} |")
    return "\n".join(lines) + "\n"
