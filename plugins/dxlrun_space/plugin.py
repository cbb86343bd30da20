"""Plug-in of the controller in space."""

from __future__ import annotations

from collections.abc import Mapping

from dxlrun import CONTRACT_VERSION, hookimpl


@hookimpl
def dxlrun_contract() -> int:
    """Return the plug-in contract version. This controller is released together with it."""
    return CONTRACT_VERSION


@hookimpl
def dxlrun_controllers() -> Mapping[str, str]:
    """Return the import path of the controller, by its type in the robot file."""
    return {"cartesian_controller": "dxlrun_space.cartesian_controller:CartesianController"}
