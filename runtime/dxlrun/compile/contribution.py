"""Contribution: the share of a feature in a plan, and the stage that creates it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import ClassVar

import msgspec

from dxlrun.compile.joints.joints import CompiledJoint
from dxlrun.compile.joints.urdf import CompiledUrdf
from dxlrun.compile.problems import RobotFile
from dxlrun.control.controllers.plugins import PlugIns
from dxlrun.plan.loop_plan import ControllerPlan, SourcePlan
from dxlrun.plan.mechanics_plan import MechanicsPlan
from dxlrun.plan.recording_plan import RecordingPlan
from dxlsim.simulation_plan import Shown
from dxlwire.bus_plan import DevicePlan
from dxlwire.control_table.device_table import DeviceTable


class Compilation(msgspec.Struct, frozen=True):
    """A robot file with compiled joints, as input for features."""

    file: RobotFile
    """The robot file; it collects problems."""
    plugins: PlugIns
    joints: Mapping[str, CompiledJoint]
    """Joints without mistakes; mistakes in other joints have been reported."""
    body: CompiledUrdf | None
    """The robot's URDF; None if it has none."""


class BusDevice(msgspec.Struct, frozen=True):
    """A node on a bus that is not a servo."""

    bus: str
    plan: DevicePlan
    table: DeviceTable
    simulated: Shown
    """Its states if the bus is simulated."""


class Contribution(msgspec.Struct, frozen=True):
    """The share of one feature in a plan."""

    names: tuple[str, ...] = ()
    """Names of all sources of the feature. Sources with mistakes are included, so that no controller that
    names one of them gets an error."""
    buses: frozenset[str] = frozenset()
    """Buses that the entries of the section name."""
    sources: tuple[SourcePlan, ...] = ()
    """States and commands of the feature in the cycle's record."""
    devices: tuple[BusDevice, ...] = ()
    """Devices that the buses read and write in each cycle."""
    links: Mapping[str, str] = {}
    """Links of the URDF whose orientation the sources measure, by source."""
    texts: Mapping[str, str] = {}
    """Contents of the files that the section names, by path."""
    plan: bytes = b""
    """Further encoded data for the feature's part in the run; see `BusContext.plan`."""
    packages: Mapping[str, str] = {}
    """Packages of plug-ins whose code runs for the feature, with their distributions."""
    mechanics: MechanicsPlan | None = None
    """Assignment of servos to joints, set by one feature only."""
    recording: RecordingPlan | None = None
    """Destination of the log, set by one feature only."""
    policies: Mapping[str, str] = {}
    """Actions of policies, for `dxlrun check`, by key, or by key and group: `on_lost_servo of wheels`."""


class CompileStage(msgspec.Struct, frozen=True):
    """`STAGE` of `compile.py`: called once, after the joints and before the controllers are compiled.

    It checks the feature's section against the rest of the file, and adds every problem to the file.
    """

    FILE: ClassVar[str] = "compile"

    contribute: Callable[[Compilation], Contribution]


def check_source_names(
    file: RobotFile,
    contributions: Mapping[str, Contribution],
    controllers: Iterable[ControllerPlan],
) -> None:
    """Check that joints, controllers with states, and the sources of features have different names.

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
                    f"{source.name} is the name of a {owners[source.name]} already, and both have states",
                    f"give the {source.kind} another name",
                )
            owners.setdefault(source.name, source.kind)
