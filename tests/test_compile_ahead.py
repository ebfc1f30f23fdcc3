"""Kernels compiled ahead: which there are, and that they need no compiler later."""

import pytest

from agents import cli, compile_ahead
from agents.compile_ahead import all_kernels, compile_all
from passive_env import metrics
from trackers import linalg, range_sum_start
from trackers.compiled import cache_folder

SMALL = [("trackers.linalg", "_mahalanobis"), ("passive_env.kinematics", "_turn")]


@pytest.fixture
def two_kernels(tmp_path, monkeypatch):
    """A new cache for processes started from here, and two kernels to fill it."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(compile_ahead, "all_kernels", lambda: SMALL)
    return lambda: {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nb?")}


def test_every_kernel_is_named_once_and_the_longest_modules_come_first():
    kernels = all_kernels()
    assert len(set(kernels)) == len(kernels) > 80
    for module, name in (
        (range_sum_start, "_start"),
        (linalg, "_mahalanobis"),
        (metrics, "_measure"),
    ):
        assert (module.__name__, name) in kernels
    assert kernels.index(("trackers.range_sum_start", "_start")) < kernels.index(("trackers.linalg", "_mahalanobis"))


def test_machine_code_of_all_is_there_afterwards_and_is_not_made_twice(two_kernels, capsys):
    assert two_kernels() == {}
    assert cli.main(["compile", "--processes", "2"]) == 0
    made = two_kernels()
    names = " ".join(path.name for path in made)
    assert "linalg._mahalanobis" in names
    assert "kinematics._turn" in names
    assert capsys.readouterr().out == f"2 kernels are compiled, in {cache_folder()}\n"
    assert compile_all(1, progress=False) == 2
    assert two_kernels() == made


def test_without_a_process_nothing_begins(two_kernels, capsys):
    assert cli.main(["compile", "--processes", "0"]) == 2
    assert "processes = 0: must be at least 1" in capsys.readouterr().err
    assert two_kernels() == {}


def test_a_folder_that_cannot_be_made_is_an_error(tmp_path, monkeypatch, capsys):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file"))
    monkeypatch.setattr(compile_ahead, "all_kernels", lambda: SMALL[:1])
    assert cli.main(["compile", "--processes", "1"]) == 2
    assert str(tmp_path / "file") in capsys.readouterr().err
