"""Memory while learning: what one minibatch frees, the next one takes again.

Arrays of a megabyte and more come and go with every minibatch. The C library asks the system for the largest of them
and hands them back, gives back the top of its heap as well, and the system clears every page before it lends it again.
With the preset of passive/PassiveRadar-v0 on a virtual machine of two cores (AMD EPYC) 153,600 steps took 62 s, 21 of
them the system's, and 42 s with memory that is kept. Either option alone helps little.
"""

from __future__ import annotations

import ctypes
from typing import Any

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of malloc.h
_NEVER = -1
_LARGE = (2**30, 2**25)
"""Bytes up to which memory is kept, best first: some versions of glibc take no more than the second."""


def keep_freed_memory() -> bool:
    """Let this process keep the memory that it frees; True where the C library can (glibc), else nothing changes.

    For the rest of its life the process hardly shrinks. What is computed does not change.
    """
    try:
        library: Any = ctypes.CDLL(None)
        mallopt = library.mallopt
    except (AttributeError, OSError, TypeError):  # musl and macOS have no mallopt, Windows no library of that name
        return False
    return any(mallopt(_MMAP_THRESHOLD, size) for size in _LARGE) and bool(mallopt(_TRIM_THRESHOLD, _NEVER))
