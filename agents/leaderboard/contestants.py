"""Who takes part: the policies of an environment, what kind each is of, and what tells two of one name apart."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agents.evaluation import unique_names
from agents.learned import CONFIG, MODEL, is_policy_file, open_policy
from agents.packed import SUFFIX
from agents.policy import Policy, make_policy, policy_names
from agents.pretrained import PRETRAINED, card, load_pretrained, pretrained_ids
from passive_env.catalogue import environment_id, make_scenario, scenario_name

_NAMES: dict[str, tuple[str, ...]] = {
    "fixed": (
        "paper", "paper_opposed", "paper_co_located", "paper_90", "fixed", "best_fixed", "straight", "random", "even",
        "tripod", "round_robin",
    ),
    "rule": (
        "rule", "rule_tuned", "rule_perpendicular", "rule_average", "rule_60", "rule_bend", "rule_best", "rule_static",
        "perpendicular", "lead_lag", "split", "open", "angle", "triangle", "nearest", "repeat", "hold", "pursuit",
    ),
    "greedy": (
        "greedy", "greedy_1", "greedy_4", "greedy_after_rule", "greedy_after_optimizer", "skip", "bayes", "hysteresis",
        "hold10", "timed", "timed10", "timed_pursuit",
    ),
    "planner": ("planner", "optimizer"),
    "learned": (PRETRAINED,),
    "oracle": ("oracle", "hindsight"),
}  # fmt: skip
KINDS = tuple(_NAMES)
"""Kinds of policies, in the order in which they are flown: what decides quickly comes first. A fixed one looks at
nothing but the time, or only once; a rule is a formula of the belief; a greedy one weighs the next decision, a planner
several or all of them; an oracle knows the truth."""

KIND_OF: dict[str, str] = {name: kind for kind, names in _NAMES.items() for name in names}
"""Kind of every policy that is known by name."""

COSTLY: dict[str, tuple[str, ...]] = {
    "passive/RadarPlacement-v0": ("optimizer",),
    "passive/MobilePlacement-v0": ("optimizer", "greedy_after_optimizer"),
    "passive/PassiveRadar-v0": ("planner",),
    "passive/PassiveRadarRetune-v0": ("planner",),
}
"""Policies left out for their time, a fifth to three quarters of a second per episode, where not policies but trackers,
or circumstances, are compared."""

GEOMETRIES = ("paper", "fixed", "straight")
"""Reference geometries, the first one offered counts."""


def geometry_of(names: Collection[str]) -> str | None:
    """The reference geometry among policies, if there is one."""
    return next((name for name in GEOMETRIES if name in names), None)


@dataclass(frozen=True)
class Contestant:
    """A policy that takes part.

    Attributes:
        name: in tables.
        kind: one of `KINDS`.
        make: (scenario) → policy.
        identity: of the file a learned one was loaded from; empty for those that are code only.
    """

    name: str
    kind: str
    make: Callable[[Any], Policy]
    identity: str = ""


def known_policies(scenario: Any) -> list[Contestant]:
    """All that a scenario offers by name, the quick ones first.

    Raises:
        ValueError: a policy whose kind nobody has said.
    """
    found = [_known(name, scenario) for name in policy_names(scenario)]
    return sorted(found, key=lambda one: KINDS.index(one.kind))


def _known(name: str, scenario: Any) -> Contestant:
    if name not in KIND_OF:
        raise ValueError(f"policy {name!r} has no kind: name it in {__name__}, one of {', '.join(KINDS)}")
    return Contestant(name, KIND_OF[name], lambda chosen: make_policy(name, chosen))


def learned_policies(environment: str, runs: Sequence[str | Path]) -> list[Contestant]:
    """The policy that comes with the package, if one does, and those of runs or packed files: learned, learned_2, …

    Raises:
        FileNotFoundError, ValueError: no run folder or packed file, or a model of another environment.
    """
    names = unique_names(["learned"] * len(runs))
    found = [_pretrained(environment)] if environment in pretrained_ids() else []
    return found + [_learned(name, Path(run), environment) for name, run in zip(names, runs, strict=True)]


def _pretrained(environment: str) -> Contestant:
    identity = _digest(card(environment).with_suffix(SUFFIX))
    return Contestant(PRETRAINED, "learned", lambda scenario: load_pretrained(environment, scenario), identity)


def _learned(name: str, run: Path, environment: str) -> Contestant:
    def make(scenario: Any) -> Policy:
        return open_policy(run, environment, scenario.make_simulation())

    make(make_scenario(environment, {}))  # a bad one must fail before anything is flown
    files = [run] if is_policy_file(run) else [run / CONFIG, run / MODEL]
    return Contestant(name, "learned", make, _digest(*files))


def _digest(*files: Path) -> str:
    """Fingerprint of what a model was loaded from."""
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def run_folders(texts: Sequence[str], environments: Sequence[str]) -> dict[str, list[str]]:
    """Run folders and packed files per environment id, from ``ENV=RUN`` as on a command line.

    Raises:
        ValueError: no equals sign, an unknown environment, or one that takes no part.
    """
    folders: dict[str, list[str]] = {}
    for text in texts:
        name, equals, folder = text.partition("=")
        if not (equals and name and folder):
            raise ValueError(f"--runs {text!r}: must be an environment and its run folder or packed file, ENV=RUN")
        environment = environment_id(scenario_name(name))
        if environment not in environments:
            raise ValueError(f"--runs {text!r}: {environment} takes no part; name it after --envs")
        folders.setdefault(environment, []).append(folder)
    return folders


def chosen(field: Sequence[Contestant], names: Sequence[str]) -> list[Contestant]:
    """Those of these names; all where none is named. What was given as a run always takes part."""
    return [one for one in field if not names or one.name in names or one.name not in KIND_OF]


def check_names(names: Sequence[str], fields: Mapping[str, Sequence[Contestant]]) -> None:
    """Refuse a name that no environment offers.

    Raises:
        ValueError: naming it and what there is.
    """
    offered = sorted({one.name for field in fields.values() for one in field})
    for name in names:
        if name not in offered:
            raise ValueError(f"--policies {name!r}: no environment offers it; known are {', '.join(offered)}")


def affordable(environment: str, field: Sequence[Contestant]) -> list[Contestant]:
    """Everyone but those that search too long."""
    return [one for one in field if one.name not in COSTLY.get(environment, ())]


def opponents(environment: str, field: Sequence[Contestant]) -> list[Contestant]:
    """Of those, everything learned and what it is compared with: fixed policies, rules and greedy ones."""
    return [one for one in affordable(environment, field) if one.kind in ("fixed", "rule", "greedy", "learned")]


def unfit(one: Contestant, scenario: Any) -> str:
    """Why a learned policy cannot fly a scenario; empty if it can."""
    if one.kind != "learned":
        return ""
    try:
        one.make(scenario)
    except ValueError as error:
        return str(error)
    return ""
