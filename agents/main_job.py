"""The jobs behind the commands: train and compare, evaluate, print."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

from agents.comparison import summarize
from agents.distributed.cluster import ray_module
from agents.evaluation import Engine, fly_all, here, unique_names
from agents.files import make_folder
from agents.learned import is_trained, open_policy
from agents.page import fragment
from agents.policy import Policy, make_policy, policy_names, sees_world
from agents.pretrained import PRETRAINED, load_pretrained, pretrained_ids, sees_alike
from agents.report import as_markdown, crossing_as_markdown, write_crossing, write_evaluation
from agents.run_report import REPORT, Comparison, Settings, command_line, comparison, duration, write_run_report
from passive_env.catalogue import environment_id, make_scenario, scenario_name

HELD_OUT = "held-out"
FINAL_SEED = 30_000_000
"""Seed of the first episode of final evaluations."""
TRAINED = "learned"
"""Name of policies that were trained, in tables; in replays the pretrained policy's."""


def train_and_compare(
    env: str, algo: str, timesteps: int | None, seed: int, envs: int | None, device: str, out: Path | None,
    resume: bool, episodes: int, flights: str, fields: dict[str, Any], runners: int = 0, address: str | None = None,
) -> Path:  # fmt: skip
    """The main job; returns the run folder.

    Arguments as in `agents.cli.Train`; fields as keywords of the scenario, runners 0 for Stable-Baselines3.
    """
    from agents.training import plan, train

    name = scenario_name(env)
    check_numbers(episodes, seed)
    if seed >= 2**32:
        raise ValueError(f"--seed {seed}: must lie below 2**32")
    flown_by(name, flights, fields)  # a bad file must fail before the training, not after it
    folder = out or _free_folder(Path("runs") / f"{name}-{algo}-s{seed}", resume)
    run = plan(name, folder, algo, seed, device, timesteps, envs, fields, runners)
    begin = time.perf_counter()
    if runners:
        train_on_ray = ray_module("agents.distributed.training").train_on_ray
        train_on_ray(run, address, resume)
    else:
        train(run, resume)
    print(f"trained in {time.perf_counter() - begin:.0f} s; run folder {folder}")
    policies = (*_standard_policies(name, fields), str(folder))
    flown = [
        *_compared(name, policies, (), episodes, FINAL_SEED, None, folder, fields, TRAINED),
        *_compared(name, policies, (), episodes, FINAL_SEED, flights, folder / "flights", fields, TRAINED),
    ]
    write_run_report(folder, _trained(run, episodes, flights), flown)
    print(f"\n{folder / REPORT}")
    return folder


def _trained(run: Any, episodes: int, flights: str) -> Settings:
    """What a report says of a training, apart from the comparisons."""
    from agents.training import training_seconds

    asked = {
        "env": environment_id(run.scenario_name), "algo": run.algo, "timesteps": run.timesteps, "seed": run.seed,
        "envs": run.envs, "device": run.device, "episodes": episodes, "flights": flights, "fields": run.fields,
    }  # fmt: skip
    seconds = training_seconds(run.folder)
    took = "" if seconds is None else f", in {duration(seconds)}"
    return Settings(
        title=f"{run.scenario_name}: learned by {run.algo}, seed {run.seed}",
        command=command_line("train", asked | {"out": "DIR"}),
        settings=asked,
        folder=run.folder,
        preset=run.preset,
        tiles={f"steps of training{took}": f"{run.timesteps:,}"},
    )


