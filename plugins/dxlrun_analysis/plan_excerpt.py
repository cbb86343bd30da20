"""Types for the robot's plan in a log (plan.json): only the fields that the analysis reads."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import msgspec
from msgspec import structs

from dxlrun import Log
from dxlrun.tooling.logs import UNREADABLE
from dxlrun.tooling.plans import (
    ControllerPlan,
    JointPlan,
    LoopPlan,
    MechanicsPlan,
    SchedulerPlan,
    decode_plan,
)
from dxlwire import is_simulated


class LoggedRegister(msgspec.Struct):
    """A control table item that the robot file sets in a servo's `registers`, with its raw value."""

    name: str
    value: int


class LoggedServo(msgspec.Struct):
    """One servo of the plan in a log: joint, ID, model, and units of its raw values."""

    joint: str = ""
    servo_id: int = -1
    model: str = ""
    rad_per_tick: float = math.tau / 4096
    rad_s_per_tick: float = 0.0
    registers: list[LoggedRegister] = []
    row: int = -1
    name: str = ""  # Own name, if several servos move one joint
    ratio: float = 1.0  # rad (or m) of the joint per rad of the servo

    @property
    def own_name(self) -> str:
        """Name that is unique among servos: its joint, or its own if several servos move one joint."""
        return self.name or self.joint

    @property
    def declared(self) -> dict[str, int]:
        """Raw value of each control table item that the robot file sets in the servo, by item name."""
        return {register.name: register.value for register in self.registers}


class LoggedDevice(msgspec.Struct):
    """One device of the plan in a log: a node on a bus that is not a servo, such as an IMU."""

    name: str = ""
    servo_id: int = -1
    model: str = ""


class LoggedBus(msgspec.Struct):
    """One bus of the plan in a log, with its port, rate, servos and devices."""

    name: str = ""
    port: str = ""
    protocol: float | None = None
    baud_rate: int = 0
    latency_ns: int = 0
    return_delay_ns: int = 0
    servos: list[LoggedServo] = []
    devices: list[LoggedDevice] = []
    noted: bool = False
    """True if the log's metadata say that this bus was simulated. The link to the port of `dxlrun sim` may
    no longer exist."""

    @property
    def simulated(self) -> bool:
        """True if the bus was simulated in the run."""
        return self.noted or is_simulated(self.port)

    @property
    def names(self) -> dict[int, str]:
        """Name of the servo or device with each ID. A servo has its joint's name, or its own."""
        joints = {servo.servo_id: servo.own_name for servo in self.servos}
        return joints | {device.servo_id: device.name for device in self.devices}

    def called(self, servo_id: int) -> tuple[str, str]:
        """Return the name of a servo or device as findings use it, and the name with ID and bus: `knee
        (servo 3 on bus main)`."""
        name = self.names.get(servo_id) or f"servo {servo_id}"
        return name, f"{name} (servo {servo_id} on bus {self.name})"


class Mover(NamedTuple):
    """One servo that moves a certain joint, with its bus."""

    bus: LoggedBus
    servo: LoggedServo
    share: float  # rad (or m) of the joint per rad of the servo, unsigned


NO_LOOP = LoopPlan(0, SchedulerPlan("other", 0, lock_memory=False), (), (), (), None)
"""Empty loop plan, used for a log without a plan."""
UNKNOWN_JOINT = JointPlan("", -math.inf, math.inf, None)


class LoggedPlan(msgspec.Struct):
    """Plan in a log: that of the loop, and the fields of buses and mechanisms that the analysis reads."""

    loop: LoopPlan = NO_LOOP
    buses: list[LoggedBus] = []
    mechanics: MechanicsPlan = MechanicsPlan()
    groups: dict[str, tuple[str, ...]] = {}  # Joints of named groups
    omitted: tuple[str, ...] = ()  # Joints of the robot file that the run omits

    def joint(self, name: str) -> JointPlan:
        """Return a joint by name; for a joint that is not in the plan, a placeholder with its name."""
        unknown = structs.replace(UNKNOWN_JOINT, name=name)
        return next((joint for joint in self.loop.joints if joint.name == name), unknown)

    def controller(self, name: str) -> ControllerPlan:
        """Return a controller by name; for one that is not in the plan, a placeholder with its name."""
        unknown = ControllerPlan(name, "", "", "{}", (), (), (), active=False, every=1)
        return next((one for one in self.loop.controllers if one.name == name), unknown)

    @property
    def movers(self) -> dict[str, tuple[Mover, ...]]:
        """Servos that move each joint, by joint name; several if the joint is part of a mechanism."""
        servos = {servo.row: (bus, servo) for bus in self.buses for servo in bus.servos}
        # Use names because the plan of a damaged log may lack the joints.
        found: dict[str, tuple[Mover, ...]] = {
            servo.joint: (Mover(bus, servo, servo.ratio),)
            for bus in self.buses
            for servo in bus.servos
            if not servo.name
        }
        for one in self.mechanics.mechanisms(len(self.loop.joints)):
            if not servos.keys() >= {*one.servos}:
                continue
            for joint, factors in zip(one.joints, one.matrix, strict=True):
                found[self.loop.joints[joint].name] = tuple(
                    Mover(*servos[row], abs(factor) * servos[row][1].ratio)
                    for row, factor in zip(one.servos, factors, strict=True)
                    if factor
                )
        return found

    def is_simulated(self, subject: str) -> bool:
        """Return whether the part that a finding accuses is simulated, so that nothing on it can be checked.

        In a robot with a simulated bus, every subject counts as simulated unless the plan has it on a real
        bus, as a controller, or as a source that a process samples. If a controller and a bus have the same
        name, the name means the bus.
        """
        if not any(bus.simulated for bus in self.buses):
            return False
        real = {one.name for one in self.loop.controllers} | self.sampled
        real -= self.by_name.keys()
        for bus in self.buses:
            if not bus.simulated:
                real |= {bus.name, *bus.names.values(), *(servo.joint for servo in bus.servos)}
        of_bus = subject.rpartition(" ")[0]  # `main 7` is a servo that is not in the plan
        return subject not in real and of_bus not in real

    @property
    def sampled(self) -> set[str]:
        """Names of the sensors that separate processes sample, because they are not on a bus."""
        on_bus = {device.name for bus in self.buses for device in bus.devices}
        return {source.name for source in self.loop.sources} - on_bus

    @property
    def by_name(self) -> dict[str, LoggedBus]:
        """Buses of the plan by name."""
        return {bus.name: bus for bus in self.buses}


def plan_of(log: Log) -> LoggedPlan:
    """Return the plan in a log, or an empty plan if none can be read. Callers must not modify it."""
    noted = log.metadata.get("run", {}).get("simulated", "")
    return _decoded(log.attachments.get("plan.json", b"{}"), noted)


@lru_cache(maxsize=8)
def _decoded(data: bytes, noted: str) -> LoggedPlan:
    """Decode a plan, and mark the simulated buses; `noted` has their names, separated by spaces.

    The result is cached because every slice of a log requests the plan.
    """
    try:
        plan = decode_plan(data, LoggedPlan)
    except UNREADABLE:
        return LoggedPlan()
    for bus in plan.buses:
        bus.noted = bus.name in noted.split()
    return plan
