"""`passive-env reproduce all`: one report of all papers, its HTML, kept parts, papers that fail."""

import base64
import json
import re
import tomllib
import typing
from collections import Counter
from pathlib import Path

import pytest
from html_page import Page
from markdown_tables import tables
from matplotlib.figure import Figure

from agents import cli
from agents.page import as_page
from agents.reproduction import PAPERS, together
from agents.reproduction.report import (
    COUNTED,
    HEADS,
    ORIGINS,
    PAPER,
    SPEC,
    VERDICTS,
    Paper,
    claim,
    claim_cells,
    described,
    markdown_table,
    of_origin,
    words,
    write_reproduction,
)
from agents.reproduction.together import reproduce_all

ROOT = Path(__file__).parents[1]
OWN = {
    "two-station": {"3, Table 1": 8, "3": 2, "4": 4},
    "angle-fusion": {"5": 5},
    "imm-mie": {"4": 9, "abstract": 2},
    "radar-placement": {"3.1": 4, "3.2": 2, "5": 2},
    "passive-radar": {"3.1": 3, "3.2": 1, "3.4": 2},
}
"""How many claims rest on which part of the papers themselves, as read there; all others are cross-checks."""


# ------------------------------------------------------------------------------------------------ the papers themselves


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    out = tmp_path_factory.mktemp("all")
    return out, reproduce_all(out, runs=1, seeds=(0,), progress=False)


@pytest.fixture(scope="module")
def page(made):
    return Page((made[0] / "papers.html").read_text(encoding="utf-8"))


def summary(text: str, origin: str) -> list[list[str]]:
    (found,) = (rows for head, *rows in tables(text) if head == ["paper", COUNTED[origin], *VERDICTS])
    return found


def test_every_claim_of_every_paper_appears_once_with_one_of_three_marks(made, page):
    told = iter([rows for head, *rows in page.tables if head[0] == "no."])
    assert [part.paper.name for part in made[1]] == list(PAPERS)
    for part in made[1]:
        claims = part.result["claims"]
        cells = [[*map(words, claim_cells(c))] for origin in ORIGINS for c in of_origin(claims, origin)]
        assert [*next(told), *next(told)] == [[str(i), *row] for i, row in enumerate(cells, 1)]
        assert {row[0] for row in cells} <= set(VERDICTS)
        assert len({c["claim"] for c in claims}) == len(claims) == len(cells)
    assert next(told, None) is None


def test_columns_say_whose_statement_a_claim_is(page):
    heads = [head for head, *_ in page.tables if head[0] == "no."]
    assert [head[3] for head in heads] == ["paper", "specification"] * len(PAPERS)
    assert [head[-1] for head in heads] == ["section of the paper", "section of the specification"] * len(PAPERS)


def test_claims_of_the_authors_are_those_that_stand_in_their_papers(made):
    for part in made[1]:
        own = of_origin(part.result["claims"], PAPER)
        assert Counter(c["source"] for c in own) == OWN[part.paper.name]


@pytest.mark.parametrize("origin", ORIGINS)
def test_summary_counts_the_verdicts(made, origin):
    text = (made[0] / "papers.md").read_text(encoding="utf-8")
    *rows, total = summary(text, origin)
    for part, row in zip(made[1], rows, strict=True):
        verdicts = [c["verdict"] for c in part.result["claims"] if c["origin"] == origin]
        assert part.paper.subject in row[0]
        assert row[1:] == [str(len(verdicts)), *(str(verdicts.count(verdict)) for verdict in VERDICTS)]
        assert sum(map(int, row[2:])) == int(row[1])
    assert total[1:] == [str(sum(int(row[i]) for row in rows)) for i in range(1, 5)]


def test_headline_tells_the_authors_claims_first_and_the_cross_checks_apart(made):
    text = (made[0] / "papers.md").read_text(encoding="utf-8")
    (own, *ours), *_ = re.findall(r"^(\d+) claims of the papers' authors: (.*?)\. (\d+) cross-checks", text, re.M)
    assert [own, ours[-1]] == [summary(text, origin)[-1][1] for origin in ORIGINS]
    assert int(own) == sum(sum(sources.values()) for sources in OWN.values())
    assert text.index(HEADS[PAPER]) < text.index(HEADS[SPEC])


