"""Hooks that dxlrun finds by the entry point in pyproject.toml"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dxlrun import Controller, hookimpl
from dxlrun_easing.easing import Easing


@hookimpl
def dxlrun_contract() -> int:
    """Return the plug-in contract version as a number, not as CONTRACT_VERSION, which changes with dxlrun."""
    return 4


@hookimpl
def dxlrun_controllers() -> Mapping[str, type[Controller[Any]]]:
    """Return the controller classes by their type in the robot file."""
    return {"easing_position_controller": Easing}
