"""The command ``passive-env``: train, evaluate and all that comes before and after."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from passive_env.extras import MissingExtra
from passive_env.scenario import parse_fields

HELD_OUT = "held-out"


@dataclass(frozen=True)
class Train:
    """Train a policy, then compare it with the fixed geometries and rules on simulated courses and held-out flights.

    The run folder receives the model, the resolved configuration, checkpoints, TensorBoard logs, evaluation.json, .csv,
    .md and pictures, the same for recorded flights under flights/, and all of it on one page, report.html.
    """

    env: str = "passive/TwoStation-v0"
    """Environment id (see `passive-env list`)."""
    algo: str = "ppo"
    """Learning algorithm: ppo (begins as a rule or a teacher's imitation, as its preset says), ppo_long (the same with
    more time, where its preset says so), ppo_scratch (begins with nothing), recurrent_ppo (LSTM),
    sac, or bound_gradient (down the bound's own slope; MobilePlacement with actions=velocities only)."""
    timesteps: int | None = None
    """Environment steps to train for; default from the preset."""
    seed: int = 0
    """Seed of training."""
    envs: int | None = None
    """Environments stepped at once; default from the preset."""
    device: str = "cpu"
    """torch device: cpu, cuda or auto. Networks this small train fastest on the CPU."""
    out: Path | None = None
    """Run folder; default runs/ENV-ALGO-sSEED, numbered if it exists."""
    resume: bool = False
    """Go on with the run in --out from its last checkpoint."""
    episodes: int = 1000
    """Episodes of the final evaluation."""
    fields: tuple[str, ...] = ()
    """Scenario keywords, in training and evaluation: NAME=VALUE …, such as steps=40 tracker=rp_ekf_adaptive."""
    flights: str = HELD_OUT
    """Recorded flights of the final evaluation: a CSV file, or 'held-out' for the test part of the shipped ones."""
    engine: Literal["sb3", "rllib"] = "sb3"
    """What trains: Stable-Baselines3 in this process, or RLlib's PPO with processes that fly (extra `ray`)."""
    runners: int | None = None
    """With --engine rllib: how many processes fly; default 2."""
    address: str | None = None
    """With --engine rllib: a running Ray cluster, HOST:PORT or auto; default one on this machine, for this run."""


@dataclass(frozen=True)
class Evaluate:
    """Compare policies on the same random numbers and write tables, pictures and a page of both, report.html."""

    env: Annotated[str, tyro.conf.Positional] = "passive/TwoStation-v0"
    """Environment id."""
    policies: tuple[str, ...] | None = None
    """Policy names (see `passive-env list`), run folders made by train, files FILE.npz made by pack and FILE.onnx made
    by export; default all the environment offers, `pretrained` where it can fly, and not the oracle, which looks at the
    truth."""
    trackers: tuple[str, ...] = ()
    """Trackers to cross with the policies; default the scenario's own."""
    episodes: int = 1000
    """Paired episodes."""
    seed: int = 30_000_000
    """Seed of the first episode."""
    fields: tuple[str, ...] = ()
    """Scenario keywords: NAME=VALUE …, such as bearing_std_deg=1 tracker=rp_ekf_adaptive."""
    flights: str | None = None
    """Let targets fly recorded traffic: a CSV file, or 'held-out' for the test part of the shipped one."""
    out: Path = Path("evaluation")
    """Folder for evaluation.json, .csv, .md, pictures and report.html."""
    engine: Literal["local", "processes", "ray"] = "local"
    """Where episodes are flown: in this process, in others of this machine, or by the workers of Ray (extra `ray`);
    results are the same."""
    workers: int | None = None
    """With --engine processes or ray: how many blocks are flown at once; default all cores."""
    address: str | None = None
    """With --engine ray: a running cluster, HOST:PORT or auto; default one on this machine, for this command."""


@dataclass(frozen=True)
class Replay:
    """Show policies side by side in one episode: a page for any browser, which needs no network, or an animation."""

    env: Annotated[str, tyro.conf.Positional] = "passive/TwoStation-v0"
    """Environment id."""
    policies: tuple[str, ...] | None = None
    """Policy names (see `passive-env list`), run folders made by train, files FILE.npz made by pack and FILE.onnx made
    by export; `learned` is the pretrained one. Default the fixed geometry, the rule and the pretrained policy."""
    seed: int = 0
    """Seed of the episode."""
    out: Path = Path("replay.html")
    """The page."""
    gif: Path | None = None
    """Besides: an animation FILE.gif."""
    mp4: Path | None = None
    """Besides: an animation FILE.mp4 (needs ffmpeg)."""
    flights: str | None = None
    """Let targets fly recorded traffic: a CSV file, or 'held-out' for the test part of the shipped one."""
    fields: tuple[str, ...] = ()
    """Scenario keywords: NAME=VALUE …, such as steps=40 targets=1."""


@dataclass(frozen=True)
class Leaderboard:
    """Compare all policies in all environments, on drawn courses and held-out recorded flights.

    Finished cells (a policy in a scenario) are kept in --out and used again where nothing that decides them has
    changed, so an interrupted run goes on where it was. Writes leaderboard.json, .csv, .md, .png and verdicts.csv.
    """

    envs: tuple[str, ...] = ()
    """Environment ids; default all."""
    policies: tuple[str, ...] = ()
    """Policy names (see `passive-env list`); default all that an environment offers, the oracle included."""
    runs: tuple[str, ...] = ()
    """Learned policies besides the pretrained ones: ENV=RUN …, run folders made by train or files made by pack."""
    episodes: int = 500
    """Paired episodes of every cell."""
    seed: int = 90_000_000
    """Seed of the first episode."""
    flights: bool = True
    """Whether held-out recorded flights are flown too."""
    trackers: bool = False
    """Add the tables of trackers crossed with policies."""
    generalisation: bool = False
    """Add the tables of circumstances that learned policies were not trained in."""
    confirm: int = 0
    """Judge on so many further episodes, which did not choose the best of each kind; 0: on the same ones."""
    full: bool = False
    """All of these, as docs/leaderboard.md has it: --trackers --generalisation --confirm 2000."""
    fields: tuple[str, ...] = ()
    """Scenario keywords of all environments named: NAME=VALUE …"""
    out: Path = Path("leaderboard")
    """Folder of the results and of the cells kept."""
    engine: Literal["local", "processes", "ray"] = "processes"
    """Where episodes are flown: in this process, in others of this machine, or by the workers of Ray (extra `ray`);
    results are the same."""
    workers: int | None = None
    """With --engine processes or ray: how many blocks are flown at once; default all cores."""
    address: str | None = None
    """With --engine ray: a running cluster, HOST:PORT or auto; default one on this machine, for this command."""


@dataclass(frozen=True)
class Pack:
    """Pack a run's policy into one file without code, with a model card (.md) and the figures it reached (.json)."""

    run: Annotated[Path, tyro.conf.Positional]
    """Run folder made by train."""
    out: Path
    """FILE.npz."""
    evaluation: Path | None = None
    """evaluation.json of this run beside rules, for the card; the run's model flies its episodes again and must reach
    the same. Default: fly one now, of fixed policies, rules and greedy ones."""
    episodes: int = 1000
    """Episodes of that evaluation."""
    seed: int = 90_000_000
    """Its first episode's seed, and the record's."""


@dataclass(frozen=True)
class Export:
    """Write a policy as an ONNX file for other runtimes and languages, with what it was made for inside."""

    policy: Annotated[str, tyro.conf.Positional]
    """Run folder made by train, file made by pack, or the id of an environment whose pretrained policy is meant."""
    onnx: Path
    """FILE.onnx."""


@dataclass(frozen=True)
class Track:
    """Run a tracker on recorded measurements, and print what a policy would do next.

    The file has a row per time, station and return, with the platforms' places (docs/track.md lists the columns).
    """

    file: Annotated[Path, tyro.conf.Positional]
    """CSV file, or 'sample' for the one of this tracker that comes with the package."""
    tracker: str
    """rp-ekf, angle-fusion, imm-mie or passive-radar, or the name of any tracker (see `passive-env list`)."""
    out: Path = Path("track")
    """Folder for track.csv, track.json, track.png, fit.png and, with --policy, advice.csv."""
    policy: str | None = None
    """Policy name, run folder made by train, file made by pack or export: what it would do next is printed for every
    instant."""
    environment: str | None = None
    """Environment id whose settings and policies are used; default the one that fits the recording."""
    fields: tuple[str, ...] = ()
    """Scenario keywords: NAME=VALUE …, such as bearing_std_deg=1 process_noise_m_s=5 step_s=2."""
    reference: str | None = None
    """Station from which ranges count; default the last one in the file, with azimuth and elevation the first."""
    origin: tuple[float, ...] | None = None
    """Files with latitudes: latitude, longitude [deg] and height [m] of the plane's origin; default the first place."""
    guess: tuple[float, ...] | None = None
    """Range sums: the target's place [m] and velocity [m/s] at the first scan, east and north, in space also up."""


@dataclass(frozen=True)
class Reproduce:
    """Run a paper's experiments and print its claims beside ours; `all` writes one report of all papers."""

    paper: Annotated[
        Literal["two-station", "angle-fusion", "imm-mie", "radar-placement", "passive-radar", "all"],
        tyro.conf.Positional,
    ] = "two-station"
    """Which paper, or all."""
    runs: int | None = None
    """Monte-Carlo runs per seed; default 500 (angle-fusion, radar-placement) or 50 (the others)."""
    seeds: tuple[int, ...] = (0, 1, 2, 3)
    """Seeds; scores are averaged over them."""
    out: Path | None = None
    """Folder for reproduction.json, .md and pictures; for all: papers.md, papers.html and a folder per paper. Finished
    papers are kept, so an interrupted run goes on with the next one."""


@dataclass(frozen=True)
class Curves:
    """Draw learning curves of several runs of one environment: median and range over their seeds."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Run folders made by train; they may differ by their seed only."""
    out: Path = Path("curves.png")
    """Picture; a .csv file of the same name receives the numbers."""


@dataclass(frozen=True)
class Benchmark:
    """Measure speed: kernels, environments and training, beside other libraries where they are installed."""

    out: Path | None = None
    """Folder for benchmark.json and .md."""
    quick: bool = False
    """Shorter measurements, for a check that it runs."""


@dataclass(frozen=True)
class Compile:
    """Compile all kernels now, on all cores, instead of each at its first use."""

    processes: int | None = None
    """How many compile at once; default all cores."""


@dataclass(frozen=True)
class List:
    """List environments, policies and trackers."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status: 2 for bad input, 1 for a paper that failed; why is on standard error."""
    commands = {name: command for name, (command, _) in COMMANDS.items()}
    command = tyro.extras.subcommand_cli_from_dict(commands, args=arguments, prog="passive-env", description=__doc__)
    return _guarded(command)


def train_main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of train.py: the same as ``passive-env train``."""
    return _guarded(tyro.cli(Train, args=arguments, prog="train.py"))


def _guarded(command: Any) -> int:
    (runner,) = (runner for kind, runner in COMMANDS.values() if kind is type(command))
    try:
        status = runner(command)
    except (ValueError, TypeError, OSError, MissingExtra) as error:
        print(f"passive-env: {error}", file=sys.stderr)
        return 2
    return status or 0


def _train(c: Train) -> None:
    from agents.main_job import train_and_compare

    train_and_compare(
        c.env, c.algo, c.timesteps, c.seed, c.envs, c.device, c.out, c.resume, c.episodes, c.flights,
        parse_fields(c.fields), _runners(c), c.address,
    )  # fmt: skip


def _runners(c: Train) -> int:
    """Processes that fly for RLlib; 0 for Stable-Baselines3.

    Raises:
        ValueError: not a positive number of them, or what only RLlib takes.
    """
    if c.engine == "sb3":
        for flag, value in (("--runners", c.runners), ("--address", c.address)):
            if value is not None:
                raise ValueError(f"{flag} {value}: is for --engine rllib only")
        return 0
    runners = 2 if c.runners is None else c.runners
    if runners < 1:
        raise ValueError(f"--runners {runners}: must be at least 1")
    return runners


def _evaluate(c: Evaluate) -> None:
    from agents.distributed import engine_named
    from agents.main_job import compare

    engine = engine_named(c.engine, c.workers, c.address)
    compare(c.env, c.policies, c.trackers, c.episodes, c.seed, c.flights, c.out, parse_fields(c.fields), engine)


def _replay(c: Replay) -> None:
    from agents.replay_job import replay

    fields = parse_fields(c.fields)
    for path in replay(c.env, c.policies, c.seed, c.out, c.gif, c.mp4, c.flights, fields):
        print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")


def _leaderboard(c: Leaderboard) -> None:
    from agents.distributed import engine_named
    from agents.leaderboard import FULL_CONFIRM, leaderboard

    confirm = c.confirm or (FULL_CONFIRM if c.full else 0)
    leaderboard(
        c.envs, c.policies, c.runs, c.episodes, c.seed, c.flights, c.trackers or c.full, c.generalisation or c.full,
        confirm, c.out, parse_fields(c.fields), engine=engine_named(c.engine, c.workers, c.address),
    )  # fmt: skip


def _pack(c: Pack) -> None:
    from agents.pack import pack

    record = pack(c.run, c.out, c.evaluation, c.episodes, c.seed)
    print(f"{c.out}: {record['bytes']} bytes\n\n{c.out.with_suffix('.md').read_text(encoding='utf-8')}")


def _export(c: Export) -> None:
    from agents.export import export

    actor = export(c.policy, c.onnx)
    print(f"{c.onnx}: {c.onnx.stat().st_size} bytes, for {actor.description['environment']}")


def _track(c: Track) -> None:
    from agents.track import run

    run(
        c.file, c.tracker, c.out, c.policy, c.environment, parse_fields(c.fields), c.reference, c.origin, c.guess
    )  # fmt: skip


def _reproduce(c: Reproduce) -> int:
    from agents.reproduction import PAPERS

    if c.paper == "all":
        return _reproduce_all(c)
    paper = PAPERS[c.paper]
    number = {} if c.runs is None else {"runs": c.runs}
    print(paper.words(paper.reproduce(**number, seeds=c.seeds, out=c.out)))
    return 0


def _reproduce_all(c: Reproduce) -> int:
    """Returns 1 if a paper failed."""
    from agents.reproduction.together import reproduce_all, summary_table

    if c.out is None:
        raise ValueError("reproduce all: needs --out DIR, the folder of the report")
    parts = reproduce_all(c.out, c.runs, c.seeds)
    print(f"{summary_table(parts)}\n\n{c.out / 'papers.md'}\n{c.out / 'papers.html'}")
    for part in parts:
        if part.failure:
            print(f"passive-env: {part.paper.name}: not computed, {part.failure}", file=sys.stderr)
    return int(any(part.failure for part in parts))


def _curves(c: Curves) -> None:
    from agents.curves import draw_curves

    for path in draw_curves(c.runs, c.out):
        print(path)


def _benchmark(c: Benchmark) -> None:
    from agents.benchmark import run_benchmark

    run_benchmark(c.out, c.quick)


def _compile(c: Compile) -> None:
    from agents.compile_ahead import compile_all

    print(f"all kernels are compiled: {compile_all(c.processes)}")


def _list(c: List) -> None:
    from agents.algorithms import ALGORITHMS
    from agents.policy import policy_names
    from agents.pretrained import PRETRAINED, pretrained_ids
    from passive_env.catalogue import SCENARIOS, environment_id, environment_ids
    from trackers import ANGLE_TRACKERS, MANEUVER_TRACKERS, RANGE_SUM_TRACKERS, TRACKERS

    trained = {environment: [PRETRAINED] for environment in pretrained_ids()}
    offered = {
        environment_id(name): policy_names(scenario) + trained.get(environment_id(name), [])
        for name, scenario in SCENARIOS.items()
    }
    for title, names in (
        ("environments", environment_ids()),
        *((f"policies of {environment}", names) for environment, names in offered.items()),
        ("trackers", list(TRACKERS)),
        ("trackers of azimuth and elevation", list(ANGLE_TRACKERS)),
        ("trackers of a maneuvering target", list(MANEUVER_TRACKERS)),
        ("trackers on range sums", list(RANGE_SUM_TRACKERS)),
        ("algorithms", list(ALGORITHMS)),
    ):
        print(f"{title}: {', '.join(names)}")


COMMANDS: dict[str, tuple[Any, Any]] = {
    "train": (Train, _train),
    "evaluate": (Evaluate, _evaluate),
    "replay": (Replay, _replay),
    "leaderboard": (Leaderboard, _leaderboard),
    "pack": (Pack, _pack),
    "export": (Export, _export),
    "track": (Track, _track),
    "reproduce": (Reproduce, _reproduce),
    "curves": (Curves, _curves),
    "benchmark": (Benchmark, _benchmark),
    "compile": (Compile, _compile),
    "list": (List, _list),
}
"""Arguments and function of every command, by its name."""


if __name__ == "__main__":
    sys.exit(main())
