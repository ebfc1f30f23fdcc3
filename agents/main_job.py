"""The jobs behind the commands: train and compare, evaluate, print."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from agents.evaluation import fly_all, summarize, unique_names
from agents.files import make_folder
from agents.learned import is_trained, open_policy
from agents.policy import Policy, make_policy, policy_names, sees_world
from agents.pretrained import PRETRAINED, load_pretrained, pretrained_ids, sees_alike
from agents.report import as_markdown, crossing_as_markdown, write_crossing, write_evaluation
from passive_env.catalogue import environment_id, make_scenario, scenario_name

HELD_OUT = "held-out"
LEARNED = "learned"
"""Another name of the pretrained policy, in replays."""
FINAL_SEED = 30_000_000
"""Seed of the first episode of final evaluations."""


def train_and_compare(
    env: str, algo: str, timesteps: int | None, seed: int, envs: int | None, device: str, out: Path | None,
    resume: bool, episodes: int, flights: str, fields: dict[str, Any],
) -> Path:  # fmt: skip
    """The main job; returns the run folder. Arguments as in `agents.cli.Train`; fields as keywords of the scenario."""
    from agents.training import plan, train

    name = scenario_name(env)
    _check_numbers(episodes, seed)
    if seed >= 2**32:
        raise ValueError(f"--seed {seed}: must lie below 2**32")
    flown_by(name, flights, fields)  # a bad file must fail before the training, not after it
    folder = out or _free_folder(Path("runs") / f"{name}-{algo}-s{seed}", resume)
    run = plan(name, folder, algo, seed, device, timesteps, envs, fields)
    begin = time.perf_counter()
    train(run, resume)
    print(f"trained in {time.perf_counter() - begin:.0f} s; run folder {folder}")
    policies = (*_standard_policies(name, fields), str(folder))
    compare(env, policies, (), episodes, FINAL_SEED, None, folder, fields)
    compare(env, policies, (), episodes, FINAL_SEED, flights, folder / "flights", fields)
    return folder


def compare(
    env: str, policies: Sequence[str] | None, trackers: Sequence[str], episodes: int, seed: int, flights: str | None,
    out: Path, fields: dict[str, Any],
) -> dict[str, Any]:  # fmt: skip
    """Evaluate policies (crossed with trackers, if any are named), write the files and print the table.

    Arguments as in `agents.cli.Evaluate`, fields as keywords of the scenario; returns the summary.
    """
    name = scenario_name(env)
    _check_numbers(episodes, seed)
    if policies is None:
        policies = [*_standard_policies(name, fields), *_pretrained(name, fields)]
    if not policies:
        raise ValueError("no policies to compare: name some after --policies")
    base = make_scenario(name, fields) if flights is None else flown_by(name, flights, fields)
    scenarios = {tracker: base.replace(tracker=tracker) for tracker in trackers} or {"": base}
    teams = {key: _make_policies(policies, name, scenario) for key, scenario in scenarios.items()}
    make_folder(out)
    summaries = {}
    for tracker, scenario in scenarios.items():
        records = fly_all(scenario, teams[tracker], episodes, seed)
        summary = summarize(environment_id(name), seed, records)
        summary |= {"tracker": scenario.tracker, "course": scenario.course, "flights": flights, "fields": fields}
        folder = out / tracker if len(scenarios) > 1 else out
        write_evaluation(folder, summary, records, scenario)
        print(f"\n{folder}{f' (tracker {tracker})' if tracker else ''}\n\n{as_markdown(summary)}")
        summaries[tracker] = summary
    if len(summaries) == 1:
        return next(iter(summaries.values()))
    write_crossing(out, summaries)
    print(f"\n{out}\n\n{crossing_as_markdown(summaries)}")
    return summaries


def replay(
    env: str, policies: Sequence[str] | None, seed: int, out: Path, gif: Path | None, mp4: Path | None,
    flights: str | None, fields: dict[str, Any],
) -> list[Path]:  # fmt: skip
    """Fly policies through one episode and write its page and animations; returns the files written.

    Arguments as in `agents.cli.Replay`, fields as keywords of the scenario.
    """
    from agents.animation import check_animation, write_animation
    from agents.replay import plotly_script, write_replay
    from agents.replay_record import fly_once, record

    name = scenario_name(env)
    _check_numbers(1, seed)
    if out.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"--out {out}: must be an HTML file, such as replay.html")
    animations = [path for path in (gif, mp4) if path is not None]
    for path, suffix in ((gif, ".gif"), (mp4, ".mp4")):
        if path is not None and path.suffix.lower() != suffix:
            raise ValueError(f"--{suffix[1:]} {path}: must end in {suffix}")
    for path in animations:
        check_animation(path)
    plotly_script()
    scenario = make_scenario(name, fields) if flights is None else flown_by(name, flights, fields)
    team = _make_policies(_shown(policies, name, fields), name, scenario)
    flown = {label: fly_once(scenario, policy, seed) for label, policy in team.items()}
    records = {label: record(scenario, flight) for label, flight in flown.items()}
    written = [write_replay(out, environment_id(name), seed, scenario.replay_axis, records)]
    return written + [write_animation(path, scenario, flown) for path in animations]


def _shown(policies: Sequence[str] | None, name: str, fields: dict[str, Any]) -> list[str]:
    """Policies of a replay; "learned" is the pretrained one, unless a run of that name is there."""
    if policies is not None:
        if not policies:
            raise ValueError("no policies to show: name some after --policies")
        return [PRETRAINED if each == LEARNED and not is_trained(each) else each for each in policies]
    known = policy_names(make_scenario(name, fields))
    baseline = next(each for each in ("paper", "fixed", "straight", *known) if each in known)
    return [baseline, *(["rule"] if "rule" in known else []), *_pretrained(name, fields)]


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


def _pretrained(name: str, fields: dict[str, Any]) -> list[str]:
    """The pretrained policy's name, where there is one and it can fly."""
    fits = environment_id(name) in pretrained_ids() and sees_alike(name, make_scenario(name, fields))
    return [PRETRAINED] if fits else []


def _check_numbers(episodes: int, seed: int) -> None:
    if episodes < 1:
        raise ValueError(f"--episodes {episodes}: must be at least 1")
    if seed < 0:
        raise ValueError(f"--seed {seed}: must not be negative")


def _make_policies(names: Sequence[str], scenario_name_: str, scenario: Any) -> dict[str, Policy]:
    known = [*policy_names(scenario), PRETRAINED]
    labels = unique_names([name if name in known else "learned" for name in names])
    return {
        label: _make_policy(name, scenario_name_, scenario, known) for label, name in zip(labels, names, strict=True)
    }


def _make_policy(name: str, scenario_name_: str, scenario: Any, known: Sequence[str]) -> Policy:
    if name == PRETRAINED:
        return load_pretrained(scenario_name_, scenario)
    if name in known or not is_trained(name):
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
