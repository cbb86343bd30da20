"""Every hook that a plug-in can implement: the whole extension surface of dxlrun in one file.

A package offers a plug-in by an entry point of the group `dxlrun`:

    [project.entry-points.dxlrun]
    my_robotics = "my_package.plugin"

The named module implements hooks with `dxlrun.hookimpl`. Hooks are called when a robot is compiled and when
the loop's process loads its controllers, never in the loop.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pluggy

from dxlrun.control.controller import Controller

GROUP = "dxlrun"

hookspec = pluggy.HookspecMarker(GROUP)
hookimpl = pluggy.HookimplMarker(GROUP)


class HookSpecs:
    """The signatures; pluggy checks every implementation against them."""

    @hookspec
    def dxlrun_contract(self) -> int:  # type: ignore[empty-body]  # a signature, never called
        """Return the CONTRACT_VERSION that the plug-in was written for."""

    @hookspec
    def dxlrun_controllers(self) -> Mapping[str, type[Controller[Any]]]:  # type: ignore[empty-body]  # a signature
        """Return the controllers that the robot file can name by `type`."""

    @hookspec
    def dxlrun_servo_models(self) -> Sequence[str | Path]:  # type: ignore[empty-body]  # a signature
        """Return control tables of servos that dxlrun does not know: each a TOML text, or the path of a file.

        The form is that of dxlrun's own files (runtime/dxlrun/control_tables/protocol1), without `extends`;
        the robot file then names the model. A name or a model number that is taken already is an error.
        """
