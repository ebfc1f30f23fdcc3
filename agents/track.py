"""Trackers on a user's own recordings: the job behind ``passive-env track``.

file → recording → scenario of the fitting environment → playback → track.csv, track.json, track.png, fit.png
                                                            └→ a policy's advice per instant, advice.csv
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agents.files import make_folder, save_figure, write_json, write_text
from agents.main_job import named_policy
from agents.policy import sees_world
from agents.track_files import Track, advice_csv, advice_table, summary, track_csv
from agents.track_pictures import fit_picture, track_picture
from agents.track_sample import SAMPLE_GUESS, sample_path
from passive_env.catalogue import make_scenario, scenario_name
from passive_env.playback import Playback, first_scan
from passive_env.playback_angles import AnglePlayback
from passive_env.playback_bearings import BearingPlayback
from passive_env.playback_fixes import FixPlayback
from passive_env.playback_sums import SumPlayback
from passive_env.recording import read_angles, read_azimuths, read_bearings, read_range_sums
from trackers import ANGLE_TRACKERS, MANEUVER_TRACKERS, RANGE_SUM_TRACKERS, TRACKERS

SAMPLE = "sample"
"""In place of a file: the one that comes with the package."""


@dataclass(frozen=True)
class Family:
    """What recordings of one kind need.

    Attributes:
        usual: tracker that the family's name stands for.
        trackers: all of them.
        read: file and origin to recording.
        playback: its class.
        environment: by the recording and the tracker's name.
        fields: of the scenario, by the recording.
    """

    usual: str
    trackers: Mapping[str, Any]
    read: Callable[..., Any]
    playback: Callable[..., Any]
    environment: Callable[[Any, str], str]
    fields: Callable[[Any], dict[str, Any]]


def _bearing_environment(recording: Any, tracker: str) -> str:
    if len(recording.stations) > 1:
        return "TwoStation"
    if tracker == "rp_ekf_adaptive":
        return "OwnshipManeuvering"
    return "Ownship" if _targets(recording) == 1 else "OwnshipMulti"


def _targets(recording: Any) -> int:
    """Tracks that the first scan starts."""
    return int(recording.valid[first_scan(recording), -1].sum())


def _pool(recording: Any) -> dict[str, Any]:
    """Fields of a passive radar with the recording's transmitters.

    Raises:
        ValueError: fewer than two of them.
    """
    d = recording.transmitters.shape[1]
    if len(recording.names) < 2:
        raise ValueError(f"{recording.source}: has one transmitter, a track on range sums needs two or more")
    if len(recording.names) > 2:
        return {"dimensions": d, "transmitters": len(recording.names)}
    sites = np.concatenate([recording.platforms[:1, 0, :d], recording.transmitters])
    return {"dimensions": d, "sites": tuple(map(tuple, sites.tolist()))}


def _crossing(recording: Any) -> dict[str, Any]:
    """Fields of a maneuvering target with the recording's stations.

    Raises:
        ValueError: one station, whose lines of sight never cross.
    """
    if len(recording.stations) < 2:
        raise ValueError(f"{recording.source}: has one station, a fix of crossing bearings needs two or more")
    return {"stations": len(recording.stations)}


FAMILIES = {
    "rp-ekf": Family(
        "rp_ekf", TRACKERS, read_bearings, BearingPlayback, _bearing_environment, lambda r: {"targets": _targets(r)}
    ),
    "angle-fusion": Family(
        "angle_pdaf", ANGLE_TRACKERS, read_angles, AnglePlayback, lambda r, t: "AngleFusion", lambda r: {}
    ),
    "imm-mie": Family(
        "imm_mie", MANEUVER_TRACKERS, read_azimuths, FixPlayback, lambda r, t: "ManeuveringTarget", _crossing
    ),
    "passive-radar": Family(
        "ekf", RANGE_SUM_TRACKERS, read_range_sums, SumPlayback, lambda r, t: "PassiveRadar", _pool
    ),
}  # fmt: skip
"""Kinds of recordings by the name of their tracker."""


def track_names() -> list[str]:
    """Names that a tracker goes by: the families', then those of all trackers."""
    return [*FAMILIES, *(name for family in FAMILIES.values() for name in family.trackers)]


