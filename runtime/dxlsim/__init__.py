"""Simulated servos on simulated buses, with packet code of their own.

They share only the control tables with the runtime, so that each is the judge of the other. Physics beyond a
joint's shaft belongs in plug-ins such as `dxlrun_mujoco`.

Each name is imported when it is first used, so that a program that only describes servos loads nothing that
simulates them. The names are in `__init__.pyi` alone, a line each.
"""

from __future__ import annotations

from importlib import import_module

with open(f"{__file__.rpartition('.')[0]}.pyi", encoding="utf-8") as _names:
    _HOME = {_line.split()[-1]: _line.split()[1] for _line in _names if _line.startswith("from ")}
del _names
__all__ = list(_HOME)


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'dxlsim' has no attribute {name!r}")
    value: object = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
