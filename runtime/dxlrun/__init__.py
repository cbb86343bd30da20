"""dxlrun: the names for authors of plug-ins and for programs that steer a running robot; nothing else.

`import dxlrun` is light: each name is imported when it is first used, so that neither numpy nor pydantic is
loaded for a command line that only prints its help. The names stand in `__init__.pyi` alone, a line each.
"""

from __future__ import annotations

from importlib import import_module

with open(f"{__file__.rpartition('.')[0]}.pyi", encoding="utf-8") as _names:
    _HOME = {_line.split()[-1]: _line.split()[1] for _line in _names if _line.startswith("from ")}
del _names
__all__ = list(_HOME)


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'dxlrun' has no attribute {name!r}")
    value: object = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
