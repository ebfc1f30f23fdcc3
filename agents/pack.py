"""Packing a training run into one file without code, with a model card and the figures it reached.

The packed policy is compared with the run's model action by action, flown beside the environment's fixed policies,
rules and greedy ones, and once more through the episodes of the record, which a test repeats. File, card and record are
put in place one right after another, when all of that is done.

``python -m agents.pack FILE.npz …`` flies packed policies again: it writes their records and cards anew, and leaves the
files as they are.
"""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from agents.comparison import figures_of, mean_interval, summarize
from agents.evaluation import fly, fly_all
from agents.files import write_json, write_text
from agents.leaderboard.contestants import KIND_OF, known_policies
from agents.learned import (
    MODEL,
    ActorPolicy,
    LearnedPolicy,
    PackedPolicy,
    load_model,
    plain_actor,
    read_config,
    trained_interface,
)
from agents.model_card import card_as_markdown
from agents.networks import describe
from agents.outcomes import Record
from agents.packed import is_packed, read_packed, write_packed
from agents.provenance import commit, versions
from agents.training import training_seconds
from passive_env.catalogue import make_scenario, scenario_name

EPISODES, SEED = 1000, 90_000_000
"""Of the comparison; far from the seeds of trainings and of what settings were chosen by."""

RECORD_EPISODES, DIGITS = 200, 4
"""Episodes of the record, the comparison's first seeds, and the significant digits to which it keeps their errors."""

LEARNED = "learned"
AGAINST = {"rule": ("fixed", "rule"), "greedy": ("greedy",)}
"""Kinds whose strongest policy a card compares the learned one with, error by error, as the leaderboard does."""

SAME_WITHIN, COMPARED_STEPS = 1e-6, 64
"""A packed policy's commands are the model's to this, in every step of so many episodes."""

FIGURES, FIGURES_WITHIN = ("mean", "median", "p95"), 1e-3
"""Figures of every error that tell whose an evaluation is: the run's model reaches the same, to this share of them."""


def pack(
    run: Path, out: Path, evaluation: Path | None = None, episodes: int = EPISODES, seed: int = SEED,
    progress: bool = True,
) -> dict[str, Any]:  # fmt: skip
    """Pack a run: FILE.npz, its model card FILE.md and its record FILE.json; older ones stay if anything fails.

    Args:
        run: folder made by ``passive-env train``.
        out: FILE.npz.
        evaluation: an ``evaluation.json`` of this run as it was trained, with rules beside it; None: fly one now.
        episodes, seed: of that evaluation, and `seed` of the record.
    Returns:
        what is written as FILE.json.
    Raises:
        FileNotFoundError, ValueError: no run, a network that cannot be packed, or an evaluation of something else.
    """
    if not is_packed(out):
        raise ValueError(f"--out {out}: must be the name of a file that ends in .npz")
    if episodes < 1 or seed < 0:
        raise ValueError(f"--episodes {episodes} --seed {seed}: must be at least 1 and not negative")
    config = read_config(run)
    environment, fields = config["environment"], config.get("fields", {})
    scenario = make_scenario(scenario_name(environment), fields)
    learned = LearnedPolicy(run, environment, scenario.make_simulation())
    summary = None
    if evaluation is not None:
        summary = _take_evaluation(evaluation, environment, fields, scenario, learned, progress)
    description = describe_run(run, config)
    with _in_place_of(out) as draft:
        write_packed(draft, *description)
        packed = PackedPolicy(draft, environment, scenario.make_simulation())
        _check_same(out, scenario, packed, learned, seed)
        summary = summary or _compare(environment, scenario, packed, episodes, seed, progress)
        record = _record(draft, scenario, packed, summary, seed)
        _write(draft, record, packed)
    return record


def measure(file: Path, episodes: int = EPISODES, seed: int = SEED, progress: bool = True) -> dict[str, Any]:
    """Fly a packed policy again: its card and its record are written anew, itself stays.

    Args:
        file: FILE.npz, made by `pack`.
        episodes, seed, progress: as of `pack`.
    Returns:
        what is written as FILE.json.
    Raises:
        FileNotFoundError, ValueError: no packed policy, or one of another version of its environment.
    """
    description = read_packed(file).description
    environment = description["environment"]
    scenario = make_scenario(scenario_name(environment), description["fields"])
    packed = PackedPolicy(file, environment, scenario.make_simulation())
    record = _record(file, scenario, packed, _compare(environment, scenario, packed, episodes, seed, progress), seed)
    with _in_place_of(file) as draft:
        _write(draft, record, packed)
    return record