def compare(
    env: str, policies: Sequence[str] | None, trackers: Sequence[str], episodes: int, seed: int, flights: str | None,
    out: Path, fields: dict[str, Any], engine: AbstractContextManager[Engine] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Evaluate policies (crossed with trackers, if any are named), write the files and print the table.

    Arguments as in `agents.cli.Evaluate`, fields as keywords of the scenario, engine what flies, once it is entered
    (None: this process); returns the summary.
    """
    name = scenario_name(env)
    check_numbers(episodes, seed)
    if policies is None:
        policies = [*_standard_policies(name, fields), *fitting_pretrained(name, fields)]
    if not policies:
        raise ValueError("no policies to compare: name some after --policies")
    flown = _compared(name, policies, trackers, episodes, seed, flights, out, fields, engine=engine)
    summaries = {each.summary["tracker"]: each.summary for each in flown}
    preface = ""
    if len(flown) > 1:
        write_crossing(out, summaries)
        crossing = crossing_as_markdown(summaries)
        preface = f"<section><h2>Trackers and policies</h2>{fragment(crossing, name='Trackers and policies')}</section>"
        print(f"\n{out}\n\n{crossing}")
    asked = {
        "policies": policies, "trackers": trackers, "episodes": episodes, "seed": seed, "fields": fields,
        "flights": flights,
    }  # fmt: skip
    command = command_line("evaluate", asked | {"out": "DIR"}, environment_id(name))
    title = f"{name}: {len(policies)} {'policy' if len(policies) == 1 else 'policies'} compared"
    write_run_report(out, Settings(title, command, {"env": environment_id(name)} | asked, preface=preface), flown)
    print(f"\n{out / REPORT}")
    return flown[0].summary if len(flown) == 1 else summaries


def _compared(
    name: str, policies: Sequence[str], trackers: Sequence[str], episodes: int, seed: int, flights: str | None,
    out: Path, fields: dict[str, Any], focus: str = "", engine: AbstractContextManager[Engine] | None = None,
) -> list[Comparison]:  # fmt: skip
    """Fly policies with every tracker, write the files and print the tables; the policy in focus leads a report."""
    base = make_scenario(name, fields) if flights is None else flown_by(name, flights, fields)
    scenarios = {tracker: base.replace(tracker=tracker) for tracker in trackers} or {"": base}
    teams = {key: make_policies(policies, name, scenario) for key, scenario in scenarios.items()}
    make_folder(out)
    flown = []
    with engine or nullcontext(here) as fly_by:
        for tracker, scenario in scenarios.items():
            records = fly_all(scenario, teams[tracker], episodes, seed, engine=fly_by)
            summary = summarize(environment_id(name), seed, records)
            summary |= {"tracker": scenario.tracker, "course": scenario.course, "flights": flights, "fields": fields}
            folder = out / tracker if len(scenarios) > 1 else out
            write_evaluation(folder, summary, records, scenario)
            print(f"\n{folder}{f' (tracker {tracker})' if tracker else ''}\n\n{as_markdown(summary)}")
            flown.append(comparison(_heading(scenario, flights, len(scenarios) > 1), summary, records, scenario, focus))
    return flown


def _heading(scenario: Any, flights: str | None, crossed: bool) -> str:
    """What was compared, in words."""
    if crossed:
        return f"Tracker {scenario.tracker}"
    if flights is not None:
        return "Held-out recorded flights" if flights == HELD_OUT else f"Recorded flights of {Path(flights).name}"
    return {"random": "Drawn courses", "flights": "Recorded flights"}.get(scenario.course, f"Course {scenario.course}")


def flown_by(name: str, flights: str, fields: dict[str, Any]) -> Any:
    """The scenario with recorded flights as targets: a file, or the held-out part of the shipped one.

    Raises:
        FileNotFoundError, ValueError: no such file, or nothing usable in it.
    """
    source = {"flight_split": "test"} if flights == HELD_OUT else {"flight_split": "all", "flights": flights}
    scenario = make_scenario(name, {**fields, "course": "flights", **source})
    scenario.check_flights()
    return scenario


def _standard_policies(name: str, fields: dict[str, Any]) -> list[str]:
    """All policies a scenario offers, except oracles: they take as long as planners and decide from the truth."""
    scenario = make_scenario(name, fields)
    return [known for known in policy_names(scenario) if not sees_world(make_policy(known, scenario))]


def fitting_pretrained(name: str, fields: dict[str, Any]) -> list[str]:
    """The pretrained policy's name, where there is one and it can fly."""
    fits = environment_id(name) in pretrained_ids() and sees_alike(name, make_scenario(name, fields))
    return [PRETRAINED] if fits else []


def check_numbers(episodes: int, seed: int) -> None:
    """Refuse no episodes and negative seeds."""
    if episodes < 1:
        raise ValueError(f"--episodes {episodes}: must be at least 1")
    if seed < 0:
        raise ValueError(f"--seed {seed}: must not be negative")


def make_policies(names: Sequence[str], scenario_name_: str, scenario: Any) -> dict[str, Policy]:
    """Policies by the names they have in tables; see `named_policy`."""
    known = [*policy_names(scenario), PRETRAINED]
    labels = unique_names([name if name in known else TRAINED for name in names])
    return {label: named_policy(name, scenario_name_, scenario) for label, name in zip(labels, names, strict=True)}


def named_policy(name: str, scenario_name_: str, scenario: Any) -> Policy:
    """A policy by its name, `PRETRAINED`, a run folder or a packed file, for a variant of a catalogue's scenario."""
    if name == PRETRAINED:
        return load_pretrained(scenario_name_, scenario)
    if name in policy_names(scenario) or not is_trained(name):
        return make_policy(name, scenario)
    return open_policy(name, environment_id(scenario_name_), scenario.make_simulation())


def _free_folder(folder: Path, resume: bool) -> Path:
    """The folder itself, or numbered so that no earlier run is touched."""
    if resume:
        raise ValueError("--resume needs --out with the folder of the run to go on with")
    number = 1
    candidate = folder
    while candidate.exists():
        number += 1
        candidate = folder.with_name(f"{folder.name}-{number}")
    return candidate
