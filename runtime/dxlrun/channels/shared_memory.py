"""Shared memory: nameless, sealed in its size, and read and written in an order that every processor keeps.

Python has no memory barriers: what needs one is in C (`shared_memory.c`).
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
    """Return the compiled functions, which keep the interpreter: they take no time in which others could have
    it. Raises NotCompiled where they were not built, or of another source."""
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
    """Return a shared word; what is read after it is no older."""
    found: int = library().dxl_load(ctypes.c_uint64.from_buffer(words, 8 * index))
    return found


def store(words: memoryview, index: int, value: int) -> None:
    """Publish a shared word; what was written before it is seen before it."""
    library().dxl_store(ctypes.c_uint64.from_buffer(words, 8 * index), value)


def create(name: str, size: int) -> int:
    """Return the descriptor of fresh memory (memfd), which no process can resize under another.

    Hand it to a process with `pass_fds`; nothing is left in /dev/shm.
    """
    import fcntl

    descriptor = os.memfd_create(f"dxlrun-{name}", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    os.ftruncate(descriptor, size)
    seals = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL  # nor may a driver add another one
    fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, seals)
    return descriptor


def mapped(descriptor: int, flags: int = 0) -> memoryview:
    """Map memory that several processes share; `flags`: see mmap(2)."""
    return memoryview(mmap.mmap(descriptor, 0, flags=mmap.MAP_SHARED | flags))