def test_times_are_the_processor_s_and_the_clock_s(made):
    text = (made[0] / "papers.md").read_text(encoding="utf-8")
    (rows,) = (rows for head, *rows in tables(text) if head == ["paper", "processor time [s]", "elapsed time [s]"])
    assert [row[0] for row in rows] == [*PAPERS, "all"]
    assert all(part.seconds > 0.0 and part.elapsed > 0.0 for part in made[1])
    assert rows[-1][1:] == [f"{sum(getattr(part, time) for part in made[1]):.0f}" for time in ("seconds", "elapsed")]


def test_page_holds_its_pictures_and_fetches_nothing(made, page):
    pictures = [base64.b64decode(image["src"].removeprefix("data:image/png;base64,")) for image in page.all("img")]
    files = [file.read_bytes() for file in made[0].rglob("*.png")]
    assert sorted(pictures) == sorted(files)
    assert len(files) > 20
    assert not {"script", "link", "iframe", "object"} & {tag for tag, _ in page.tags}
    assert "url(" not in page.style
    assert "@import" not in page.style
    named = {attributes["id"] for _, attributes in page.tags if "id" in attributes}
    links = [anchor["href"] for anchor in page.all("a")]
    assert len(links) == len(ORIGINS) * len(PAPERS)
    assert all(link[0] == "#" and link[1:] in named for link in links)


def test_page_is_accessible(page):
    assert page.all("html") == [{"lang": "en"}]
    assert any(meta.get("name") == "viewport" for meta in page.all("meta"))
    assert [tag for tag, _ in page.tags].count("h1") == 1
    assert all(len(image["alt"]) > 20 for image in page.all("img"))
    assert {head["scope"] for head in page.all("th")} == {"col"}
    regions = [block for block in page.all("div") if block["role"] == "region"]
    assert len(regions) == len(page.tables)
    assert all(block["aria-label"] and block["tabindex"] == "0" for block in regions)
    assert "prefers-color-scheme: dark" in page.style


def test_markdown_shows_pictures_that_exist(made):
    shown = re.findall(r"!\[([^\]]+)\]\(([^)]+)\)", (made[0] / "papers.md").read_text(encoding="utf-8"))
    assert sorted(name for _, name in shown) == sorted(
        path.relative_to(made[0]).as_posix() for path in made[0].rglob("*.png")
    )


def test_a_kept_result_reads_as_the_computed_one(made):
    """What a paper's own run wrote from memory equals the text of its JSON."""
    for part in made[1]:
        text = (made[0] / "papers" / part.paper.name / "reproduction.md").read_text(encoding="utf-8")
        assert text.startswith(part.paper.words(part.result))


def test_report_says_how_it_was_made(made):
    text = (made[0] / "papers.md").read_text(encoding="utf-8")
    assert "`passive-env reproduce all --runs 1 --seeds 0 --out DIR`" in text
    (rows,) = (rows for head, *rows in tables(text) if head == ["what", "is"])
    said = dict(rows)
    assert "numba" in said["versions"]
    assert "passive-env" in said["versions"]
    assert said["machine"].endswith("cores")
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", said["date"])
    assert said["seeds"] == "0"


def test_committed_report_is_of_these_claims(made):
    """Numbers are a full run's, but papers and numbers of claims are today's."""
    text = (ROOT / "docs" / "papers.md").read_text(encoding="utf-8")
    for origin in ORIGINS:
        for part, row in zip(made[1], summary(text, origin)[:-1], strict=True):
            assert part.paper.subject in row[0]
            assert int(row[1]) == len(of_origin(part.result["claims"], origin))
            assert sum(map(int, row[2:])) == int(row[1])


# ------------------------------------------------------------------------------------- kept parts and papers that fail

CLAIMS = [
    claim(PAPER, "1", "a | b < c, x_1 * y_2 * [m]", (1.0, 2.0), 1.5, True, (1.0, 2.0)),
    claim(SPEC, "7", "computed for the specification", 2.0, 2.0, True),
    claim(PAPER, "2", "nothing came of it", "better", float("nan"), False),
    claim(PAPER, "3", "faster than others", "no figures", "not timed", "not testable"),
]


