"""Fence: in which order other processes see what this one writes into shared memory.

Python has no memory barriers, so the exchange's kernel has one (C11, `atomic_thread_fence`). What is written
before a fence is visible before what is written after it; what is read after a fence is no older than what
was read before it. On x86-64, which makes stores visible in their order, that costs the call alone; ARM and
others reorder.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from pathlib import Path

from dxlrun.errors import StartUpError

_LIBRARY = Path(__file__).parents[1] / "dynamixel" / "exchange" / "libkernel.so"
MISSING = "the compiled kernel of the exchange is missing: install dxlrun again, on Linux"


def _nothing() -> None:
    """Stand in for the kernel's fence where that was not built."""


def library(path: Path = _LIBRARY) -> ctypes.PyDLL:
    """Return the compiled kernel's functions for shared memory.

    Their calls keep the interpreter: they take no time in which others could have it. Raises OSError where it
    was not built, AttributeError where it is not a kernel.
    """
    found = ctypes.PyDLL(str(path))
    address = ctypes.c_void_p
    found.dxl_fence.argtypes, found.dxl_fence.restype = (), None
    size = ctypes.c_uint64
    found.dxl_append.argtypes = (address, size, size, ctypes.c_uint32, address, size)
    found.dxl_append.restype = ctypes.c_int64
    found.dxl_commit.argtypes, found.dxl_commit.restype = (address, size, size, address), None
    return found


def functions() -> ctypes.PyDLL:
    """Return the installed kernel's functions; raises StartUpError where it was not compiled."""
    try:
        return library()
    except (OSError, AttributeError):
        raise StartUpError(MISSING) from None


def array_of(memory: memoryview) -> ctypes.Array[ctypes.c_char]:
    """Return memory that can be written as these functions take it; it lives as long as this does."""
    return (ctypes.c_char * len(memory)).from_buffer(memory)


def load(path: Path = _LIBRARY) -> Callable[[], None]:
    """Return the compiled fence; one that does nothing where there is none."""
    try:
        compiled: Callable[[], None] = library(path).dxl_fence
    except (OSError, AttributeError):
        return _nothing
    return compiled


fence = load()
"""Order the memory accesses before it and behind it."""


def require(compiled: Callable[[], None] = fence) -> None:
    """Raise StartUpError where processes could not rely on the order of their shared memory."""
    if compiled is _nothing:
        raise StartUpError(MISSING)
