"""Model cards of packed policies, and the table of those that come with the package.

``python -m agents.model_card docs/pretrained.md`` writes that table into a document anew.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from agents.files import write_text
from agents.presets import flights_share, load_preset
from agents.pretrained import pretrained_ids, read_record
from agents.report import METRICS
from agents.reproduction.report import markdown_table
from passive_env.catalogue import scenario_name

BEGIN, END = "<!-- pretrained policies -->", "<!-- end -->"
"""Lines between which a document has the table."""


def card_as_markdown(record: Mapping[str, Any], description: Mapping[str, Any]) -> str:
    """A packed policy's model card.

    Args:
        record: as `agents.pack.pack` returns.
        description: of the packed file.
    """
    return "\n\n".join(
        [
            f"# Pretrained policy of {record['environment']}",
            *_training(description),
            "## Numbers",
            *_numbers(record),
            "## Limits",
            *_limits(description),
            "## Versions",
            _versions("Trained", description),
            _versions("Packed and measured", record),
        ]
    )


def training_command(description: Mapping[str, Any]) -> str:
    """The command that trains such a policy."""
    words = ["passive-env", "train", "--env", description["environment"]]
    for name in ("algo", "seed", "timesteps", "envs"):
        words += [f"--{name}", str(description[name])]
    fields = [f"{name}={value}" for name, value in description["fields"].items()]
    return shlex.join([*words, *(["--fields", *fields] if fields else [])])


def pretrained_table() -> str:
    """One row per pretrained policy: size, errors, ratios to those of the strongest policies, by name."""
    return markdown_table(
        ["environment", "kB", "error", "final mean", "p95", "time average", "lost", "final / fixed or rule",
         "time average / fixed or rule", "final / greedy", "time average / greedy"],
        [_row(read_record(environment)) for environment in pretrained_ids()],
    )  # fmt: skip


def with_table(text: str) -> str:
    """A document with the table as it is now.

    Raises:
        ValueError: no place for it.
    """
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise ValueError(f"the document has no lines {BEGIN} and {END} to write the table between")
    return f"{before}{BEGIN}\n\n{pretrained_table()}\n\n{END}{after}"


def _training(description: Mapping[str, Any]) -> list[str]:
    seconds = description["seconds"]
    took = "an unknown time" if seconds is None else f"{seconds:.0f} s of wall time"
    network = description["network"]
    return [
        f"Trained by `{description['algo']}` with seed {description['seed']} in {took}:",
        f"    {training_command(description)}",
        _preset_words(description),
        f"Network: {network['kind']}, sizes {network['sizes']}, {network['activation']}; plain float32 arrays and this "
        "description in JSON, no code (`agents.packed`). It acts by its deterministic action.",
    ]


def _preset_words(description: Mapping[str, Any]) -> str:
    shipped = load_preset(scenario_name(description["environment"]), description["algo"])
    changed = sorted(_differences(description["preset"], shipped))
    if not changed:
        return "Its preset is the one that this version of the package ships."
    return f"Its preset differs from the one that this version of the package ships: {'; '.join(changed)}."


def _differences(then: Mapping[str, Any], now: Mapping[str, Any], within: str = "") -> list[str]:
    """Settings that differ, in words."""
    found = []
    for name in then.keys() | now.keys():
        old, new = then.get(name), now.get(name)
        if isinstance(old, Mapping) and isinstance(new, Mapping):
            found += _differences(old, new, f"{within}{name}.")
        elif old != new:
            found.append(f"{within}{name} was {old}, is {new}")
    return found


_STRONGEST = {"rule": "the strongest fixed policy or rule", "greedy": "the strongest greedy one"}
"""Groups of policies that a learned one is compared with, in words."""


def _numbers(record: Mapping[str, Any]) -> list[str]:
    compared, kept = record["comparison"], record["recorded"]
    score = compared["score"]
    strongest = (
        f"{' and '.join(compared['strongest'][f'{when}_{score}_error_m'].values())} by the {words} error"
        for when, words in METRICS.items()
    )
    groups = [_STRONGEST[group] for group in compared["strongest"][f"final_{score}_error_m"]]
    figures = [[name, *_figures(each, score)] for name, each in compared["policies"].items()]
    ratios = [
        [f"learned / {name}", *(_ratio(each[f"{when}_{score}_error_m"]) for when in ("final", "mean"))]
        for name, each in compared["ratios"].items()
    ]
    means = [
        [name, f"{each['mean']:.4g}", "[{:.4g}, {:.4g}]".format(*each["ci95"])] for name, each in kept["errors"].items()
    ]
    return [
        f"{score.capitalize()} error in metres over {compared['episodes']} paired episodes from seed "
        f"{compared['seed']}, beside {' and '.join(groups)}: {', '.join(strongest)}.",
        markdown_table(["policy", "final mean", "p95", "time average", "lost", "µs/decision"], figures),
        markdown_table(["ratio of means, 95 % interval", "final", "time average"], ratios),
        f"What a test flies again: {kept['episodes']} episodes from seed {kept['seed']}, means with bootstrap 95 % "
        "intervals; the record beside this card also has the errors of every episode:",
        markdown_table(["error", "mean", "interval"], means),
    ]


def _limits(description: Mapping[str, Any]) -> list[str]:
    scenario = {name: value for name, value in description["scenario"].items() if not name.startswith("reward_")}
    scenario |= description["interface"]
    course = f"course={scenario['course']!r}" if "course" in scenario else "the registered courses"
    if (share := flights_share(description["preset"], description["fields"])) > 0.0:
        course += f", in {100.0 * share:.0f} % of the environments on recorded flights of the training part"
    return [
        f"It is for {description['environment']} alone: loading refuses any scenario whose observation or actions "
        f"differ (digest {description['observation_digest']}, interface {description['interface']}). Trained on "
        f"{course}, with the tracker {scenario.get('tracker')!r}; with other courses, trackers, accuracies, platforms "
        "or horizons it flies, but nothing is promised. How it does in some of these stands in the leaderboard "
        "(docs/leaderboard.md, Generalisation); in others evaluate it beside the rules first. It has met simulated "
        "sensors only, knows nothing of terrain, airspace or other traffic, and must not steer real platforms.",
        "Fields of the scenario it was trained on, rewards left out:",
        ", ".join(f"`{name}={value}`" for name, value in scenario.items()),
    ]


def _versions(what: str, source: Mapping[str, Any]) -> str:
    packages = ", ".join(f"{name} {version}" for name, version in source["versions"].items())
    return f"{what} at commit {source['commit'] or 'unknown'} with {packages}."


def _figures(figures: Mapping[str, Any], score: str) -> list[str]:
    final, mean = (figures[f"{when}_{score}_error_m"] for when in ("final", "mean"))
    lost = f"{100.0 * figures['lost_share']:.2f} %"
    return [f"{final['mean']:.0f}", f"{final['p95']:.0f}", f"{mean['mean']:.0f}", lost,
            f"{figures['decision_time_us']:.1f}"]  # fmt: skip


def _ratio(ratio: Mapping[str, Any]) -> str:
    low, high = ratio["ci95"]
    return f"{ratio['ratio']:.3f} [{low:.3f}, {high:.3f}]"


def _row(record: Mapping[str, Any]) -> list[str]:
    compared = record["comparison"]
    score = compared["score"]
    return [
        f"`{record['environment']}`", f"{record['bytes'] / 1e3:.0f}", score,
        *_figures(compared["policies"]["learned"], score)[:-1], *_against(compared, "rule"),
        *_against(compared, "greedy"),
    ]  # fmt: skip


def _against(compared: Mapping[str, Any], group: str) -> list[str]:
    """Ratios of the final error and of the time average to those of the strongest of a group, and who that is."""
    errors = [f"{when}_{compared['score']}_error_m" for when in METRICS]
    names = {error: compared["strongest"][error].get(group) for error in errors}
    return [f"{_ratio(compared['ratios'][name][error])} `{name}`" if name else "—" for error, name in names.items()]


if __name__ == "__main__":
    for document in map(Path, sys.argv[1:]):
        write_text(document, with_table(document.read_text(encoding="utf-8")))
