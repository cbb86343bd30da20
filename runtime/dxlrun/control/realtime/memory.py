"""Memory of the loop's process: locked, touched before it is needed, and kept once it was freed."""

from __future__ import annotations

import ctypes
import os
import sys
from contextlib import suppress

from dxlrun.control.realtime.rights import UNLIMITED, lockable_bytes

HEAP = 8 << 20
"""Bytes of heap that are touched; a loop of 20 servos allocates some kB in a cycle and frees them [i]."""
_STACK_DEPTH = 800
"""Lists in each other, whose text is made in one C call a list: 800 touch some 100 kB of stack [measured];
the recursion limit of Python is 1000."""
_MCL_CURRENT, _MCL_FUTURE = 1, 2  # asm-generic/mman.h
_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # glibc, malloc.h


def libc() -> ctypes.CDLL:
    """Return the C library. Raises OSError on a system that is not Linux."""
    if not sys.platform.startswith("linux"):
        raise OSError(f"{sys.platform} is not Linux")
    return ctypes.CDLL(None, use_errno=True)


def succeed(code: int) -> None:
    """Raise OSError when a call of the C library returned something else than 0."""
    if code != 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def may_lock() -> bool:
    """Say whether all memory may be locked: under a limit mlockall succeeds, and a later allocation fails."""
    return lockable_bytes() == UNLIMITED


def lock() -> None:
    """Lock all memory, now and later (mlockall(2)). Raises OSError."""
    succeed(libc().mlockall(_MCL_CURRENT | _MCL_FUTURE))


def keep_freed() -> bool:
    """Tell malloc to give nothing back to the kernel: the next allocation finds it touched (mallopt(3)).

    Returns False where the C library has no mallopt (musl): the pages then come and go.
    """
    try:
        mallopt = libc().mallopt
    except AttributeError:
        return False
    return all(mallopt(option, value) == 1 for option, value in ((_M_TRIM_THRESHOLD, -1), (_M_MMAP_MAX, 0)))


def touch() -> None:
    """Touch heap and stack once, so that no page is missing when a cycle first comes that far."""
    bytearray(HEAP)  # zeroed, so each page is written; freed at once, and kept by `keep_freed`
    nested: list[object] = []
    for _ in range(_STACK_DEPTH):
        nested = [nested]
    with suppress(RecursionError):  # called from deep down, or a Python with a lower limit: less is touched
        repr(nested)


def page_faults() -> int:
    """Return how many page faults this process has had, with and without a disk."""
    import resource

    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_minflt + usage.ru_majflt
