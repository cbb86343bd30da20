"""Hooks: all hooks that a plug-in can implement, which are the extension points of dxlrun.

A package offers a plug-in with an entry point of the group `dxlrun`:

    [project.entry-points.dxlrun]
    my_robotics = "my_package.plugin"

The named module implements hooks with `dxlrun.hookimpl`. Hooks are called when a robot is compiled and when
the loop's process loads its controllers. They are not called in the loop, except for `dxlrun_overrun`. A
class, or the function of a command, may be given as an import path (`my_package.walk:WalkController`). It is
imported when a robot file or a command line uses it.

Physics of the bodies of simulated servos are entry points of the group `dxlrun.physics`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import pluggy

from dxlrun.installed_plugins import GROUP

if TYPE_CHECKING:  # the verbs of a package need neither numpy nor pydantic
    from dxlrun import Sensor
    from dxlrun.contract.controller import Controller
    from dxlrun.description.other_files import FileFormat
    from dxlrun.features.feature import Feature

CONTRACT_VERSION = 4
"""Version of the contract. It increases with additions, and with changes that break existing controllers.
Version 2 has references, reads, topics, goals and live parameters; 3 has motors and kept state; 4 has states
of devices, sensors and controllers, commands of devices, servos, URDF and mismatches. Controllers for 1 to 3
work."""


hookspec = pluggy.HookspecMarker(GROUP)
hookimpl = pluggy.HookimplMarker(GROUP)


class Command(NamedTuple):
    """A verb of the command line: `dxlrun VERB`."""

    name: str
    place: str
    """Import path: `module:function`, or `module:app` for a cyclopts App. Imported when the verb is used."""
    help: str = ""
    """One line for `dxlrun --help`; verbs of dxlrun itself have it in their docstrings."""
    group: str = "Other commands"
    """Heading in the help: `Robots that run`, `Robot files`, `Servos`, `Logs`, `Experiments`, `Developing`,
    or another one."""


class HookSpecs:
    """Signatures of the hooks, against which pluggy checks all implementations."""

    @hookspec
    def dxlrun_contract(self) -> int:  # type: ignore[empty-body]  # a signature, never called
        """Return the CONTRACT_VERSION that the plug-in was written for."""

    @hookspec
    def dxlrun_controllers(self) -> Mapping[str, type[Controller[Any]] | str]:  # type: ignore[empty-body]  # a signature
        """Return controller classes or their import paths, by `type` in the robot file."""

    @hookspec
    def dxlrun_sensors(self) -> Mapping[str, type[Sensor[Any]] | str]:  # type: ignore[empty-body]  # a signature
        """Return sensor classes or their import paths, by `type` in the robot file."""

    @hookspec
    def dxlrun_commands(self) -> Sequence[Command]:  # type: ignore[empty-body]  # a signature
        """Return the verbs that the package adds to the command line. The hook must be fast to import."""

    @hookspec
    def dxlrun_features(self) -> Sequence[Feature]:  # type: ignore[empty-body]  # a signature
        """Return the features of the package, which add sections to the robot file.

        `Feature("lights", "my_package.lights")` adds the section `lights`, whose files are in that package;
        see `dxlrun.tooling.features`. The hook must be fast to import: each stage imports the file that it
        needs.
        """

    @hookspec
    def dxlrun_formats(self) -> Sequence[FileFormat]:  # type: ignore[empty-body]  # a signature
        """Return formats of other programs' files, for `dxlrun import` and for the refusals of all commands.

        The hook is called when a file was refused, or is imported. A format without a converter names a file
        and the next step:

            from dxlrun import hookimpl
            from dxlrun.tooling.files import FileFormat

            @hookimpl
            def dxlrun_formats() -> list[FileFormat]:
                is_bvh = lambda content: content.data.startswith(b"HIERARCHY")
                return [FileFormat("a motion capture", is_bvh, "retarget it, and import its joints as CSV")]
        """

    @hookspec
    def dxlrun_servo_models(self) -> Sequence[str | Path]:  # type: ignore[empty-body]  # a signature
        """Return control tables of additional servos and devices.

        Each table is a TOML text or the path of a TOML file, in the format of dxlrun's own tables
        (dxlwire/control_table/tables/protocol1, tables/devices), without `extends`. The table of a device has
        `kind = "device"`. The robot file refers to a table by its model. Names and model numbers must be
        unique.
        """

    @hookspec
    def dxlrun_overrun(
        self, cycle: int, scheduled_ns: int, actual_ns: int
    ) -> Literal["skip", "catch_up", "stop"] | None:
        """Return the overrun policy for a late cycle.

        The loop calls it once for each late cycle, so it must return quickly and not allocate memory that
        stays. After an exception or an invalid answer, an event is logged and the hook is not called again.

        Args:
            cycle: Number of the late cycle.
            scheduled_ns: Its deadline, ns of the loop's clock.
            actual_ns: Earliest time at which it can begin, ns of the loop's clock.

        Returns:
            A policy with the meaning of `loop: {overrun: ...}`, or None to leave the decision to the next
            plug-in and finally to the robot file.
        """
