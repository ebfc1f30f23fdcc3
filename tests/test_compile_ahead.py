"""Kernels compiled ahead: which there are, that they need no compiler later, and whom a compiler keeps waiting."""

import gc
import subprocess
import sys

import pytest
from filelock import FileLock

from agents import cli, compile_ahead
from agents.compile_ahead import all_kernels, compile_all
from passive_env import kinematics
from trackers.compiled import Kernel

SMALL = [("trackers.linalg", "_mahalanobis"), ("passive_env.kinematics", "_turn")]

PREPARE = """
import importlib
module, name = {}
getattr(importlib.import_module(module), name).prepare()
"""


@pytest.fixture
def cached(tmp_path, monkeypatch):
    """A new cache for processes started from here, as a function that lists its files and their times."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    return lambda: {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nb?")}


def use(kernels, monkeypatch):
    monkeypatch.setattr(compile_ahead, "all_kernels", lambda: kernels)


def prepare(kernel):
    """A process that compiles one kernel."""
    return subprocess.Popen([sys.executable, "-c", PREPARE.format(kernel)])


def test_every_kernel_is_named_once_and_the_longest_modules_come_first():
    kernels = all_kernels()
    ours = ("trackers.", "passive_env.")
    alive = {(each.__module__, each.__name__) for each in gc.get_objects() if type(each) is Kernel}
    assert sorted(kernels) == sorted(each for each in alive if each[0].startswith(ours))
    assert kernels.index(("trackers.range_sum_start", "_start")) < kernels.index(("trackers.linalg", "_mahalanobis"))


def test_machine_code_of_all_is_there_afterwards_and_is_not_made_twice(cached, monkeypatch, tmp_path, capsys):
    use(SMALL, monkeypatch)
    assert cached() == {}
    assert cli.main(["compile", "--processes", "2"]) == 0
    (folder,) = tmp_path.iterdir()
    assert capsys.readouterr().out == f"all kernels are compiled: {folder}\n"
    made = cached()
    names = " ".join(path.name for path in made)
    assert "linalg._mahalanobis" in names
    assert "kinematics._turn" in names
    assert compile_all(1, progress=False) == folder
    assert cached() == made


def test_without_a_process_nothing_begins(cached, capsys):
    assert cli.main(["compile", "--processes", "0"]) == 2
    assert "processes = 0: must be at least 1" in capsys.readouterr().err
    assert cached() == {}


def test_a_folder_that_cannot_be_made_is_an_error(tmp_path, monkeypatch, capsys):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file"))
    use(SMALL[:1], monkeypatch)
    assert cli.main(["compile", "--processes", "1"]) == 2
    assert str(tmp_path / "file") in capsys.readouterr().err


def test_an_error_ends_it_before_all_others_are_compiled(cached, monkeypatch):
    others = [("passive_env.kinematics", name) for name, each in vars(kinematics).items() if isinstance(each, Kernel)]
    use([("trackers.linalg", "_no_such_kernel"), *others], monkeypatch)
    with pytest.raises(AttributeError, match="_no_such_kernel"):
        compile_all(1, progress=False)
    begun = {path.name.partition("-")[0] for path in cached()}
    assert len(begun) < len(others)


def test_a_killed_process_is_told_as_such(cached, tmp_path, monkeypatch, capsys):
    (tmp_path / "deadly.py").write_text("import os; os._exit(9)")
    monkeypatch.syspath_prepend(tmp_path)
    use([("deadly", "kernel")], monkeypatch)
    assert cli.main(["compile", "--processes", "1"]) == 2
    assert "too little memory" in capsys.readouterr().err


def test_processes_may_compile_the_same_kernel_at_once(cached):
    both = [prepare(SMALL[0]) for _ in range(2)]
    assert [each.wait(timeout=300) for each in both] == [0, 0]
    made = cached()
    assert made
    assert prepare(SMALL[0]).wait(timeout=300) == 0
    assert cached() == made


def test_who_wants_another_kernel_does_not_wait_for_a_compiler(cached, tmp_path):
    assert prepare(SMALL[1]).wait(timeout=300) == 0
    (lock,) = tmp_path.glob("*/kinematics._turn.lock")
    with FileLock(lock):
        assert prepare(SMALL[0]).wait(timeout=300) == 0
