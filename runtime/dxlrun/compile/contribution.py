"""Contribution: what one feature (such as devices or sensors) adds to the plan of a robot at compilation."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, ClassVar

import msgspec

# Only names of types: a monitor in the same module brings this one into the loop's process.
if TYPE_CHECKING:
    from dxlrun.compile.joints.compiled_joints import CompiledJoint
    from dxlrun.compile.joints.compiled_urdf import CompiledUrdf
    from dxlrun.compile.problems import RobotFile
    from dxlrun.control.controllers.plugin_loading import PlugIns
    from dxlrun.plan.loop_plan import ControllerPlan, SourcePlan
    from dxlrun.plan.mechanics_plan import MechanicsPlan
    from dxlrun.plan.recording_plan import RecordingPlan
    from dxlsim.simulation_plan import DeviceReadings
    from dxlwire.bus_plan import DevicePlan
    from dxlwire.control_table.device_table import DeviceTable


class Compilation(msgspec.Struct, frozen=True):
    """Input of a feature's compilation: the robot file, with joints, plug-ins and URDF already compiled."""

    file: RobotFile
    """The robot file; the feature adds the problems that it finds to this object."""
    plugins: PlugIns
    joints: Mapping[str, CompiledJoint]
    """Compiled joints by name, without those that have mistakes (already reported)."""
    body: CompiledUrdf | None
    """The robot's compiled URDF; None if the file names none or it cannot be read."""


class BusDevice(msgspec.Struct, frozen=True):
    """A device on a bus, such as an IMU board: a node with an ID that is not a servo."""

    bus: str
    plan: DevicePlan
    table: DeviceTable
    simulated: DeviceReadings
    """States that the device has if its bus is simulated."""


class Contribution(msgspec.Struct, frozen=True):
    """Everything that one feature adds to the plan: sources, bus devices, files, packages and policies."""

    names: tuple[str, ...] = ()
    """Names of all sources of the feature, also of those with mistakes, so that a controller that reads one
    does not get a second error."""
    buses: frozenset[str] = frozenset()
    """Buses that the entries of the feature's section name; the others may count as unused."""
    sources: tuple[SourcePlan, ...] = ()
    """States and commands that the feature adds to the record of each cycle."""
    devices: tuple[BusDevice, ...] = ()
    """Devices that the buses read and write in each cycle."""
    links: Mapping[str, str] = {}
    """Link of the URDF whose orientation a source measures, by the name of the source."""
    texts: Mapping[str, str] = {}
    """Contents of the files that the feature's section names, by path; they are logged with the robot
    file."""
    plan: bytes = b""
    """Encoded data for the feature's code in the run, which gets it as `BusContext.plan`; empty: none."""
    packages: Mapping[str, str] = {}
    """Python packages of plug-ins that the feature runs; package name to distribution name."""
    mechanics: MechanicsPlan | None = None
    """Assignment of servos to joints, if some joints have several servos; only one feature may set it."""
    recording: RecordingPlan | None = None
    """Folder and settings of the log; only one feature may set it."""
    policies: Mapping[str, str] = {}
    """Texts for `dxlrun check` that say what the feature's policies do, by `policy` or `policy of group`."""


class CompileStage(msgspec.Struct, frozen=True):
    """Hook `STAGE` in a feature's `compile.py`, called once between compiling joints and controllers.

    It checks the feature's section against the rest of the file, and adds every problem to the file.
    """

    FILE: ClassVar[str] = "compile"

    contribute: Callable[[Compilation], Contribution]


def check_source_names(
    file: RobotFile,
    contributions: Mapping[str, Contribution],
    controllers: Iterable[ControllerPlan],
) -> None:
    """Add an error for each source that has the name of a joint, a controller with states or another source.

    Args:
        file: Robot file; collects the problems.
        contributions: Contribution of each feature, by the name of its section.
        controllers: All controllers of the file.
    """
    owners = dict.fromkeys(file.robot.joints, "joint")
    for plan in controllers:
        if plan.provides:
            owners.setdefault(plan.name, "controller")
    for section, contribution in contributions.items():
        for source in contribution.sources:
            if source.name in owners:
                file.error(
                    file.key(section, source.name),
                    f"{source.name} is already the name of a {owners[source.name]} with states",
                    f"rename the {source.kind}",
                )
            owners.setdefault(source.name, source.kind)