class Told:
    """A paper that computes nothing, counts its runs, and may fail."""

    def __init__(self, name: str, error: BaseException | None = None):
        self.runs: list[tuple[int, tuple[int, ...]]] = []
        self.error = error
        basis = {PAPER: "Sentences.", SPEC: "Computed."}
        self.paper = Paper(name, f"About {name}", self, lambda result: {"Table": result["table"]}, basis)

    def __call__(self, runs=50, seeds=(0,), out=None):
        self.runs.append((runs, tuple(seeds)))
        if self.error is not None:
            raise self.error
        settings = {"runs": runs, "seeds": list(seeds)}
        table = markdown_table(("a", "b"), [(1.0, len(self.runs))])
        result = {"paper": "Somebody (1999)", "settings": settings, "table": table, "claims": CLAIMS}
        figure = Figure()
        figure.subplots().set(title="A picture [m]", xlabel="x", ylabel="y")
        write_reproduction(out, result, self.paper.words(result), {"picture": figure})
        return result


def together_of(*told: Told) -> dict[str, Paper]:
    return {one.paper.name: one.paper for one in told}


def test_finished_papers_are_kept(tmp_path):
    one, two = Told("one"), Told("two")
    first = reproduce_all(tmp_path, None, (1, 2), together_of(one, two), progress=False)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert reproduce_all(tmp_path, None, (1, 2), together_of(one, two), progress=False) == first
    assert one.runs == two.runs == [(50, (1, 2))]
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_an_interrupted_run_goes_on_where_it_stopped(tmp_path):
    one, two = Told("one"), Told("two", KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        reproduce_all(tmp_path, 3, (1,), together_of(one, two), progress=False)
    assert not (tmp_path / "papers.md").exists()
    two.error = None
    reproduce_all(tmp_path, 3, (1,), together_of(one, two), progress=False)
    assert (len(one.runs), len(two.runs)) == (1, 2)
    assert "About two" in (tmp_path / "papers.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("change", ["runs", "seeds", "code", "versions", "picture", "result", "seal"])
def test_what_is_not_of_this_run_is_computed_anew(tmp_path, monkeypatch, change):
    one, folder = Told("one"), tmp_path / "papers" / "one"
    reproduce_all(tmp_path, 3, (1,), together_of(one), progress=False)
    if change == "code":
        monkeypatch.setattr(together, "code_digest", lambda: "other")
    elif change == "versions":
        monkeypatch.setattr(together, "versions", lambda names: {"numpy": "0"})
    elif change == "picture":
        (folder / "picture.png").unlink()
    elif change == "result":
        (folder / "reproduction.json").write_text("{}")
    elif change == "seal":
        (folder / "finished.json").write_text('{"key"')
    settings = {"runs": (4, (1,)), "seeds": (3, (2,))}.get(change, (3, (1,)))
    (part,) = reproduce_all(tmp_path, *settings, together_of(one), progress=False)
    assert one.runs == [(3, (1,)), settings]
    assert part.result is not None
    assert part.result["settings"]["runs"] == settings[0]


def test_a_paper_that_fails_is_reported_and_the_rest_written(tmp_path, capsys):
    bad, good = Told("bad", RuntimeError("singular <matrix>")), Told("good")
    parts = reproduce_all(tmp_path, 3, (1,), together_of(bad, good), progress=False)
    assert [part.failure for part in parts] == ["RuntimeError: singular <matrix>", ""]
    assert "singular <matrix>" in capsys.readouterr().err
    text = (tmp_path / "papers.md").read_text(encoding="utf-8")
    for origin, counts in ((PAPER, ["3", "1", "1", "1"]), (SPEC, ["1", "1", "0", "0"])):
        rows = summary(text, origin)
        assert rows[0][1:] == ["not computed", "", "", ""]
        assert rows[1][1:] == rows[2][1:] == counts
    assert "Not computed:\n\n    RuntimeError: singular <matrix>" in text
    html = (tmp_path / "papers.html").read_text(encoding="utf-8")
    Page(html)
    assert "singular &lt;matrix&gt;" in html
    bad.error = None
    parts = reproduce_all(tmp_path, 3, (1,), together_of(bad, good), progress=False)
    assert [part.failure for part in parts] == ["", ""]
    assert (len(bad.runs), len(good.runs)) == (2, 1)


def test_all_may_fail(tmp_path):
    reproduce_all(tmp_path, 3, (1,), together_of(Told("bad", ValueError("no"))), progress=False)
    text = (tmp_path / "papers.md").read_text(encoding="utf-8")
    assert all(summary(text, origin)[-1][1:] == ["0", "0", "0", "0"] for origin in ORIGINS)


def test_characters_of_markdown_stay_as_they_are(tmp_path):
    reproduce_all(tmp_path, 3, (1,), together_of(Told("one")), progress=False)
    page = Page((tmp_path / "papers.html").read_text(encoding="utf-8"))
    rows, checks = (rows for head, *rows in page.tables if head[0] == "no.")
    assert rows[0] == ["1", "reproduced", CLAIMS[0]["claim"], "1 / 2", "1.5", "1 to 2", "1"]
    assert rows[1][4] == ""
    assert checks == [["4", "reproduced", "computed for the specification", "2", "2", "", "7"]]
    classes = [cell["class"] for cell in page.all("td") if "class" in cell]
    assert classes == ["reproduced", "not-reproduced", "not-testable", "reproduced"]
    (image,) = page.all("img")
    assert image["alt"] == "A picture (m): y over x"


# ----------------------------------------------------------------------------------------------- pieces and the command


def test_figures_in_words():
    figure = Figure()
    figure.suptitle("Both")
    left, right = figure.subplots(1, 2)
    left.set(title="Left", xlabel="time [s]", ylabel="error [m]")
    left.plot([1, 2], label="ours")
    left.plot([2, 1], label="theirs")
    left.legend()
    right.set_title("Map")
    figure.colorbar(right.contourf([[1, 2], [3, 4]]), ax=right, label="bound [m]")
    assert described(figure) == "Both. Left: error [m] over time [s] (curves: ours; theirs). Map. Color: bound [m]"


def test_a_missing_picture_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.png"):
        as_page("![nothing](none.png)", "t", tmp_path)


def test_title_is_escaped(tmp_path):
    assert "<title>a &lt; b</title>" in as_page("# x", "a < b", tmp_path)


def test_command_knows_every_paper():
    named = typing.get_args(typing.get_type_hints(cli.Reproduce)["paper"])
    assert set(named) == {*PAPERS, "all"}


def test_command_writes_the_report_and_tells_failures(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(together, "PAPERS", {})
    bad, good = Told("bad", RuntimeError("singular")), Told("good")
    monkeypatch.setattr(together.reproduce_all, "__defaults__", (None, (0,), together_of(bad, good), False))
    assert cli.main(["reproduce", "all", "--seeds", "1", "--out", str(tmp_path / "r")]) == 1
    caught = capsys.readouterr()
    assert "passive-env: bad: not computed, RuntimeError: singular" in caught.err
    assert "papers.html" in caught.out
    bad.error = None
    assert cli.main(["reproduce", "all", "--seeds", "1", "--out", str(tmp_path / "r")]) == 0


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ([], "needs --out DIR"),
        (["--runs", "0", "--out", "r"], "at least one of each"),
        (["--seeds", "-1", "--out", "r"], "must not be negative"),
    ],
)
def test_command_refuses(arguments, reason, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["reproduce", "all", *arguments]) == 2
    assert reason in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_every_module_is_installed():
    """Every folder with modules is named in pyproject.toml."""
    named = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]["packages"]
    modules = [file for room in ("trackers", "passive_env", "agents") for file in (ROOT / room).rglob("*.py")]
    assert {".".join(file.parent.relative_to(ROOT).parts) for file in modules} - set(named) == set()


def test_seal_names_settings_and_files(tmp_path):
    reproduce_all(tmp_path, 3, (1,), together_of(Told("one")), progress=False)
    seal = json.loads((tmp_path / "papers" / "one" / "finished.json").read_text())
    assert seal["key"]["runs"] == 3
    assert set(seal["files"]) == {"picture.png", "reproduction.json", "reproduction.md"}
