"""C sources of the runtime and its libraries, and the check that they were compiled."""

from __future__ import annotations

import ctypes
from pathlib import Path

from dxlwire.compiled import load_compiled
from dxlwire.exceptions import NotCompiled

_PACKAGES = Path(__file__).parents[2]
SOURCES = tuple(
    source for name in ("dxlrun", "dxlsim", "dxlwire") for source in sorted(_PACKAGES.glob(f"{name}/*/*.c"))
)
"""Paths of the C files without which no robot runs."""


def missing() -> str:
    """Return a sentence about the first compiled C object that cannot be used; empty if all can."""
    try:
        for source in SOURCES:
            load_compiled(source, ctypes.PyDLL)
    except NotCompiled as error:
        return f"{error}"
    return ""
