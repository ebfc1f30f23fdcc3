"""``passive-env compile``: all kernels compiled ahead, for whoever would rather wait once."""

from __future__ import annotations

import importlib
import inspect
import multiprocessing
import pkgutil
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from types import ModuleType

from tqdm import tqdm

import passive_env
import trackers
from trackers.compiled import Kernel, available_cores, cache_folder

PACKAGES = (trackers, passive_env)


def compile_all(processes: int | None = None, progress: bool = True) -> Path:
    """Compile every kernel of the package that the cache does not hold.

    New processes compile: a script that calls this needs ``if __name__ == "__main__":``.

    Args:
        processes: how many compile at once; None takes the number of cores this process may use.
        progress: whether to show a bar.
    Returns:
        The folder of the machine code.
    Raises:
        ValueError: fewer than one process.
        OSError: a folder that cannot be written, a process that was killed.
    """
    if processes is not None and processes < 1:
        raise ValueError(f"processes = {processes}: must be at least 1")
    # Not forked: one's own threads may be at work, and a child would wait for their locks forever.
    pool = ProcessPoolExecutor(processes or available_cores(), multiprocessing.get_context("spawn"))
    with pool, tqdm(total=len(all_kernels()), unit="kernel", disable=not progress) as bar:
        try:
            for done in as_completed([pool.submit(_prepare, *each) for each in all_kernels()]):
                folder = done.result()
                bar.update()
        except BrokenProcessPool as error:
            raise OSError("compile: a process was killed; was there too little memory? Try --processes 1") from error
        finally:
            pool.shutdown(wait=False, cancel_futures=True)  # after an error the others are not waited for
    return folder


def all_kernels() -> list[tuple[str, str]]:
    """Module and name of every kernel, those of long modules first, which tend to take longest.

    Modules whose extra is not installed are left out.
    """
    modules = [module for package in PACKAGES for module in _modules(package)]
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
        except ImportError as error:
            if (error.name or "").startswith(tuple(own.__name__ for own in PACKAGES)):
                raise
    return found


def _prepare(module: str, name: str) -> Path:
    getattr(importlib.import_module(module), name).prepare()
    return Path(cache_folder())
