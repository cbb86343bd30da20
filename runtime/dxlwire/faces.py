"""Faces: modules that offer names of other modules and import each of them when it is first used."""

from __future__ import annotations

import sys
from importlib import import_module

TYPE_CHECKING = False  # typing, collections and functools take longer to import than a face
if TYPE_CHECKING:
    from collections.abc import Callable


def lazy_face(module: str, source: str) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` of a face; its `__all__` is an attribute, too.

    Type checkers read the same lines as this function, so each name stands in one place. They are read when
    the first name is used: most processes import a face on the way to a module below it.

    Args:
        module: Name of the face.
        source: File with a line `from MODULE import NAME as NAME` for each name that the face offers;
            a name may be that of a module.
    """

    homes: dict[str, str] = {}

    def read_homes() -> dict[str, str]:
        if not homes:
            with open(source, encoding="utf-8") as file:
                words = [line.split() for line in file if line.lstrip().startswith("from dxl")]
            homes.update({line[-1]: line[1] for line in words if "as" in line})
        return homes

    def get(name: str) -> object:
        if name == "__all__":
            return list(read_homes())
        if name not in read_homes():
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        home = import_module(homes[name])
        # a name that its home has not loaded yet is a module in it
        value: object = getattr(home, name) if hasattr(home, name) else import_module(f"{homes[name]}.{name}")
        setattr(sys.modules[module], name, value)
        return value

    return get, lambda: sorted({*vars(sys.modules[module]), *read_homes()})
