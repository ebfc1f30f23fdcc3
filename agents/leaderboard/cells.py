"""Cells of the leaderboard, one policy in one scenario, and how they are kept on disk.

A finished cell is a file of its own, written whole or not at all. It says what it was flown with; it is used again only
where all of that is the same. Files of other settings have other names and stay as they are.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from agents.evaluation import Engine, Flight, here
from agents.files import atomic_write
from agents.leaderboard.contestants import KINDS, Contestant
from agents.outcomes import Outcomes
from agents.provenance import versions

FORMAT = 1
"""Of the files; another number makes older ones unusable."""

FOLDER = "cells"
SHARES = ("lost", "collapsed", "nees", "standoff", "nogo")
"""Arrays that every outcome has."""

ROOT = Path(__file__).parents[2]
SHOWING = (
    "animation", "artists", "bound_gradient", "cli", "comparison", "curves", "earth_frame", "episode_arrays", "export",
    "layers", "main_job", "maneuvers", "mixture", "model_card", "pack", "page", "palette", "parallel",
    "parameter_sharing", "pettingzoo_env", "pictures", "placement_pictures", "provenance", "recording",
    "recording_file", "registration", "replay", "replay_job", "replay_record", "report", "resampling", "run_report",
    "stone_soup", "svg", "team_vector_env", "torch_bound", "torch_carriers", "track", "track_files", "track_pictures",
    "track_sample", "training", "tuning",
)  # fmt: skip
"""Modules that compare, draw, write, train and talk to others: no episode of an evaluation depends on them."""

SHOWING_FAMILIES = ("playback", "render")
"""Nor does any on modules whose names begin so: they show what scenarios do, and track what was recorded."""


@dataclass(frozen=True)
class Cell:
    """A policy in a scenario.

    Attributes:
        environment: id.
        scenario: resolved, the course and all other fields included.
        contestant: who flies.
        episodes: number of them; seed: of the first.
    """

    environment: str
    scenario: Any
    contestant: Contestant
    episodes: int
    seed: int

    @cached_property
    def key(self) -> dict[str, Any]:
        """All that decides its outcome."""
        return {
            "format": FORMAT,
            "environment": self.environment,
            "scenario": self.scenario.to_dict(),
            "policy": self.contestant.name,
            "model": self.contestant.identity,
            "episodes": self.episodes,
            "seed": self.seed,
            "versions": versions(),
            "code": code_digest(),
        }

    @cached_property
    def digest(self) -> str:
        """Fingerprint of the key."""
        return hashlib.sha256(json.dumps(self.key, sort_keys=True).encode()).hexdigest()[:16]

    @property
    def title(self) -> str:
        """For people."""
        return f"{self.environment.split('/')[-1]} {self.contestant.name}"

    @property
    def flight(self) -> Flight:
        """What has to be flown for it."""
        return Flight(self.title, self.scenario, lambda: self.contestant.make(self.scenario), self.episodes, self.seed)

    def file(self, out: Path) -> Path:
        """Where it is kept."""
        return out / FOLDER / self.environment.split("/")[-1] / f"{self.contestant.name}-{self.digest}.npz"


@cache
def code_digest() -> str:
    """Fingerprint of all sources and recorded flights that decide what happens in an episode."""
    sources = [
        *(ROOT / "trackers").rglob("*.py"),
        *(ROOT / "passive_env").rglob("*.py"),
        *(ROOT / "passive_env" / "data").iterdir(),
        *(ROOT / "agents").glob("*.py"),
    ]
    decisive = [p for p in sources if p.is_file() and p.stem not in SHOWING and not p.stem.startswith(SHOWING_FAMILIES)]
    digest = hashlib.sha256()
    for path in sorted(set(decisive)):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(ROOT).as_posix()} {len(content)}\n".encode() + content)
    return digest.hexdigest()[:16]


class DamagedCell(ValueError):
    """A file that is none of a finished cell."""


def save(cell: Cell, flown: Outcomes, out: Path) -> Path:
    """Keep a finished cell."""
    about = {
        "key": cell.key, "score": flown.score, "state_size": flown.state_size,
        "decision_time_us": flown.decision_time_us, "errors": list(flown.errors), "bounds": list(flown.bounds),
    }  # fmt: skip
    late = {} if flown.lost_late is None else {"lost_late": flown.lost_late}
    shares = {name: getattr(flown, name) for name in SHARES}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, about=np.array(json.dumps(about)), **flown.errors, **flown.bounds, **shares, **late)
    return atomic_write(cell.file(out), buffer.getvalue())


def load(cell: Cell, out: Path) -> Outcomes:
    """A kept cell.

    Raises:
        FileNotFoundError: there is none; DamagedCell: its file cannot be used, and why.
    """
    file = cell.file(out)
    if not file.is_file():
        raise FileNotFoundError(file)
    try:
        about, arrays = _contents(file)
        if about["key"] != json.loads(json.dumps(cell.key)):
            raise DamagedCell("its key is not the one its name stands for")
        flown = Outcomes(
            score=about["score"],
            errors={name: arrays[name] for name in about["errors"]},
            bounds={name: arrays[name] for name in about["bounds"]},
            **{name: arrays[name] for name in SHARES},
            state_size=about["state_size"],
            decision_time_us=about["decision_time_us"],
            lost_late=arrays.get("lost_late"),
        )
        _check(flown, cell.episodes)
    except Exception as error:  # whatever NumPy, zipfile, zlib and json raise on foreign bytes
        raise DamagedCell(f"{file}: {type(error).__name__}, {error}") from error
    return flown


def _contents(file: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """What a file says of itself, and its arrays; nothing in it is run."""
    with np.load(file, allow_pickle=False) as opened:
        arrays = {name: opened[name] for name in opened.files}
    return json.loads(str(arrays.pop("about")[()])), arrays


def _check(flown: Outcomes, episodes: int) -> None:
    """Refuse arrays of other lengths and values that are no numbers.

    Raises:
        DamagedCell: naming what is wrong.
    """
    common = flown.bounds | {name: getattr(flown, name) for name in SHARES}
    for name, values in (flown.errors | common).items():
        if len(values) != episodes:
            raise DamagedCell(f"{name} has {len(values)} episodes, not {episodes}")
    for name, values in (flown.samples | common).items():
        if not np.isfinite(values).all():
            raise DamagedCell(f"{name} has values that are no numbers")


class Flown(NamedTuple):
    """What became of cells.

    Attributes:
        outcomes: by the cells' digests.
        states: how many cells were "kept", "new", "changed" (there is one of other settings, which stays as it is) or
            "damaged".
        differing: what the settings of those that changed differ in.
    """

    outcomes: dict[str, Outcomes]
    states: Counter[str]
    differing: set[str]

    def by_policy(self, cells: Sequence[Cell]) -> dict[str, Outcomes]:
        """Outcomes of one table's cells by the names of policies."""
        return {cell.contestant.name: self.outcomes[cell.digest] for cell in cells}

    def joined(self, further: Flown) -> Flown:
        """What became of both; further cells are of other episodes on purpose, which changes none."""
        states, differing = Counter(further.states), further.differing - {"episodes", "seed"}
        if not differing:
            states["new"] += states.pop("changed", 0)
        return Flown(self.outcomes | further.outcomes, self.states + states, self.differing | differing)

    def __str__(self) -> str:
        others = f"flown anew, {', '.join(sorted(self.differing))} being others than in those kept so far"
        words = {"kept": "kept", "new": "flown", "changed": others, "damaged": "flown anew, their files being damaged"}
        return ", ".join(f"{self.states[state]} {text}" for state, text in words.items() if self.states[state])