def find_family(tracker: str) -> tuple[str, str]:
    """A family's name and the tracker's own, by either.

    Raises:
        ValueError: a name that nobody has, with the nearest one.
    """
    if tracker in FAMILIES:
        return tracker, FAMILIES[tracker].usual
    name = tracker.replace("-", "_")
    for title, family in FAMILIES.items():
        if name in family.trackers:
            return title, name
    near = difflib.get_close_matches(tracker, track_names(), n=1, cutoff=0.4)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    raise ValueError(f"--tracker {tracker!r}: must be one of {', '.join(track_names())}{hint}")


def open_playback(
    file: str | Path, tracker: str, environment: str | None = None, fields: Mapping[str, Any] | None = None,
    reference: str | None = None, origin: Sequence[float] | None = None, guess: Sequence[float] | None = None,
) -> tuple[str, Playback]:  # fmt: skip
    """A recording in front of its tracker; arguments as of `run`.

    Returns:
        name of the environment whose scenario is used, and the playback.
    """
    title, name = find_family(tracker)
    family, fields = FAMILIES[title], dict(fields or {})
    if "tracker" in fields:
        raise ValueError(f"tracker={fields['tracker']!r} among the fields: --tracker says which one runs")
    recording = family.read(sample_path(title) if str(file) == SAMPLE else file, origin)
    if hasattr(recording, "reordered"):
        recording = _with_reference(recording, reference, first=title == "angle-fusion")
    elif reference is not None:
        raise ValueError("--reference: is not used, ranges count from the receiver; leave it out")
    start = _guess(title, guess, str(file) == SAMPLE, recording)
    fitting = family.environment(recording, name)
    environment = scenario_name(environment or fitting)
    _check_environment(environment, fitting)
    own = family.fields(recording)
    _check_fields(fields, own)
    scenario = make_scenario(environment, {"step_s": usual_step_s(recording)} | own | fields | {"tracker": name})
    more = () if start is None else (start,)
    return environment, family.playback(scenario, recording, *more)


def usual_step_s(recording: Any) -> float:
    """The median time between scans [s], in as few digits as the times' own rounding allows.

    Raises:
        ValueError: fewer than two scans, or a median that is no step of an environment.
    """
    if len(recording.time_s) < 2:
        raise ValueError(f"{recording.source}: has one scan, a track needs two or more")
    median = float(np.median(np.diff(recording.time_s)))
    rounding = 2.0 * np.spacing(np.abs(recording.time_s).max()) + 1e-12 * median
    shorter = (float(f"{median:.{digits}g}") for digits in range(1, 17))
    step_s = next((value for value in shorter if abs(value - median) <= rounding), median)
    if not 0.1 <= step_s <= 60.0:
        raise ValueError(
            f"{recording.source}: the median time between scans is {step_s:g} s, must lie in [0.1, 60]; thin the rows "
            "out, or check the unit of time"
        )
    return step_s


def _with_reference(recording: Any, reference: str | None, first: bool) -> Any:
    """The recording with its reference station, by default the family's usual one, at the family's place."""
    names = recording.stations
    if reference is None:
        return recording
    if reference not in names:
        raise ValueError(f"--reference {reference!r}: must be one of the stations {', '.join(names)}")
    others = [name for name in names if name != reference]
    return recording.reordered([reference, *others] if first else [*others, reference])


def _check_environment(name: str, fitting: str) -> None:
    """Refuse an environment of another family."""
    mine, wanted = type(make_scenario(name, {})), type(make_scenario(fitting, {}))
    if mine is not wanted:
        raise ValueError(
            f"--environment {name}: is no environment for this recording, whose tracker runs in passive/{fitting}-v0"
        )


def _check_fields(fields: Mapping[str, Any], own: Mapping[str, Any]) -> None:
    """Refuse fields that the recording tells otherwise.

    Args:
        fields: the user's; own: the recording's.
    """
    if "sites" in fields:
        raise ValueError("sites among the fields: the recording says where they are; leave it out")
    for name, value in own.items():
        if fields.get(name, value) != value:
            raise ValueError(f"{name}={fields[name]!r} among the fields: the recording says {value!r}; leave it out")


def _guess(title: str, guess: Sequence[float] | None, sample: bool, recording: Any) -> np.ndarray | None:
    """The state [2d] that a track on range sums starts from; None of other families.

    Raises:
        ValueError: no guess, one of another length, or one that is not used.
    """
    if title != "passive-radar":
        if guess is not None:
            raise ValueError("--guess: is not used, tracks on directions start without one; leave it out")
        return None
    told = SAMPLE_GUESS if guess is None and sample else guess
    d = recording.transmitters.shape[1]
    places = "east, north" if d == 2 else "east, north, up"
    words = f"must be {2 * d} numbers, {places} [m] and their velocities [m/s] of the target at the first scan"
    if told is None:
        raise ValueError(f"--guess: range sums need one to start from; {words}")
    if len(told) != 2 * d or not np.isfinite(told).all():
        raise ValueError(f"--guess {' '.join(map(str, told))}: {words}")
    return np.asarray(told, dtype=float)


