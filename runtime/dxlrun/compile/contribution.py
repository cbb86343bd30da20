"""Contribution: the share of a feature in a plan, and the stage that asks for it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import ClassVar

import msgspec

from dxlrun.compile.joints.joints import CompiledJoint
from dxlrun.compile.joints.urdf import CompiledUrdf
from dxlrun.compile.problems import RobotFile
from dxlrun.control.controllers.plugins import PlugIns
from dxlrun.description.robot import WrittenPolicy
from dxlrun.plan.loop_plan import ControllerPlan, SourcePlan
from dxlrun.plan.mechanics_plan import MechanicsPlan
from dxlrun.plan.policy_plan import GroupPolicy
from dxlrun.plan.recording_plan import RecordingPlan
from dxlsim.simulation_plan import Shown
from dxlwire.bus_plan import DevicePlan
from dxlwire.control_table.device_table import DeviceTable


class Compilation(msgspec.Struct, frozen=True):
    """A robot file whose joints are compiled, as features see it."""

    file: RobotFile
    """Problems are added to it."""
    plugins: PlugIns
    joints: Mapping[str, CompiledJoint]
    """Joints without mistakes: one with a mistake is reported already."""
    body: CompiledUrdf | None
    """The robot's URDF; None if it has none."""


class BusDevice(msgspec.Struct, frozen=True):
    """Something on a bus that is not a servo."""

    bus: str
    plan: DevicePlan
    table: DeviceTable
    simulated: Shown
    """Its states when the bus is simulated."""


class PolicyEntry(msgspec.Struct, frozen=True):
    """Policy of a feature."""

    name: str
    """Its key, or the key and a group: `on_lost_servo of wheels`."""
    does: str
    """Its action while the run continues, as `dxlrun check` shows it."""
    steps: WrittenPolicy | None = None
    """Steps by which it ends the run, as the file has them, where they are not `hold`; None: it has none."""


class Contribution(msgspec.Struct, frozen=True):
    """The share of one feature in a plan."""

    names: tuple[str, ...] = ()
    """Names of all its sources, also of those that a mistake leaves out: no controller is blamed for naming
    one."""
    buses: frozenset[str] = frozenset()
    """Buses that the entries of its section name."""
    sources: tuple[SourcePlan, ...] = ()
    """Its states and commands in the cycle's record."""
    devices: tuple[BusDevice, ...] = ()
    """Devices that its buses exchange data with in each cycle."""
    links: Mapping[str, str] = {}
    """Links of the URDF whose orientation its sources have, by source."""
    texts: Mapping[str, str] = {}
    """Contents of the files that its section names, by path."""
    plan: bytes = b""
    """Whatever its part in the run needs beside that, encoded; `BusContext.plan` has it."""
    packages: Mapping[str, str] = {}
    """Packages of plug-ins whose code runs for it, with their distributions."""
    mechanics: MechanicsPlan | None = None
    """Which servos move which joints, of the feature that knows."""
    recording: RecordingPlan | None = None
    """Where the log is written, of the feature that knows."""
    policies: tuple[PolicyEntry, ...] = ()
    """Its policies, as `dxlrun check` shows them."""
    group_policies: tuple[GroupPolicy, ...] = ()
    """Groups of joints with a policy of their own for lost servos."""


class CompileStage(msgspec.Struct, frozen=True):
    """`STAGE` of `compile.py`: called once, when the joints are compiled and before the controllers are.

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
        file: Robot file.
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
