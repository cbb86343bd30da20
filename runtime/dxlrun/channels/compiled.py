"""The C sources of all rooms, and whether each was compiled."""

from __future__ import annotations

import ctypes
from pathlib import Path

from dxlwire.compiled import load_compiled
from dxlwire.errors import NotCompiled

SOURCES = tuple(
    Path(__file__).parents[2] / name
    for name in ("dxlrun/channels/shared_memory.c", "dxlrun/control/gate.c", "dxlwire/exchange/kernel.c")
)
"""All that the build compiles."""


def missing() -> str:
    """Return why a compiled object cannot be used, in one sentence; empty when all can."""
    try:
        for source in SOURCES:
            load_compiled(source, ctypes.PyDLL)
    except NotCompiled as error:
        return f"{error}"
    return ""
