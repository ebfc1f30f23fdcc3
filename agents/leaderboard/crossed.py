"""What the leaderboard says of other trackers and other circumstances than those of training."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

from agents.leaderboard.contestants import COSTLY, KIND_OF, KINDS
from agents.leaderboard.standings import BASES, REFERENCE
from agents.leaderboard.words import (
    best_of,
    headline_verdicts,
    listed,
    mean_of,
    mean_words,
    metres,
    nees_words,
    ratio_words,
    rows_table,
    sections_of,
    short,
    standings_of,
)
from agents.pretrained import PRETRAINED
from agents.report import percent

CHOSEN_HERE = (
    "Whom learned policies are compared with is chosen on the very episodes shown, and of so many comparisons some "
    "fall out of their intervals by luck."
)
DOES_NOT_FIT = "does not fit"
"""In place of figures, where a policy sees other numbers than it was trained with."""


def tracker_part(data: Mapping[str, Any]) -> list[str]:
    """Every tracker under every policy."""
    if not sections_of(data, "trackers"):
        return []
    parts = [
        "## Trackers",
        "Every tracker under every policy on the same tapes: does a maneuver help the tracker it was made for only? "
        f"{_answer(data)}Final error in metres. NEES: an honest tracker has the mean that is named. Ratios to the rule "
        f"or fixed policy that is best with the same tracker. {CHOSEN_HERE} {_left_out(data, 'trackers', KINDS)}",
    ]
    for environment, entries in sections_of(data, "trackers").items():
        parts += [f"### Trackers of `{environment}`", f"{_honest(entries[0])}{_helped(entries)}"]
        parts.append(tracker_table(entries))
    return parts


def _answer(data: Mapping[str, Any]) -> str:
    """How many other trackers learned policies help, in a sentence; empty where nothing learned takes part."""
    found = list(_other_trackers(data))
    if not found:
        return ""
    misfits = sum(len(entry["unfit"]) for _, entry in standings_of(data, "trackers"))
    fit = f"; {misfits} more show it other numbers than it was trained on" if misfits else ""
    return (
        "Against the best fixed policy or rule, with trackers other than the one that an environment is registered "
        f"with (such as give the same figures count once), what was learned is {_tally(found)}{fit}. "
    )


def _other_trackers(data: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any], Mapping[str, Any]]]:
    """(environment, standing, verdict) by the error that ranks, against the best fixed policy or rule.

    Of trackers that are not the environment's own, and do not give the same figures as that one or one before.
    """
    for environment, entries in sections_of(data, "trackers").items():
        own = sections_of(data, "leaderboard")[environment][0]["tracker"]
        seen = []
        for entry in sorted(entries, key=lambda each: each["tracker"] != own):
            for each in headline_verdicts(entry, REFERENCE):
                if (figures := (each["policy"], ratio_words(each["mean"]))) not in seen:
                    seen.append(figures)
                    if entry["tracker"] != own:
                        yield environment, entry, each


def _tally(found: Sequence[tuple[str, Mapping[str, Any], Mapping[str, Any]]]) -> str:
    """How many are ahead, level, behind, and which ones the last are."""
    counts = Counter(each["mean_verdict"] for _, _, each in found)
    behind = [
        f"{short(environment)} {entry['title']} {each['mean']['ratio']:.2f}"
        for environment, entry, each in found
        if each["mean_verdict"] == "behind"
    ]
    named = f" ({', '.join(behind)})" if behind else ""
    return f"ahead in {counts['ahead']}, level in {counts['level']}, behind in {counts['behind']}{named}"


def _helped(entries: Sequence[Mapping[str, Any]]) -> str:
    """Which trackers what was learned helps, in words; empty where nothing learned takes part."""
    found = [
        f"`{entry['title']}` {ratio_words(each['mean'])}, {each['mean_verdict']}"
        for entry in entries
        for each in headline_verdicts(entry, REFERENCE)
    ]
    if not found:
        return ""
    error = entries[0]["metrics"][entries[0]["headline"]]
    return f" Learned to the best fixed policy or rule with the same tracker ({error}): {'; '.join(found)}."


def _left_out(data: Mapping[str, Any], section: str, kinds: Collection[str]) -> str:
    """Which policies of these kinds are not flown in a section, because they search too long."""
    costly = {
        environment: [name for name in COSTLY.get(environment, ()) if KIND_OF[name] in kinds]
        for environment in sections_of(data, section)
    }
    named = "; ".join(f"{listed(names)} of {short(environment)}" for environment, names in costly.items() if names)
    return f"Left out for the time that they take: {named}." if named else ""


def _honest(entry: Mapping[str, Any]) -> str:
    return f"{entry['score'].capitalize()} error; mean NEES of an honest tracker: {entry['state_size']}."


def tracker_table(entries: Sequence[Mapping[str, Any]]) -> str:
    """One row per tracker and policy."""
    rows: list[dict[str, str]] = []
    for entry in entries:
        rows += [_tracker_row(entry, name, figures) for name, figures in entry["policies"].items()]
        missing = dict.fromkeys(rows[0], "") | {"tracker": f"`{entry['title']}`", "final mean": DOES_NOT_FIT}
        rows += [missing | {"policy": f"`{name}`"} for name in entry["unfit"]]
    return rows_table(rows)


def _tracker_row(entry: Mapping[str, Any], name: str, figures: Mapping[str, Any]) -> dict[str, str]:
    """Cells by the names of their columns."""
    final, average, *_ = entry["metrics"]
    return {
        "tracker": f"`{entry['title']}`",
        "policy": f"`{name}`",
        "final mean": mean_words(figures[final]),
        "p95": metres(figures[final]["p95"]),
        "time average": mean_words(figures[average]),
        "NEES mean / median": nees_words(figures),
        "lost": percent(figures["lost_share"]),
        "collapsed": percent(figures["collapse_share"]),
        "reference": f"`{entry['reference']}`",
        "final / reference": ratio_words(figures["ratios"][final]["mean"]),
        "average / reference": ratio_words(figures["ratios"][average]["mean"]),
    }


def varied_part(data: Mapping[str, Any]) -> list[str]:
    """Other circumstances than those of training."""
    if not sections_of(data, "generalisation"):
        return []
    shares = data["about"].get("trained_on_flights", {})
    parts = [
        "## Generalisation",
        "Where circumstances differ from those that the environments are registered with: ratios to the best fixed "
        f"policy or rule and to the best greedy one in the same circumstances. {CHOSEN_HERE} Planners and oracles do "
        f"not fly. {_left_out(data, 'generalisation', ('greedy',))} Numbers of targets, stations and transmitters stay "
        "as they are: they decide what a policy sees.",
    ]
    for environment, entries in sections_of(data, "generalisation").items():
        parts += [f"### Generalisation in `{environment}`", _circumstances(environment, entries, shares)]
        parts.append(varied_table(entries))
    return [part for part in parts if part]


def _circumstances(environment: str, entries: Sequence[Mapping[str, Any]], shares: Mapping[str, float]) -> str:
    """Where the learned policy is behind, and whether it was trained on flights; empty where nothing learned flies."""
    found = [(entry, each) for entry in entries for each in headline_verdicts(entry, REFERENCE)]
    if not found:
        return ""
    behind = [
        f"{entry['title']} {each['mean']['ratio']:.2f}" for entry, each in found if each["mean_verdict"] == "behind"
    ]
    words = f"Behind the best fixed policy or rule: {', '.join(behind) or 'nowhere'}."
    share = shares.get(environment) if any(each["policy"] == PRETRAINED for _, each in found) else None
    trained = f" `{PRETRAINED}` met other recorded flights in {100.0 * share:.0f} % of its training." if share else ""
    return words + trained


def varied_table(entries: Sequence[Mapping[str, Any]]) -> str:
    """One row per circumstance and learned policy; a single one where nothing learned takes part."""
    rows = []
    for entry in entries:
        learned = [name for name, figures in entry["policies"].items() if figures["kind"] == "learned"]
        rows += [_varied_row(entry, name) for name in (*learned, *entry["unfit"]) or ("",)]
    return rows_table(rows)


def _varied_row(entry: Mapping[str, Any], name: str) -> dict[str, str]:
    """Cells by the names of their columns."""
    row = {"circumstances": entry["title"], "error": entry["metrics"][entry["headline"]]}
    for kind, words in BASES.items():
        best = best_of(entry, kind)
        row |= {f"best {words}": f"`{best}`" if best else "", f"mean, {words}": mean_of(entry, best)}
    mean = DOES_NOT_FIT if name in entry["unfit"] else mean_of(entry, name)
    row |= {"policy": f"`{name}`" if name else "", "mean": mean}
    for what in ("mean", "p95"):
        row |= {f"{what} / {words}": _against(entry, name, kind, what) for kind, words in BASES.items()}
    return row


def _against(entry: Mapping[str, Any], name: str, kind: str, what: str) -> str:
    """A learned policy's ratio to the best one of a kind."""
    found = headline_verdicts(entry, kind, name)
    return ratio_words(found[0][what]) if found else ""
