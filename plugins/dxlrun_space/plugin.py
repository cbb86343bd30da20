"""Plug-in of the controller in space, of poses in the robot file, and of `dxlrun reach`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from dxlrun import CONTRACT_VERSION, Command, hookimpl

if TYPE_CHECKING:
    from dxlrun.tooling.features import Feature


@hookimpl
def dxlrun_contract() -> int:
    """Return the plug-in contract version. This controller is released together with it."""
    return CONTRACT_VERSION


@hookimpl
def dxlrun_controllers() -> Mapping[str, str]:
    """Return the import path of the controller, by its type in the robot file."""
    return {"cartesian_controller": "dxlrun_space.cartesian_controller:CartesianController"}


@hookimpl
def dxlrun_features() -> Sequence[Feature]:
    """Return the form of poses with the key `tip`."""
    # Imported here because most commands read no robot file.
    from dxlrun.tooling.features import Feature

    return [Feature("tip", "dxlrun_space")]


@hookimpl
def dxlrun_commands() -> Sequence[Command]:
    """Return the command, whose function is imported on use."""
    return [Command("reach", "dxlrun_space.reach:draw_reach", group="Robot files")]
