"""Every hook that a plug-in can implement: the whole extension surface of dxlrun in one file.

A package offers a plug-in by an entry point of the group `dxlrun`:

    [project.entry-points.dxlrun]
    my_robotics = "my_package.plugin"

The named module implements hooks with `dxlrun.hookimpl`. Hooks are called when a robot is compiled and when
the loop's process loads its controllers, never in the loop; `dxlrun_overrun` alone is gathered then, and
called as a plain function by the loop. A class, and the function of a command, may be named by its place
(`my_package.walk:WalkController`): it is imported when a robot file or a command line uses it.

What moves the bodies of simulated servos is an entry point of the group `dxlrun.physics`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import pluggy

from dxlrun.installed_plugins import GROUP

if TYPE_CHECKING:  # the verbs of a package need neither numpy nor pydantic
    from dxlrun.contract.controller import Controller
    from dxlrun.contract.sensor import Sensor
    from dxlrun.features.feature import Feature

CONTRACT_VERSION = 4
"""Grows when what a controller may use grows, or one written for the version before would misbehave: 2 has
references, reads, topics, goals and live parameters, 3 has motors and kept state, 4 has states of
devices, sensors and controllers, commands of devices, servos, URDF and mismatches; controllers for 1 to 3
work."""


hookspec = pluggy.HookspecMarker(GROUP)
hookimpl = pluggy.HookimplMarker(GROUP)


class Command(NamedTuple):
    """A verb of the command line, as in `dxlrun VERB`."""

    name: str
    place: str
    """`module:function`, or `module:app` of a cyclopts App; imported when the verb is used."""
    help: str = ""
    """One line, for `dxlrun --help`; a verb that comes with dxlrun has it in its docstring alone."""
    group: str = "Other commands"
    """The heading under which the help shows it: `Robots that run`, `Robot files`, `Servos`, `Logs`,
    `Experiments`, `Developing`, or one of its own."""


class HookSpecs:
    """The signatures; pluggy checks every implementation against them."""

    @hookspec
    def dxlrun_contract(self) -> int:  # type: ignore[empty-body]  # a signature, never called
        """Return the CONTRACT_VERSION that the plug-in was written for."""

    @hookspec
    def dxlrun_controllers(self) -> Mapping[str, type[Controller[Any]] | str]:  # type: ignore[empty-body]  # a signature
        """Return the controllers that the robot file can name by `type`."""

    @hookspec
    def dxlrun_sensors(self) -> Mapping[str, type[Sensor[Any]] | str]:  # type: ignore[empty-body]  # a signature
        """Return the sensors that the robot file can name by `type`."""

    @hookspec
    def dxlrun_commands(self) -> Sequence[Command]:  # type: ignore[empty-body]  # a signature
        """Return the verbs that the package adds to the command line; import nothing heavy for it."""

    @hookspec
    def dxlrun_features(self) -> Sequence[Feature]:  # type: ignore[empty-body]  # a signature
        """Return the features of the package: sections that it adds to the robot file.

        `Feature("lights", "my_package.lights")` has the files of the section `lights` in that package; see
        `dxlrun.tooling.features`. Import nothing heavy for it: the stage that needs a file imports it.
        """

    @hookspec
    def dxlrun_servo_models(self) -> Sequence[str | Path]:  # type: ignore[empty-body]  # a signature
        """Return control tables of servos and of other devices that dxlrun does not know.

        Each is a TOML text, or the path of a file, in the form of dxlrun's own files
        (dxlwire/control_table/tables/protocol1, tables/devices), without `extends`; one that describes a
        device has `kind = "device"`. The robot file then names the model. A name or a model number that is
        taken already is an error.
        """

    @hookspec
    def dxlrun_overrun(
        self, cycle: int, scheduled_ns: int, actual_ns: int
    ) -> Literal["skip", "catch_up", "stop"] | None:
        """Decide what becomes of `cycle`, which was due at `scheduled_ns` and can begin at `actual_ns` only.

        Times in ns of the loop's clock. `skip`, `catch_up` and `stop` mean what they do under
        `loop: {overrun: ...}`; None leaves the decision to the next plug-in, and at last to the robot file.
        Called in the loop, once for each late cycle: return at once, and allocate nothing that stays. What it
        raises, or another answer, becomes an event, and it is not asked again in this run.
        """
