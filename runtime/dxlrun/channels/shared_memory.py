"""Shared memory: anonymous, with a sealed size, and with memory barriers for all processors.

Python has no memory barriers, so the functions that need one are in C (`shared_memory.c`).
"""

from __future__ import annotations

import ctypes
import mmap
import os
from functools import cache
from pathlib import Path

from dxlwire.compiled import load_compiled

SOURCE = Path(__file__).with_name("shared_memory.c")


@cache
def library() -> ctypes.PyDLL:
    """Load the compiled C functions of `shared_memory.c`, once a process.

    They are called without releasing the GIL, because they take less time than a release.

    Raises: NotCompiled: The object was not built, or was built from another source.
    """
    found = load_compiled(SOURCE, ctypes.PyDLL)
    address, word, number = ctypes.c_void_p, ctypes.c_uint64, ctypes.c_int64
    words = ctypes.POINTER(word)
    for name, result, arguments in (
        ("append", number, (address, word, word, ctypes.c_uint32, address, word)),
        ("commit", None, (address, word, word, address)),
        ("read_next", number, (address, word, word, address, address)),
        ("read_newest", number, (address, word, word, address, address)),
        ("load", word, (words,)),
        ("store", None, (words, word)),
    ):
        function = getattr(found, f"dxl_{name}")
        function.argtypes, function.restype = arguments, result
    return found


def load(words: memoryview, index: int) -> int:
    """Load a shared word with acquire semantics: later reads are at least as new."""
    found: int = library().dxl_load(ctypes.c_uint64.from_buffer(words, 8 * index))
    return found


def store(words: memoryview, index: int, value: int) -> None:
    """Store a shared word with release semantics: earlier writes become visible before it."""
    library().dxl_store(ctypes.c_uint64.from_buffer(words, 8 * index), value)


def create(name: str, size: int) -> int:
    """Return the descriptor of new memory (memfd) whose size is sealed, so that no process can resize it.

    Pass it to a child process with `pass_fds`. It leaves no file in /dev/shm.

    Args:
        name: Name for diagnostics, shown in /proc.
        size: Size, bytes.
    """
    import fcntl

    descriptor = os.memfd_create(f"dxlrun-{name}", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    os.ftruncate(descriptor, size)
    # F_SEAL_SEAL, because a driver must not add a seal against writes.
    seals = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL
    fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, seals)
    return descriptor


def mapped(descriptor: int, flags: int = 0) -> memoryview:
    """Map shared memory for reading and writing; `flags` are additional flags of mmap(2)."""
    return memoryview(mmap.mmap(descriptor, 0, flags=mmap.MAP_SHARED | flags))
