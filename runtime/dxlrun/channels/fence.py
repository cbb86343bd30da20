"""Fence: in which order other processes see what this one writes into shared memory; by the compiled kernel.

Python has no memory barriers, so the exchange's kernel has one (C11, `atomic_thread_fence`). What is written
before a fence is visible before what is written after it; what is read after a fence is no older than what
was read before it. On x86-64, which makes stores visible in their order, that costs the call alone; ARM and
others reorder.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from pathlib import Path

from dxlrun.channels.compiled import compiled
from dxlrun.errors import StartUpError

SOURCE = Path(__file__).parents[1] / "dynamixel" / "exchange" / "kernel.c"
LIBRARY = SOURCE.with_name("libkernel.so")  # Where the build puts the compiled kernel


def library(kind: type[ctypes.CDLL] = ctypes.PyDLL, path: Path | None = None) -> ctypes.CDLL:
    """Return the functions of the compiled kernel.

    By default their calls keep the interpreter: they take no time in which others could have it. Raises
    StartUpError where it was not built, or of another source.
    """
    found = compiled(SOURCE, kind, path or LIBRARY)
    address, size, number, time = ctypes.c_void_p, ctypes.c_uint64, ctypes.c_int32, ctypes.c_int64
    for name, result, arguments in (
        ("fence", None, ()),
        ("append", time, (address, size, size, ctypes.c_uint32, address, size)),
        ("commit", None, (address, size, size, address)),
        ("read", number, (address,)),
        ("write", number, (address,)),
        ("abandon", None, (address,)),
        ("take", None, (address, number, number, address, time)),
        ("settle", number, (address, time)),
        ("show", None, (address, time)),
    ):
        function = getattr(found, f"dxl_{name}")
        function.argtypes, function.restype = arguments, result
    return found


def array_of(memory: memoryview) -> ctypes.Array[ctypes.c_char]:
    """Return memory that can be written as these functions take it; it lives as long as this does."""
    return (ctypes.c_char * len(memory)).from_buffer(memory)


def _nothing() -> None:
    """Stand in for the kernel's fence where that was not built: robot files are checked everywhere."""


def load() -> Callable[[], None]:
    """Return the compiled fence; one that does nothing where there is none."""
    try:
        ordered: Callable[[], None] = library().dxl_fence
    except StartUpError:
        return _nothing
    return ordered


fence = load()
"""Order the memory accesses before it and behind it."""
