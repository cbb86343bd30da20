"""Lazy modules: modules that offer names of other modules and import each of these on first use."""

from __future__ import annotations

import sys

TYPE_CHECKING = False  # Importing typing, collections and functools takes longer than the face itself
if TYPE_CHECKING:
    from collections.abc import Callable


def lazy_face(module: str, source: str) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """Return the functions `__getattr__` and `__dir__` of a lazy module; it also has the attribute `__all__`.

    Type checkers read the same stub file, so each name is listed only once. The file is read on first use
    of a name, because most processes import the module only on the way to a submodule.

    Args:
        module: Name of the lazy module.
        source: File with a line `from MODULE import NAME as NAME` for each name of the module; a name may
            be that of a module.
    """

    homes: dict[str, str] = {}

    def read_homes() -> dict[str, str]:
        if not homes:
            with open(source, encoding="utf-8") as file:
                words = [line.split() for line in file if line.lstrip().startswith("from dxl")]
            homes.update({line[-1]: line[1] for line in words if "as" in line})
        return homes

    def get_attribute(name: str) -> object:
        # Imported here, as a Ctrl-C during the import of this module is still Python's own traceback.
        from importlib import import_module

        if name == "__all__":
            return list(read_homes())
        if name not in read_homes():
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        home = import_module(homes[name])
        # A missing attribute is a submodule that its package has not loaded yet.
        value: object = getattr(home, name) if hasattr(home, name) else import_module(f"{homes[name]}.{name}")
        setattr(sys.modules[module], name, value)
        return value

    return get_attribute, lambda: sorted({*vars(sys.modules[module]), *read_homes()})
