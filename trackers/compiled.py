"""Kernels written for one item and lifted over any leading axes, and the one place where threads are used.

A kernel is written as the paper writes it, with loops and branches, for ONE track (or one scan, one environment).
`kernel` turns it into a NumPy generalised ufunc through `numba.guvectorize`: NumPy broadcasting then supplies the
leading axes. Compilation happens at the first call and is cached on disk; importing the package compiles nothing.

A kernel raises no floating-point warnings. The compiler takes it that nobody reads the processor's flags, so numbers
that are not used may set them: the same input, with the same result to the bit, said "overflow" once and not again.
What is not finite is looked for in the values.

The compiled code releases the interpreter lock, so blocks of a batch run on all cores with plain threads (`Blocks`):
no second OpenMP runtime next to torch's, no trouble with forked workers.
"""

from __future__ import annotations

import contextlib
import contextvars
import hashlib
import itertools
import os
import re
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numba
import numpy as np
from filelock import FileLock
from numba.core import config as numba_config

T = TypeVar("T")

_SILENT = contextvars.Context()
_SILENT.run(np.seterr, all="ignore")
"""Where NumPy reads no floating-point flags; a copy costs a call 0.1 µs where `np.errstate` costs 1.5."""

_COMPILING = threading.RLock()
_CONFIG: Any = numba_config  # holds the folder where numba looks for cached machine code

_TYPES = {"f": numba.float64, "i": numba.int64, "b": numba.boolean, "g": numba.float32}
_DTYPES = {"f": np.float64, "i": np.int64, "b": np.bool_, "g": np.float32}

# Division by zero must yield inf (to be handled), not raise from inside a batch.
# A product and a sum may become one fused multiply-add: fewer roundings, and faster.
helper = numba.njit(error_model="numpy", forceinline=True, fastmath={"contract"})
"""Decorator of small scalar functions that kernels call; LLVM inlines them."""

routine = numba.njit(error_model="numpy", fastmath={"contract"})
"""Decorator of functions that kernels call rarely: LLVM may leave them as calls. Where all is inlined, down to the last
helper, long ones take a minute to compile."""


FIXED = {"x": 4, "p": 2, "x6": 6, "p3": 3, "a2": 2}
"""Axis names of a fixed length in every layout: the planar state and position, the state and position in space, a
pair of azimuth and elevation. Compiled code indexes these axes without bounds checks, so `Kernel` refuses others."""


def kernel(layout: str, dtypes: str = "") -> Callable[[Callable[..., None]], Kernel]:
    """Make a lazily compiled generalised ufunc of a function written for one item.

    Args:
        layout: NumPy gufunc signature, e.g. ``"(n,x),(n,x,x),()->(n,x)"``.
        dtypes: one letter per argument, outputs last (``f`` float64, ``g`` float32, ``i`` int64,
            ``b`` bool); all float64 if empty. A capital letter says that the array lies in one piece in memory:
            faster to index. Inputs that do not are copied; outputs, which NumPy makes, do.
    """
    return lambda function: Kernel(function, layout, dtypes)


class Kernel:
    """A generalised ufunc compiled at its first call (see `kernel`)."""

    def __init__(self, function: Callable[..., None], layout: str, dtypes: str = ""):
        self.layout = layout.replace(" ", "")
        self.dtypes = dtypes
        self.__doc__ = function.__doc__
        self.__name__ = function.__name__
        self.__module__ = function.__module__
        self._function = function
        self._fixed = _fixed_axes(self.layout)
        inputs = dtypes[: self.layout.split("->")[0].count("(")]
        self._dense = [(place, _DTYPES[letter.lower()]) for place, letter in enumerate(inputs) if letter.isupper()]
        self._owner: Any = None  # keeps the machine code alive
        self._gufunc: Any = None

    def __call__(self, *arrays: Any, **options: Any) -> Any:
        """Apply to arrays of shape [..., core]; leading axes broadcast. Overflows and the like are silent.

        Raises:
            ValueError: trailing axes that do not fit the layout.
        """
        for place, axis, size in self._fixed:
            shape = np.shape(arrays[place])
            if len(shape) < -axis or shape[axis] != size:
                name = self.__name__.lstrip("_")
                raise ValueError(f"{name}: argument {place} has shape {shape}, axis {axis} must have length {size}")
        if self._gufunc is None:
            self.prepare()
        gufunc: Any = self._gufunc
        if self._dense:
            given = list(arrays)
            for place, dtype in self._dense:
                given[place] = np.ascontiguousarray(given[place], dtype)
            return _SILENT.copy().run(gufunc, *given, **options)
        return _SILENT.copy().run(gufunc, *arrays, **options)

    def prepare(self) -> None:
        """Compile this kernel, or load it from the cache, unless that is done; its first call does the same."""
        if self._gufunc is None:
            source = Path(self._function.__code__.co_filename).stem
            with _COMPILING, _own_cache(f"{source}.{self.__name__}"):
                self._compile()

    def _compile(self) -> None:
        if self._gufunc is not None:
            return
        inputs, outputs = (re.findall(r"\(([^)]*)\)", side) for side in self.layout.split("->"))
        ranks = [0 if not core else core.count(",") + 1 for core in (*inputs, *outputs)]
        letters = self.dtypes or "f" * len(ranks)
        if len(letters) != len(ranks):
            raise ValueError(f"kernel {self.__name__}: {len(ranks)} arguments in the layout, {len(letters)} dtypes")
        types = []
        for place, (letter, rank) in enumerate(zip(letters, ranks, strict=True)):
            scalar_output = rank == 0 and place >= len(inputs)
            types.append(_array(letter, 1 if scalar_output else rank))
        decorate: Any = numba.guvectorize([tuple(types)], self.layout, nopython=True, cache=True)
        self._owner = decorate(self._function)
        self._gufunc = self._owner.ufunc


