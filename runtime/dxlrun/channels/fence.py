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


def load(path: Path = _LIBRARY) -> Callable[[], None]:
    """Return the compiled fence; one that does nothing where there is none."""
    try:
        found = ctypes.PyDLL(
            str(path)
        ).dxl_fence  # it takes no time in which others could have the interpreter
    except (OSError, AttributeError):
        return _nothing
    found.argtypes, found.restype = (), None
    compiled: Callable[[], None] = found
    return compiled


fence = load()
"""Order the memory accesses before it and behind it."""


def require(compiled: Callable[[], None] = fence) -> None:
    """Raise StartUpError where processes could not rely on the order of their shared memory."""
    if compiled is _nothing:
        raise StartUpError(MISSING)