# -- the job -----------------------------------------------------------------------------------------------------------


def run(
    file: str | Path, tracker: str, out: Path, policy: str | None = None, environment: str | None = None,
    fields: Mapping[str, Any] | None = None, reference: str | None = None, origin: Sequence[float] | None = None,
    guess: Sequence[float] | None = None,
) -> Track:  # fmt: skip
    """Track a recording, write its files and print what was found.

    Args:
        file: recording, or `SAMPLE`.
        tracker: name of a family or of one of its trackers.
        out: folder.
        policy: whose advice is wanted: a name, a run folder or a packed file; None: nobody's.
        environment: whose settings are used; None: the one that fits.
        fields: scenario keywords.
        reference: station from which ranges count.
        origin: of the frame of places on the earth, latitude, longitude [deg], height [m].
        guess: state of a passive radar's target at the first scan.
    Raises:
        ValueError, OSError: bad input; nothing has been written then.
    """
    name, playback = open_playback(file, tracker, environment, fields, reference, origin, guess)
    pilot = None if policy is None else _pilot(policy, name, playback)
    make_folder(out)
    track = follow(playback, pilot)
    write_text(out / "track.csv", track_csv(track))
    told = {"environment": f"passive/{name}-v0", "tracker": playback.scenario.tracker, "policy": policy}
    write_json(out / "track.json", told | summary(track))
    save_figure(out / "track.png", track_picture(track))
    save_figure(out / "fit.png", fit_picture(track))
    print(_words(track))
    if pilot is not None:
        write_text(out / "advice.csv", advice_csv(track))
        print(f"\nnext maneuver, by {policy}:\n{advice_table(track)}")
    print(f"\n{out}")
    return track


def follow(playback: Playback, pilot: Any = None) -> Track:
    """A tracker's whole way through a recording, with a policy's commands at every instant if there is one."""
    moments, commands = [], []
    for moment in playback.moments():
        if pilot is not None:
            belief = playback.belief(moment.world)
            if not moments:
                pilot.reset(belief)
            commands.append(np.array(pilot.act(belief, playback.observe(belief))[0], dtype=float))
        moments.append(moment)
    return Track(playback, moments, np.array(commands))


def _pilot(policy: str, name: str, playback: Playback) -> Any:
    """A policy that can steer the recording's platforms.

    Raises:
        ValueError: an unknown policy, one of another environment, one that looks at the truth, or a recording of
            another number of stations or targets than the environment has.
    """
    scenario = playback.scenario
    stations = len(playback.recording.stations)
    if stations != scenario.stations:
        raise ValueError(
            f"--policy {policy}: policies of passive/{name}-v0 steer {scenario.stations} stations, the recording has "
            f"{stations}"
        )
    pilot = named_policy(policy, name, scenario)
    if sees_world(pilot):
        raise ValueError(f"--policy {policy}: looks at the truth, which a recording does not have; choose another")
    return pilot


def _words(track: Track) -> str:
    """What was found, in a few lines."""
    told = summary(track)
    lines = [
        f"{told['file']}: {told['instants']} instants in {told['duration_s']:g} s, stations "
        f"{', '.join(told['stations'])}; {told['tracks']} track{'s' * (told['tracks'] > 1)} from "
        f"{told['start_s']:g} s on, step {told['step_s']:g} s"
    ]
    if told["missing_scans"]:
        lines.append(f"missing scans bridged: {told['missing_scans']}")
    for j, end in enumerate(told["final"]):
        east, north = end["mean"][:2]
        lines.append(
            f"track {j + 1}: range {end['range_m'] / 1e3:.2f} ± {end['range_std_m'] / 1e3:.2f} km, "
            f"bearing {end['bearing_deg']:.1f}°, east {east / 1e3:.2f} km, north {north / 1e3:.2f} km, "
            f"speed {math.hypot(*end['mean'][end['dimensions'] :]):.0f} m/s; "
            f"mean NIS per degree of freedom {end['nis_per_degree']:.2f}"
        )
    return "\n".join(lines)
