"""README, CONTRIBUTING and docs/: code runs, commands parse or run, messages are real, links lead somewhere."""

import re
import shlex
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import tyro
from markdown_tables import tables

from agents import cli
from agents.documentation import GENERATED, documents
from agents.parameter_sharing import Sharing
from agents.pretrained import PRETRAINED
from agents.replay import plotly_script
from agents.reproduction.angle_fusion import run_trials
from agents.reproduction.angle_fusion.claims import all_claims
from agents.reproduction.report import ORIGINS, VERDICTS, of_origin
from passive_env import distribution
from passive_env.catalogue import environment_ids, make_scenario
from passive_env.rewards import TERMS

ROOT = Path(__file__).parents[1]
DOCUMENTS = documents(ROOT)
MESSAGES = ROOT / "docs" / "faq.md"
START = ROOT / "docs" / "start.md"

LANGUAGES = ("python", "sh", "text", "math")
"""Python runs (that of the messages must fail as its text says), sh is the newcomer's path, math is no code."""

OTHER_COMMANDS = (
    "python -m pip install -e . && python train.py",  # .ci/jobs: the main job, short
    'python -m pip install -e ".[test]" && python -m pytest',  # .ci/run, to the letter
    "bash .ci/run",  # by whoever lands a change
    "python -m pytest tests/test_world.py",  # any test run
    "python -m agents.documentation",  # test_documentation.py: it changes nothing
    "mkdocs build --strict",  # .ci/checks
)
"""Commands in documents besides our own, and who runs them. Any may install an extra that pyproject.toml has."""

SHARING = "python -m agents.parameter_sharing "
"""An example that trains for minutes: its commands are parsed here, tests/test_parameter_sharing.py runs short ones."""

EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]

RUN_HERE = ("evaluate", "list")
"""With two episodes, unless it names a run folder or a file; as it is."""

PARSED_ONLY = {
    "train": "minutes of training; .ci/jobs and the tests of training run short ones",
    "leaderboard": "hours; tests/test_leaderboard.py runs small ones",
    "reproduce": "minutes; tests of the reproductions run small ones",
    "compile": "minutes; .ci/run begins with it, tests/test_compile_ahead.py compiles two kernels",
    "benchmark": "a minute; .ci/jobs runs it with --quick",
    "pack": "needs a trained run; tests/test_packed.py",
    "curves": "needs several runs; tests/test_learning_curves.py",
    "replay": "a page of its own; tests/test_replay.py",
    "track": "needs a recording; tests/test_track.py runs all samples",
    "export": "needs a trained run; tests/test_onnx.py",
}
"""Commands that are parsed and not run here, and why."""


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


def fences(document: Path) -> list[tuple[str, str, bool]]:
    """Language, content, and whether it goes on where the fence before ended, of every fenced block."""
    found = re.findall(
        r"^(<!-- continues -->\n)?```(\w*)\n(.*?)^```$", document.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
    )
    return [(language, content, bool(goes_on)) for goes_on, language, content in found]


def python_blocks(document: Path) -> list[str]:
    """Python blocks; one that goes on contains those before it."""
    blocks: list[str] = []
    for language, content, goes_on in fences(document):
        if language == "python":
            blocks.append(blocks.pop() + content if goes_on else content)
    return blocks


