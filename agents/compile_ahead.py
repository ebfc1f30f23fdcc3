"""``passive-env compile``: all kernels compiled ahead, for container images and for whoever would rather wait once."""

from __future__ import annotations

import importlib
import inspect
import multiprocessing
import pkgutil
from concurrent.futures import ProcessPoolExecutor, as_completed
from types import ModuleType

from tqdm import tqdm

import passive_env
import trackers
from trackers.compiled import Kernel, available_cores, cache_folder


def compile_all(processes: int | None = None, progress: bool = True) -> int:
    """Compile every kernel of the package that the cache does not hold.

    Args:
        processes: how many compile at once; None takes the number of cores this process may use.
        progress: whether to show a bar.
    Returns:
        How many kernels there are.
    Raises:
        ValueError: fewer than one process.
        OSError: a cache folder that cannot be written.
    """
    if processes is not None and processes < 1:
        raise ValueError(f"processes = {processes}: must be at least 1")
    kernels = all_kernels()
    # Fresh processes: a compiler does not outlive a fork well, and one's own threads may be at work.
    fresh = multiprocessing.get_context("spawn")
    with (
        ProcessPoolExecutor(processes or available_cores(), fresh) as pool,
        tqdm(total=len(kernels), unit="kernel", disable=not progress) as bar,
    ):
        for done in as_completed([pool.submit(_prepare, *each) for each in kernels]):
            done.result()
            bar.update()
    return len(kernels)


def all_kernels() -> list[tuple[str, str]]:
    """Module and name of every kernel, those of long modules first: they take longest, and nobody should wait for them.

    Modules whose extra is not installed are left out.
    """
    modules = [module for package in (trackers, passive_env) for module in _modules(package)]
    modules.sort(key=lambda module: len(inspect.getsource(module)), reverse=True)
    return [
        (module.__name__, name)
        for module in modules
        for name, each in vars(module).items()
        if isinstance(each, Kernel) and each.__module__ == module.__name__
    ]


def _modules(package: ModuleType) -> list[ModuleType]:
    found = []
    for each in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        try:
            found.append(importlib.import_module(each.name))
        except ImportError:
            continue
    return found


def _prepare(module: str, name: str) -> None:
    getattr(importlib.import_module(module), name).prepare()


def words(count: int) -> str:
    """What the command prints."""
    return f"{count} kernels are compiled, in {cache_folder()}"
