"""The replay command: who flies, in which episode, and what is written of it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from agents.animation import check_animation, write_animation
from agents.learned import is_trained
from agents.main_job import TRAINED, check_numbers, fitting_pretrained, flown_by, make_policies
from agents.policy import policy_names
from agents.pretrained import PRETRAINED
from agents.replay import plotly_script, write_replay
from agents.replay_record import fly_once, record
from passive_env.catalogue import environment_id, make_scenario, scenario_name


def replay(
    env: str, policies: Sequence[str] | None, seed: int, out: Path, gif: Path | None, mp4: Path | None,
    flights: str | None, fields: dict[str, Any],
) -> list[Path]:  # fmt: skip
    """Fly policies through one episode and write its page and animations; returns the files written.

    Arguments as in `agents.cli.Replay`, fields as keywords of the scenario.
    """
    name = scenario_name(env)
    check_numbers(1, seed)
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
    team = make_policies(_shown(policies, name, fields), name, scenario)
    flown = {label: fly_once(scenario, policy, seed) for label, policy in team.items()}
    records = {label: record(scenario, flight) for label, flight in flown.items()}
    written = [write_replay(out, environment_id(name), seed, scenario.replay_axis, records)]
    return written + [write_animation(path, scenario, flown) for path in animations]


def _shown(policies: Sequence[str] | None, name: str, fields: dict[str, Any]) -> list[str]:
    """Policies of a replay; "learned" is the pretrained one, unless a run of that name is there."""
    if policies is not None:
        if not policies:
            raise ValueError("no policies to show: name some after --policies")
        return [PRETRAINED if each == TRAINED and not is_trained(each) else each for each in policies]
    known = policy_names(make_scenario(name, fields))
    baseline = next(each for each in ("paper", "fixed", "straight", *known) if each in known)
    return [baseline, *(["rule"] if "rule" in known else []), *fitting_pretrained(name, fields)]