def fly_cells(cells: Sequence[Cell], out: Path, progress: bool = True, engine: Engine = here) -> Flown:
    """Outcomes of cells: of kept ones from their files, of the others flown now, the quick ones first."""
    flown, missing = Flown({}, Counter(), set()), []
    for cell in {cell.digest: cell for cell in cells}.values():
        state = _look_up(cell, out, flown)
        flown.states[state] += 1
        if state != "kept":
            missing.append(cell)
    missing.sort(key=lambda cell: (KINDS.index(cell.contestant.kind), cell.scenario.steps))
    with tqdm(total=sum(cell.episodes for cell in missing), unit="episode", disable=not progress) as bar:
        named = {cell.digest: cell for cell in missing}
        for digest, record in engine({digest: cell.flight for digest, cell in named.items()}, bar):
            flown.outcomes[digest] = record.outcomes
            save(named[digest], record.outcomes, out)
    return flown


def _look_up(cell: Cell, out: Path, flown: Flown) -> str:
    """A cell's state; its outcome is added if it was kept."""
    try:
        flown.outcomes[cell.digest] = load(cell, out)
        return "kept"
    except FileNotFoundError:
        differing = differences(cell, out)
        flown.differing.update(differing)
        return "changed" if differing else "new"
    except DamagedCell as error:
        warnings.warn(f"damaged cell, flown again: {error}", stacklevel=3)
        return "damaged"


def differences(cell: Cell, out: Path) -> set[str]:
    """In what kept cells of the same scenario and policy differ from this one; empty if there are none."""
    now, differing = json.loads(json.dumps(cell.key)), set()
    for file in cell.file(out).parent.glob(f"{cell.contestant.name}-{'[0-9a-f]' * 16}.npz"):
        with contextlib.suppress(Exception):  # a damaged one tells nothing
            key = _contents(file)[0]["key"]
            if key["scenario"] == now["scenario"]:
                differing |= {name for name in now if key.get(name) != now[name]}
    return differing
