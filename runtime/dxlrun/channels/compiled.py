"""C sources of all packages, and the check that they were compiled."""

from __future__ import annotations

import ctypes
from pathlib import Path

from dxlwire.compiled import load_compiled
from dxlwire.errors import NotCompiled

SOURCES = tuple(
    Path(__file__).parents[2] / name
    for name in ("dxlrun/channels/shared_memory.c", "dxlrun/control/gate.c", "dxlwire/exchange/kernel.c")
)
"""C sources that the build compiles."""


def missing() -> str:
    """Return one sentence about a compiled object that cannot be used; empty if all can."""
    try:
        for source in SOURCES:
            load_compiled(source, ctypes.PyDLL)
    except NotCompiled as error:
        return f"{error}"
    return ""
