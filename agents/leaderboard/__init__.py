"""The leaderboard: every environment, every policy, on the same tapes; what trackers and other circumstances change."""

from __future__ import annotations

import dataclasses
import datetime
import platform
import shlex
import time
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, NamedTuple

from agents.evaluation import Engine, here
from agents.files import make_folder
from agents.leaderboard.cells import Cell, Flown, code_digest, fly_cells
from agents.leaderboard.contestants import (
    COSTLY,
    KINDS,
    Contestant,
    affordable,
    check_names,
    chosen,
    known_policies,
    learned_policies,
    opponents,
    run_folders,
    unfit,
)
from agents.leaderboard.goals import GOALS, Goal
from agents.leaderboard.report import short_form, write_leaderboard
from agents.leaderboard.standings import confirmed, finalists, standing
from agents.leaderboard.variations import VARIATIONS
from agents.main_job import HELD_OUT, flown_by
from agents.packed import SUFFIX, read_packed
from agents.presets import flights_share
from agents.pretrained import card, pretrained_ids
from agents.provenance import commit, processor_name, versions
from passive_env.catalogue import environment_id, environment_ids, make_scenario, scenario_name
from passive_env.flights import load_flights
from trackers.compiled import available_cores

COURSES, FLIGHTS = "drawn courses", "held-out recorded flights"
FULL_CONFIRM = 2000
"""Further episodes on which the full leaderboard judges."""

OWN_FIELDS = ("course", "flights", "flight_split")
"""Fields that the leaderboard sets itself."""


class Table(NamedTuple):
    """Policies to be compared in one scenario.

    Attributes:
        section: "leaderboard", "trackers" or "generalisation".
        environment: id.
        title: what is special about the scenario.
        scenario: resolved.
        field: who takes part.
        unfit: learned policies that cannot fly it, and why.
        goals: what learned policies are meant to reach in it.
    """

    section: str
    environment: str
    title: str
    scenario: Any
    field: list[Contestant]
    unfit: dict[str, str]
    goals: tuple[Goal, ...] = ()