@contextmanager
def _in_place_of(out: Path) -> Iterator[Path]:
    """A file's name in a folder beside it: what is in that folder at the end replaces what is beside `out`.

    If anything fails before, nothing does. Files are moved one by one, within one folder.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=f".{out.stem}.", dir=out.parent) as folder:
        yield Path(folder) / out.name
        for file in sorted(Path(folder).iterdir()):
            os.replace(file, out.parent / file.name)


def _record(file: Path, scenario: Any, packed: PackedPolicy, summary: Mapping[str, Any], seed: int) -> dict[str, Any]:
    """What is written of a packed policy as FILE.json."""
    return {
        "environment": packed.description["environment"],
        "bytes": file.stat().st_size,
        "trained": {key: value for key, value in packed.description.items() if key not in ("scenario", "preset")},
        "recorded": recorded(fly(scenario, packed, RECORD_EPISODES, seed), seed, scenario),
        "comparison": _shortened(summary),
        "versions": versions(),
        "commit": commit(),
    }


def _write(file: Path, record: Mapping[str, Any], packed: PackedPolicy) -> None:
    """A packed policy's record and card beside its file."""
    write_json(file.with_suffix(".json"), record)
    write_text(file.with_suffix(".md"), card_as_markdown(record, packed.description))


def describe_run(run: Path, config: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """A run's description and arrays for `agents.packed.write_packed`.

    Raises:
        ValueError: a network that cannot be packed.
    """
    actor = plain_actor(load_model(run / MODEL, config["algo"]))
    if actor is None:
        raise ValueError(
            f"{run}: a model of {config['algo']} with this network cannot be packed or exported; what can be are "
            "feed-forward networks of ppo, ppo_long, ppo_scratch, sac and bound_gradient"
        )
    network, arrays = describe(actor)
    trained = {"fields": {}, **config, "interface": trained_interface(dict(config))}
    return trained | {"seconds": training_seconds(run), "network": network}, arrays


def recorded(record: Record, seed: int, scenario: Any) -> dict[str, Any]:
    """Figures of flown episodes by which they can be flown again and compared.

    Means with bootstrap 95 % intervals; and of every episode its final error and its time average, by name.
    """
    errors = {
        name: {"mean": float(values.mean()), "ci95": mean_interval(values), "p95": float(np.percentile(values, 95.0))}
        for name, values in record.samples.items()
    }
    each = dict(zip(_errors(record.score), (record.final, record.mean), strict=True))
    return {
        "seed": seed,
        "episodes": len(record.final),
        "score": record.score,
        "errors": errors,
        "lost_share": float(record.lost.mean()),
        "each": {name: [float(f"{value:.{DIGITS}g}") for value in values] for name, values in each.items()},
        "scenario": scenario.to_dict(),
    }


def _check_same(out: Path, scenario: Any, packed: ActorPolicy, learned: ActorPolicy, seed: int) -> None:
    """The packed policy's commands are the model's wherever the model flies."""
    both = Both(packed, learned)
    fly(scenario, both, COMPARED_STEPS, seed)
    if not both.difference <= SAME_WITHIN:
        raise ValueError(f"{out}: its commands differ from the model's by {both.difference:g}, more than {SAME_WITHIN}")


class Both:
    """Flies as one policy and remembers how far another's commands lie from its own.

    Attributes:
        difference: the largest.
        different_share: share of decisions that differ by more than `within`.
    """

    def __init__(self, flown: ActorPolicy, other: ActorPolicy, within: float = SAME_WITHIN):
        self._flown, self._other, self._within, self.difference = flown, other, within, 0.0
        self._different = self._decisions = 0

    def reset(self, belief: Any) -> None:
        """Begin episodes."""
        self._flown.reset(belief)
        self._other.reset(belief)

    def act(self, belief: Any, observation: np.ndarray) -> np.ndarray:
        """Commands [e, a]."""
        commands = self._flown.act(belief, observation)
        distance = np.abs(commands - self._other.act(belief, observation))
        self.difference = max(self.difference, float(distance.max(initial=0.0)))
        self._different += int((~(distance <= self._within)).any(axis=1).sum())  # what is no number differs
        self._decisions += len(commands)
        return commands

    @property
    def different_share(self) -> float:
        """Of the decisions so far."""
        return self._different / max(self._decisions, 1)


def _compare(
    environment: str, scenario: Any, learned: ActorPolicy, episodes: int, seed: int, progress: bool,
    names: Collection[str] = (),
) -> dict[str, Any]:  # fmt: skip
    """Evaluation of a policy beside the strongest of those kinds in `AGAINST`, after these, or all, have been flown."""
    kinds = {kind for each in AGAINST.values() for kind in each}
    known = [one for one in known_policies(scenario) if one.kind in kinds and (not names or one.name in names)]
    policies = {one.name: one.make(scenario) for one in known}
    records = fly_all(scenario, {**policies, LEARNED: learned}, episodes, seed, progress)
    figures = {name: figures_of(record.outcomes) for name, record in records.items()}
    best = _names(_strongest(figures, records[LEARNED].score))
    return summarize(environment, seed, {name: records[name] for name in (*best, LEARNED)}, best)


def _strongest(figures: Mapping[str, Any], score: str) -> dict[str, dict[str, str]]:
    """The policy of least mean per error, at the end and on the time average, and per entry of `AGAINST`.

    Args:
        figures: policies', as of `agents.comparison.figures_of`.
        score: the error that counts.
    """
    groups = {group: [name for name in figures if KIND_OF.get(name) in kinds] for group, kinds in AGAINST.items()}
    return {
        error: {
            group: min(names, key=lambda name: figures[name][error]["mean"]) for group, names in groups.items() if names
        }
        for error in _errors(score)
    }


def _names(strongest: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Every policy among the strongest, once."""
    return list(dict.fromkeys(name for each in strongest.values() for name in each.values()))


def _take_evaluation(
    file: Path, environment: str, fields: Mapping[str, Any], scenario: Any, learned: ActorPolicy, progress: bool
) -> dict[str, Any]:
    """An evaluation's episodes, flown again by the run's model and by those that are the strongest there.

    Raises:
        FileNotFoundError, ValueError: none, or of something else.
    """
    told = _read_evaluation(file, environment, fields)
    strongest = _names(_strongest(told["policies"], told["score"]))
    foreign = sorted({*strongest} - {one.name for one in known_policies(scenario)})
    if foreign:
        raise ValueError(f"--evaluation {file}: has {', '.join(foreign)}, which {environment} does not offer")
    summary = _compare(environment, scenario, learned, told["episodes"], told["seed"], progress, strongest)
    said, found = told["policies"][LEARNED], summary["policies"][LEARNED]
    for error in _errors(told["score"]):
        for figure in FIGURES:
            value, ours = said[error].get(figure), found[error][figure]
            if value is None or not math.isclose(value, ours, rel_tol=FIGURES_WITHIN):
                raise ValueError(
                    f"--evaluation {file}: has {figure} {error} = {value} of {LEARNED!r}, this run's model {ours:g} on "
                    "the same episodes: it is of another run, tracker or version; evaluate again or leave it out"
                )
    return summary


def _read_evaluation(file: Path, environment: str, fields: Mapping[str, Any]) -> dict[str, Any]:
    """The summary in an evaluation's file.

    Raises:
        FileNotFoundError, ValueError: none, or of something else.
    """
    try:
        summary = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"--evaluation {file}: is no valid JSON ({error})") from error
    needed = {"environment", "episodes", "seed", "policies", "score"}
    if not isinstance(summary, dict) or not needed <= summary.keys():
        raise ValueError(f"--evaluation {file}: must be an evaluation.json of train or evaluate, of one tracker")
    if (summary["environment"], summary.get("fields", {}), summary.get("flights")) != (environment, fields, None):
        raise ValueError(
            f"--evaluation {file}: is of {summary['environment']} with fields {summary.get('fields')} and flights "
            f"{summary.get('flights')}, must be of {environment} with {dict(fields)}, as trained, and no flights"
        )
    if LEARNED not in summary["policies"] or not any(
        KIND_OF.get(name) in AGAINST["rule"] for name in summary["policies"]
    ):
        raise ValueError(f"--evaluation {file}: must have the policy {LEARNED!r}, and a rule or a fixed one")
    for name, figures in summary["policies"].items():
        for error in _errors(summary["score"]):
            mean = figures.get(error, {}).get("mean")
            if not isinstance(mean, (int, float)) or not math.isfinite(mean):
                raise ValueError(f"--evaluation {file}: has mean {error} = {mean!r} of {name!r}, must be a number")
    return summary


def _errors(score: str) -> tuple[str, str]:
    """Names of the final error and of its time average."""
    return f"final_{score}_error_m", f"mean_{score}_error_m"


def _shortened(summary: Mapping[str, Any]) -> dict[str, Any]:
    """What is kept of an evaluation: the learned policy, the strongest it is compared with, ratios to these."""
    policies = summary["policies"]
    strongest = _strongest({name: policies[name] for name in summary["ratios"]}, summary["score"])
    best = _names(strongest)
    return {
        "seed": summary["seed"],
        "episodes": summary["episodes"],
        "score": summary["score"],
        "strongest": strongest,
        "policies": {name: policies[name] for name in (*best, LEARNED)},
        "ratios": {name: summary["ratios"][name][LEARNED] for name in best},
    }


if __name__ == "__main__":
    for packed_file in map(Path, sys.argv[1:]):
        measure(packed_file)
