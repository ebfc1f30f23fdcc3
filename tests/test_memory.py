"""What training frees stays with the process, where the C library knows how."""

import ctypes
import platform
import subprocess
import sys

import pytest

from agents.memory import keep_freed_memory
from agents.training import plan, train

FAULTS = """
import resource, sys
import numpy as np
from agents.memory import keep_freed_memory
kept = keep_freed_memory() if sys.argv[1] == "keep" else False
def minibatches(count):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(count):
        [np.ones(3_500_000) for _ in range(3)]
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
minibatches(2)
print(kept, minibatches(10))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc can be told")
def test_freed_memory_is_taken_again():
    """Page faults of ten rounds of three arrays of 28 MB: none where memory is kept."""
    faults = {}
    for mode in ("keep", "return"):
        done = subprocess.run([sys.executable, "-c", FAULTS, mode], capture_output=True, text=True, check=True)
        kept, count = done.stdout.split()
        assert (kept == "True") == (mode == "keep")
        faults[mode] = int(count)
    assert faults["keep"] < 100 < faults["return"]


@pytest.mark.parametrize("error", [AttributeError, OSError, TypeError])
def test_other_c_libraries_are_left_alone(error, monkeypatch):
    def without(name):
        raise error("no such function")

    monkeypatch.setattr(ctypes, "CDLL", without)
    assert not keep_freed_memory()


@pytest.mark.parametrize(("most", "wanted"), [(2**30, True), (2**25, True), (0, False)])
def test_the_threshold_is_the_largest_that_the_c_library_takes(most, wanted, monkeypatch):
    taken = {}

    class Library:
        @staticmethod
        def mallopt(what, size):
            if what == -3 and size > most:
                return 0
            taken[what] = size
            return 1

    monkeypatch.setattr(ctypes, "CDLL", lambda name: Library)
    assert keep_freed_memory() == wanted
    assert taken == ({-3: most, -1: -1} if wanted else {})


def test_a_training_keeps_its_memory(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr("agents.training.keep_freed_memory", lambda: asked.append("asked"))
    train(plan("Ownship", tmp_path, "ppo_scratch", timesteps=120, envs=2, fields={"steps": 2}), progress=False)
    assert asked == ["asked"]
