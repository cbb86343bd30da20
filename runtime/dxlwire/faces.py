"""Faces: modules that offer names of other modules and import each of them when it is first used."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module


def lazy_face(module: str, source: str) -> tuple[list[str], Callable[[str], object], Callable[[], list[str]]]:
    """Return `__all__`, `__getattr__` and `__dir__` of a face.

    Type checkers read the same lines as this function, so each name stands in one place.

    Args:
        module: Name of the face.
        source: File with a line `from MODULE import NAME as NAME` for each name that the face offers;
            a name may be that of a module.
    """
    with open(source, encoding="utf-8") as lines:
        words = [line.split() for line in lines if line.lstrip().startswith("from dxl") and " as " in line]
    homes = {line[-1]: line[1] for line in words}

    def get(name: str) -> object:
        if name not in homes:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        home = import_module(homes[name])
        # a name that its home has not loaded yet is a module in it
        value: object = getattr(home, name) if hasattr(home, name) else import_module(f"{homes[name]}.{name}")
        setattr(sys.modules[module], name, value)
        return value

    return list(homes), get, lambda: sorted({*vars(sys.modules[module]), *homes})