def indented(document: Path) -> list[str]:
    """Indented lines of a document, fences left out."""
    text = re.sub(r"^```.*?^```$", "", document.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    return re.findall(r"^ {4}(\S.*)$", text, re.MULTILINE)


def commands(document: Path) -> list[str]:
    """Arguments of our own command: indented lines, shell fences, and table cells that begin with it."""
    text = document.read_text(encoding="utf-8")
    lines = [line for language, content, _ in fences(document) if language == "sh" for line in content.splitlines()]
    lines += [*indented(document), *re.findall(r"^\| `([^`\n]+)`", text, re.MULTILINE)]
    return [line.removeprefix("passive-env ") for line in lines if line.startswith("passive-env ")]


WITH_PYTHON = [document for document in DOCUMENTS if document != MESSAGES and python_blocks(document)]
WITH_COMMANDS = [document for document in DOCUMENTS if commands(document)]


@pytest.fixture
def registries():
    """Reward terms and environments that an example adds are taken away again."""
    terms, environments = dict(TERMS), dict(gym.registry)
    yield
    for registry, before in ((TERMS, terms), (gym.registry, environments)):
        registry.clear()
        registry.update(before)


def missing_extras(document: Path) -> list[str]:
    """Extras whose installation a document tells and of which a package is not installed."""
    told = re.findall(r'^    python -m pip install "passive-env\[(\w+)\]"', document.read_text(encoding="utf-8"), re.M)
    return [extra for extra in told if not all(installed(each) for each in EXTRAS[extra])]


def installed(requirement: str) -> bool:
    """Whether some version of a required distribution is there."""
    try:
        return bool(metadata.version(re.split(r"[^\w.-]", requirement)[0]))
    except metadata.PackageNotFoundError:
        return False


@pytest.mark.parametrize("document", WITH_PYTHON, ids=name_of)
def test_python_blocks_run(document, capsys, registries):
    if missing := missing_extras(document):
        pytest.skip(f"needs the extra {', '.join(missing)}")
    for block in python_blocks(document):
        exec(compile(block, str(document), "exec"), {"__name__": "example"})
    assert capsys.readouterr().out


@pytest.mark.parametrize("document", DOCUMENTS, ids=name_of)
def test_no_code_is_left_out(document):
    """Every fence has a language that some test knows, every indented command is ours or named above."""
    assert {language for language, *_ in fences(document)} <= set(LANGUAGES)
    assert all(document == START for language, *_ in fences(document) if language == "sh")
    words = ("python ", "pip ", "bash ", "mkdocs ", "git ", "export ")
    others = [line for line in indented(document) if line.startswith(words) and line not in OTHER_COMMANDS]
    others = [line for line in others if not line.startswith(SHARING)]
    extras = [re.fullmatch(r'python -m pip install (?:-e )?"(?:passive-env|\.)\[(\w+)\]"', line) for line in others]
    assert [line for line, extra in zip(others, extras, strict=True) if not (extra and extra[1] in EXTRAS)] == []


@pytest.mark.parametrize("document", WITH_COMMANDS, ids=name_of)
def test_commands_parse(document, monkeypatch):
    parsed = []
    monkeypatch.setattr(cli, "_guarded", lambda command: parsed.append(command) or 0)
    for line in commands(document):
        assert cli.main(shlex.split(line, comments=True)) == 0
    for command in parsed:
        assert getattr(command, "env", environment_ids()[0]) in environment_ids()


def test_commands_of_the_example_with_several_agents_parse():
    lines = [line for document in DOCUMENTS for line in indented(document) if line.startswith(SHARING)]
    assert lines
    for line in lines:
        assert tyro.cli(Sharing, args=shlex.split(line.removeprefix(SHARING))).out


def test_every_command_is_run_or_says_why_not():
    """A new command gets a place in RUN_HERE or, with the reason, in PARSED_ONLY."""
    named = {line.split()[0] for document in WITH_COMMANDS for line in commands(document)}
    assert named - {*RUN_HERE, *PARSED_ONLY} == set()


def runnable(line: str) -> bool:
    """Whether a command is run here: lists, and evaluations of policies that need no run folder and no cluster."""
    words = shlex.split(line, comments=True)
    if "ray" in words:
        return False  # tests/test_ray.py
    if words[0] != "evaluate" or "--policies" not in words:
        return words[0] in RUN_HERE
    after = words[words.index("--policies") + 1 :]
    stop = next((i for i, word in enumerate(after) if word.startswith("--")), len(after))
    return all(re.fullmatch(r"\w+", name) and name != "RUNDIR" for name in after[:stop])


RUNNABLE = sorted({line for document in WITH_COMMANDS for line in commands(document) if runnable(line)})


@pytest.mark.parametrize("line", RUNNABLE)
def test_short_commands_run(line, tmp_path, capsys):
    """Two episodes in place of a thousand; everything else as it is written."""
    words = shlex.split(line, comments=True)
    if words[0] == "evaluate":
        words += ["--episodes", "2", "--out", str(tmp_path)]
    assert cli.main(words) == 0, capsys.readouterr().err
    assert words[0] == "list" or (tmp_path / "evaluation.md").is_file()


def newcomer() -> list[str]:
    """Commands of the first fence of docs/start.md."""
    (path,) = (content for language, content, _ in fences(START) if language == "sh")
    return path.splitlines()


def test_newcomers_path_is_short_and_run_as_written():
    """.ci/newcomer runs these very lines; here only that it reads them from the same fence."""
    assert 3 <= len(newcomer()) <= 6
    assert any("train" in line for line in newcomer())
    assert "docs/start.md" in (ROOT / ".ci" / "newcomer").read_text(encoding="utf-8")
    assert ".ci/newcomer" in (ROOT / ".ci" / "jobs").read_text(encoding="utf-8")


@pytest.mark.parametrize("document", DOCUMENTS, ids=name_of)
def test_links_and_pictures_exist(document):
    """Pages that the site takes from the root are linked to by their names there."""
    from_root = {"contributing.md": ROOT / "CONTRIBUTING.md", "changelog.md": ROOT / "CHANGELOG.md"}
    text = re.sub(r"^```.*?^```$", "", document.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    for target in re.findall(r"\]\(([^)#]+)", text):
        place = document.parent / target
        if place.parent.resolve() == ROOT / "docs":
            place = from_root.get(place.name, place)
        assert target.startswith("https://") or place.is_file(), target


def test_every_page_stands_in_the_navigation():
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:\n")[2]
    pages = [str(page.relative_to(ROOT / "docs")) for page in DOCUMENTS if page.parent != ROOT]
    assert [page for page in pages if not re.search(rf"[ :-] {re.escape(page)}$", navigation, re.MULTILINE)] == []


def test_readme_names_every_environment_and_keeps_its_two_commands():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert [name for name in environment_ids() if f"`{name}`" not in text] == []
    assert "\n    python -m pip install -e . && python train.py\n" in text
    assert '\n    python -m pip install -e ".[test]" && python -m pytest\n' in text


# -- messages --------------------------------------------------------------------------------------------------------


def messages() -> list[tuple[str, str, str]]:
    """Heading, code ("" where the test below supplies it) and message of every entry that has one."""
    entries = []
    for part in MESSAGES.read_text(encoding="utf-8").split("\n## ")[1:]:
        code = re.search(r"^```python\n(.*?)^```$", part, re.DOTALL | re.MULTILINE)
        message = re.search(r"^```text\n(.*?)\n```$", part, re.DOTALL | re.MULTILINE)
        if message:
            entries.append((part.partition("\n")[0], code[1] if code else "", message[1]))
    return entries


def clash_of_names(monkeypatch) -> None:
    """As if another distribution's `trackers` had been installed over ours."""
    monkeypatch.setattr(distribution, "_is_ours", lambda name: name != "trackers")
    monkeypatch.setattr(distribution, "_installed", lambda rival: rival == "trackers")
    distribution.check_names()


def missing_extra(monkeypatch) -> None:
    """As if plotly had not been installed."""
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    plotly_script()


STAGED = {
    "Another package of the same name is in the way": clash_of_names,
    "An extra is not installed": missing_extra,
}
"""Messages of circumstances that a block cannot bring about."""


@pytest.mark.parametrize(("heading", "code", "message"), messages(), ids=[heading for heading, *_ in messages()])
def test_messages_are_what_is_raised(heading, code, message, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    bring_about = STAGED.get(heading) or (lambda _: exec(compile(code, str(MESSAGES), "exec"), {"__name__": "example"}))
    with pytest.raises(Exception) as raised:
        bring_about(monkeypatch)
    said = f"{type(raised.value).__name__}: {raised.value}"
    assert re.fullmatch(".*".join(map(re.escape, message.split("…"))), said), said
    assert list(tmp_path.iterdir()) == []  # nothing was changed before it


def test_messages_are_many():
    assert len(messages()) >= 15


def test_angle_fusion_claims_are_those_the_reproduction_judges():
    """Claim by claim, by origin; the numbers behind the verdicts are what a run prints."""
    bare = re.compile(r"[\d.]+ (?=validated)|\([\d.]+ ?%?\)")
    records = run_trials(2, (0,))
    judged = all_claims(records, np.random.default_rng(0))
    text = (ROOT / "docs" / "angle_fusion.md").read_text(encoding="utf-8")
    for origin in ORIGINS:
        head = ["claim", origin, "ours", "95 % interval", "verdict"]
        (shown,) = (rows for names, *rows in tables(text) if names == head)
        assert [bare.sub("", row[0]) for row in shown] == [bare.sub("", c["claim"]) for c in of_origin(judged, origin)]
        assert {row[-1] for row in shown} <= set(VERDICTS)


def test_documents_name_policies_that_exist():
    """In the tables of baselines every policy is one the environment offers."""
    from agents.policy import policy_names

    for page in sorted((ROOT / "docs" / "environments").glob("*.md")):
        text = page.read_text(encoding="utf-8")
        name = re.search(r"passive/(\w+)-v0", text)
        assert name
        (block,) = (found[0] for found in GENERATED.finditer(text) if found[1] == "baselines")
        shown = [row[0].strip("`") for row in tables(block)[0][1:]]
        assert set(shown) <= {*policy_names(make_scenario(name[1], {})), PRETRAINED, "bound"}