def _fixed_axes(layout: str) -> list[tuple[int, int, int]]:
    """(argument, axis from the end, length) of one input per fixed axis name; NumPy holds the other inputs to it."""
    inputs = re.findall(r"\(([^)]*)\)", layout.split("->")[0])
    found = {}
    for place, core in enumerate(inputs):
        names = core.split(",")
        for at, name in enumerate(names):
            if name in FIXED:
                found.setdefault(name, (place, at - len(names), FIXED[name]))
    return list(found.values())


def _array(letter: str, rank: int) -> Any:
    scalar = _TYPES[letter.lower()]
    if rank == 0:
        return scalar
    last = slice(None, None, 1) if letter.isupper() else slice(None)
    return scalar[(*(slice(None),) * (rank - 1), last)]


def _sources_digest() -> str:
    """Fingerprint of all sources of the packages that hold kernels."""
    here = Path(__file__).resolve().parent
    sources = sorted(path for folder in (here, here.parent / "passive_env") for path in folder.rglob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:16]


_DIGEST = _sources_digest()  # at import, before anyone edits a source that is already loaded


@lru_cache(maxsize=1)
def cache_folder() -> str:
    """Folder of machine code made from exactly these sources, chosen at the first call.

    Numba's own cache notices a change of the kernel's file only, not one of a helper inlined from another file, so
    the folder's name carries a digest of all sources.
    """
    here = Path(__file__).resolve().parent
    beside = here / "__pycache__"
    if _CONFIG.CACHE_DIR:
        base = Path(_CONFIG.CACHE_DIR)
    elif os.access(beside if beside.exists() else here, os.W_OK):
        base = beside
    else:
        base = Path.home() / ".cache" / "passive-env"
    return str(base / f"kernels-{_DIGEST}")


@contextlib.contextmanager
def _own_cache(name: str) -> Iterator[None]:
    """Point numba's cache at our folder while the kernel of this name is compiled or loaded, by one process at a time.

    Numba caches a gufunc's body and its loop in two files that name each other; two processes that compile the same
    kernel at once can leave a body of one beside a loop of the other, and the next process crashes. Hence the lock.
    """
    folder, before = cache_folder(), _CONFIG.CACHE_DIR
    Path(folder).mkdir(parents=True, exist_ok=True)
    _CONFIG.CACHE_DIR = folder
    try:
        with FileLock(f"{folder}/{name}.lock"):
            yield
    finally:
        _CONFIG.CACHE_DIR = before


SMALLEST_BLOCK = 64
"""A batch is cut for the sake of idle cores only into blocks of at least this many items."""


class Blocks:
    """Runs a function on consecutive blocks of a batch, on several threads when there is more than one block.

    A block stays with its thread from call to call, so its state stays in that core's cache; the calling thread does
    its share too. A `map` inside a `map` (a tracker that imagines worlds) runs on the thread it is called on.

    Args:
        size: number of items in the batch.
        block: items in one block; small enough that a block's state stays in a core's cache.
        threads: threads at work, the calling one included; None takes the number of cores this process may use.
        smallest: a batch of fewer items for each thread is given to fewer threads.
    """

    def __init__(self, size: int, block: int = 256, threads: int | None = None, smallest: int = SMALLEST_BLOCK):
        self.threads = max(1, min(threads or available_cores(), size // smallest))
        count = self.threads * max(1, -(-size // (block * self.threads)))
        edges = np.linspace(0, size, count + 1).round().astype(int)
        self.slices = [slice(int(lo), int(hi)) for lo, hi in itertools.pairwise(edges)]

    def map(self, function: Callable[..., T], *columns: Sequence[Any]) -> list[T]:
        """Call ``function(*row)`` for every block, one row of the columns per block; results in block order."""
        rows = list(zip(*columns, strict=True))
        if self.threads == 1 or getattr(_SHARING, "inside", False):
            return [function(*row) for row in rows]
        share = len(rows) // self.threads
        first, *others = (rows[at : at + share] for at in range(0, len(rows), share))
        workers = _workers(self.threads - 1, os.getpid())
        futures = [worker.submit(_run_share, function, part) for worker, part in zip(workers, others, strict=True)]
        try:
            results = _run_share(function, first)
        finally:
            wait(futures)  # an error here must not leave others at work
        return [*results, *(result for future in futures for result in future.result())]


_SHARING = threading.local()


def _run_share(function: Callable[..., T], rows: list[tuple[Any, ...]]) -> list[T]:
    """One thread's rows; marks the thread as taken, for a worker that waited for itself would wait forever."""
    _SHARING.inside = True
    try:
        return [function(*row) for row in rows]
    finally:
        _SHARING.inside = False


@contextlib.contextmanager
def single_thread() -> Iterator[None]:
    """Let every `Blocks.map` in the calling thread run on that thread, block by block, for a while."""
    before = getattr(_SHARING, "inside", False)
    _SHARING.inside = True
    try:
        yield
    finally:
        _SHARING.inside = before


def available_cores() -> int:
    """Number of processor cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@lru_cache(maxsize=8)
def _workers(count: int, process: int) -> list[ThreadPoolExecutor]:
    """Single threads, the same for all callers that want as many; a forked child must not inherit its parent's."""
    return [ThreadPoolExecutor(1, thread_name_prefix=f"passive-env-{i}") for i in range(count)]
