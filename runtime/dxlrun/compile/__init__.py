"""Compile: a robot file, motions, tables and plug-ins become a plan; every cross check is here.

Lazy, because the guardian and the loop import `dxlrun.plan.robot_plan` and must not pay for pydantic.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dxlrun.compile.robot import Ask, Compiled, compile_files, compile_robot

__all__ = ["Ask", "Compiled", "compile_files", "compile_robot"]


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module("dxlrun.compile.robot"), name)