def leaderboard(
    envs: Sequence[str] = (), policies: Sequence[str] = (), runs: Sequence[str] = (), episodes: int = 500,
    seed: int = 90_000_000, flights: bool = True, trackers: bool = False, generalisation: bool = False,
    confirm: int = 0, out: Path = Path("leaderboard"), fields: dict[str, Any] | None = None, progress: bool = True,
    engine: AbstractContextManager[Engine] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Fly what is missing, write the leaderboard and print its short form; returns its data.

    Arguments as in `agents.cli.Leaderboard`, fields as keywords of all scenarios, engine as of
    `agents.main_job.compare`.

    Raises:
        ValueError: unknown environment or policy, too few episodes, a negative seed, a field that is not the user's;
            FileNotFoundError: no such run folder. All before anything is flown or written.
    """
    environments = _environments(envs)
    _check(episodes, seed, confirm, fields or {})
    tables = _plan(environments, bool(envs), policies, runs, flights, trackers, generalisation, fields or {})
    make_folder(out)
    begin = time.perf_counter()
    with engine or nullcontext(here) as fly_by:
        entries, flown = _standings(tables, episodes, seed, out, progress, fly_by)
        if confirm:
            entries, further = _confirm(tables, entries, confirm, seed + episodes, out, progress, fly_by)
            flown = flown.joined(further)
    command = _command(envs, policies, runs, episodes, seed, flights, trackers, generalisation, confirm, fields or {})
    about = _about(episodes, seed, flights, fields or {}) | {
        "command": command, "cells": dict(flown.states), "confirm": confirm,
    }  # fmt: skip
    data: dict[str, Any] = {"about": about, "sections": {}}
    for table, entry in zip(tables, entries, strict=True):
        data["sections"].setdefault(table.section, {}).setdefault(table.environment, []).append(entry)
    data["about"]["seconds"] = time.perf_counter() - begin
    write_leaderboard(out, data)
    print(f"{short_form(data)}\n\n{out}; cells: {flown}")
    return data


def _standings(
    tables: Sequence[Table], episodes: int, seed: int, out: Path, progress: bool, fly_by: Engine
) -> tuple[list[dict[str, Any]], Flown]:
    """The standing of every table, and what became of its cells."""
    cells = [[Cell(table.environment, table.scenario, one, episodes, seed) for one in table.field] for table in tables]
    flown = fly_cells([cell for row in cells for cell in row], out, progress, fly_by)
    entries = []
    for table, row in zip(tables, cells, strict=True):
        found = standing(table.scenario, table.field, flown.by_policy(row), seed, table.goals)
        entries.append({"title": table.title, "unfit": table.unfit} | found)
    return entries, flown


def _confirm(
    tables: Sequence[Table], entries: Sequence[dict[str, Any]], episodes: int, seed: int, out: Path, progress: bool,
    fly_by: Engine,
) -> tuple[list[dict[str, Any]], Flown]:  # fmt: skip
    """The standings with verdicts of fresh episodes: whoever was best by luck of the first ones is so no longer."""
    cells = [
        [Cell(table.environment, table.scenario, one, episodes, seed) for one in _finalists(table, entry)]
        for table, entry in zip(tables, entries, strict=True)
    ]
    flown = fly_cells([cell for row in cells for cell in row], out, progress, fly_by)
    found = [
        confirmed(entry, [cell.contestant for cell in row], flown.by_policy(row), seed, table.goals) if row else entry
        for table, entry, row in zip(tables, entries, cells, strict=True)
    ]
    return found, flown


def _finalists(table: Table, entry: Mapping[str, Any]) -> list[Contestant]:
    """Who flies once more; nobody but in the leaderboard itself."""
    if table.section != "leaderboard":
        return []
    return finalists(entry, table.field, table.goals, COSTLY.get(table.environment, ()))


def _environments(envs: Sequence[str]) -> list[str]:
    """Ids without repetitions, all of them where none is named."""
    named = [environment_id(scenario_name(env)) for env in envs]
    return list(dict.fromkeys(named)) or environment_ids()


def _check(episodes: int, seed: int, confirm: int, fields: dict[str, Any]) -> None:
    if episodes < 2:
        raise ValueError(f"--episodes {episodes}: must be at least 2, or there are no intervals")
    if confirm < 0 or confirm == 1:
        raise ValueError(f"--confirm {confirm}: must be 0, or at least 2 episodes, or there are no intervals")
    if seed < 0:
        raise ValueError(f"--seed {seed}: must not be negative")
    for name in OWN_FIELDS:
        if name in fields:
            raise ValueError(f"--fields {name}={fields[name]}: the leaderboard sets it itself; leave it out")


def _plan(
    environments: Sequence[str], named: bool, policies: Sequence[str], runs: Sequence[str], flights: bool,
    trackers: bool, generalisation: bool, fields: dict[str, Any],
) -> list[Table]:  # fmt: skip
    """All tables, in the order of the report; an environment that was named must have one."""
    folders = run_folders(runs, environments)
    everybody = {env: _everybody(env, fields, folders.get(env, ())) for env in environments}
    check_names(policies, everybody)
    tables = []
    for env in environments:
        field = chosen(everybody[env], policies)
        if not field:
            if named:
                raise ValueError(f"--policies {' '.join(policies)}: {env} offers none of them; leave it out of --envs")
            continue
        tables += _courses(env, field, flights, fields)
        if trackers:
            tables += _crossed(env, affordable(env, field), fields)
        if generalisation:
            tables += _varied(env, opponents(env, field), flights, fields)
    return [table for table in tables if table.field]


def _everybody(env: str, fields: dict[str, Any], folders: Sequence[str]) -> list[Contestant]:
    field = [*known_policies(make_scenario(env, fields)), *learned_policies(env, folders)]
    return sorted(field, key=lambda one: KINDS.index(one.kind))


def _table(section: str, env: str, title: str, scenario: Any, field: Sequence[Contestant]) -> Table:
    reasons = {one.name: unfit(one, scenario) for one in field}
    fitting = [one for one in field if not reasons[one.name]]
    return Table(section, env, title, scenario, fitting, {name: why for name, why in reasons.items() if why})


def _courses(env: str, field: Sequence[Contestant], flights: bool, fields: dict[str, Any]) -> list[Table]:
    """The environment as it is, and with recorded flights."""
    scenarios = {COURSES: make_scenario(env, fields)}
    if flights:
        scenarios[FLIGHTS] = flown_by(scenario_name(env), HELD_OUT, fields)
    tables = [_table("leaderboard", env, title, scenario, field) for title, scenario in scenarios.items()]
    goals = () if fields else GOALS.get(env, ())
    return [
        table._replace(goals=tuple(goal for goal in goals if goal.course == table.scenario.course)) for table in tables
    ]


def tracker_names(scenario: Any) -> list[str]:
    """Trackers that a scenario takes by name."""
    if hasattr(scenario, "trackers"):
        return list(scenario.trackers)
    (field,) = (each for each in dataclasses.fields(scenario) if each.name == "tracker")
    return list(field.metadata["options"])


def _crossed(env: str, field: Sequence[Contestant], fields: dict[str, Any]) -> list[Table]:
    """The environment with every tracker."""
    base = make_scenario(env, fields)
    return [_table("trackers", env, name, base.replace(tracker=name), field) for name in tracker_names(base)]


def _varied(env: str, field: Sequence[Contestant], flights: bool, fields: dict[str, Any]) -> list[Table]:
    """The environment as it is, then in every other circumstance."""
    name = scenario_name(env)
    tables = [_table("generalisation", env, "as registered", make_scenario(env, fields), field)]
    for each in VARIATIONS:
        if each.name == name and (flights or not each.flights):
            changed = {**fields, **each.fields}
            scenario = flown_by(name, HELD_OUT, changed) if each.flights else make_scenario(name, changed)
            tables.append(_table("generalisation", env, each.title, scenario, field))
    return tables


def _command(
    envs: Sequence[str], policies: Sequence[str], runs: Sequence[str], episodes: int, seed: int, flights: bool,
    trackers: bool, generalisation: bool, confirm: int, fields: dict[str, Any],
) -> str:  # fmt: skip
    """What makes the same tables; of run folders only the names."""
    folders = ["=".join((name, Path(folder).name)) for name, _, folder in (text.partition("=") for text in runs)]
    listed = {"envs": envs, "policies": policies, "runs": folders}
    listed["fields"] = [f"{name}={value}" for name, value in fields.items()]
    words = ["passive-env leaderboard"]
    words += [f"--{flag} {shlex.join(values)}" for flag, values in listed.items() if values]
    words += [f"--episodes {episodes} --seed {seed}", *(["--no-flights"] if not flights else [])]
    words += [f"--{flag}" for flag, on in {"trackers": trackers, "generalisation": generalisation}.items() if on]
    words += [f"--confirm {confirm}"] if confirm else []
    return " ".join(words)


def _about(episodes: int, seed: int, recorded: bool, fields: dict[str, Any]) -> dict[str, Any]:
    """What the leaderboard was made with; no computer's name."""
    return {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "episodes": episodes,
        "seed": seed,
        "fields": fields,
        "processor": processor_name(),
        "cores": available_cores(),
        "platform": f"{platform.system()} {platform.machine()}",
        "versions": versions(),
        "commit": commit(),
        "code": code_digest(),
        "held_out": _held_out() if recorded else {},
        "trained_on_flights": {env: share for env in pretrained_ids() if (share := _flights_share(env))},
    }


def _flights_share(env: str) -> float:
    """Share of a pretrained policy's training that was on recorded courses."""
    description = read_packed(card(env).with_suffix(SUFFIX)).description
    return flights_share(description["preset"], description["fields"])


def _held_out() -> dict[str, int]:
    """How many recorded flights no policy was trained on, and by how many aircraft."""
    flights = load_flights().split("test").flights
    return {"flights": len(flights), "aircraft": len({flight.icao24 for flight in flights})}
