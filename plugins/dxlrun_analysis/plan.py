"""The plan in a log, as far as the analysis reads it."""

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
    """A register that the robot file declares."""

    name: str
    value: int


class LoggedServo(msgspec.Struct):
    """One servo of the plan."""

    joint: str = ""
    servo_id: int = -1
    model: str = ""
    rad_per_tick: float = math.tau / 4096
    rad_s_per_tick: float = 0.0
    registers: list[LoggedRegister] = []
    row: int = -1
    name: str = ""  # Its own, where several servos move one joint
    ratio: float = 1.0  # rad of its joint, or m, for each rad of the servo

    @property
    def own_name(self) -> str:
        """A name that no other servo has."""
        return self.name or self.joint

    @property
    def declared(self) -> dict[str, int]:
        """The integer on the wire that the robot file gives an item, by item."""
        return {register.name: register.value for register in self.registers}


class LoggedDevice(msgspec.Struct):
    """One device of the plan: on a bus, and no servo."""

    name: str = ""
    servo_id: int = -1
    model: str = ""


class LoggedBus(msgspec.Struct):
    """One bus of the plan."""

    name: str = ""
    port: str = ""
    protocol: float | None = None
    baud_rate: int = 0
    latency_ns: int = 0
    return_delay_ns: int = 0
    servos: list[LoggedServo] = []
    devices: list[LoggedDevice] = []
    noted: bool = False
    """The run noted that it is simulated: the link to the port of `dxlrun sim` may be gone since."""

    @property
    def simulated(self) -> bool:
        """It has no real servos."""
        return self.noted or is_simulated(self.port)

    @property
    def names(self) -> dict[int, str]:
        """The servo, as its joint is called or by its own name, or the device of each ID."""
        joints = {servo.servo_id: servo.own_name for servo in self.servos}
        return joints | {device.servo_id: device.name for device in self.devices}

    def called(self, servo_id: int) -> tuple[str, str]:
        """Return what findings call a servo: its name, and the same with its ID and its bus."""
        name = self.names.get(servo_id) or f"servo {servo_id}"
        return name, f"{name} (servo {servo_id} on bus {self.name})"


class Mover(NamedTuple):
    """A servo that moves a joint."""

    bus: LoggedBus
    servo: LoggedServo
    share: float  # rad of the joint, or m, for each rad of the servo, without its sign


NO_LOOP = LoopPlan(0, SchedulerPlan("other", 0, lock_memory=False), (), (), (), None)
"""Of a log without a plan."""
UNKNOWN_JOINT = JointPlan("", -math.inf, math.inf, None)


class LoggedPlan(msgspec.Struct):
    """The loop as it was planned, and of the buses what is read here."""

    loop: LoopPlan = NO_LOOP
    buses: list[LoggedBus] = []
    mechanics: MechanicsPlan = MechanicsPlan()

    def joint(self, name: str) -> JointPlan:
        """Return a joint; of one that the plan does not have only its name is known."""
        unknown = structs.replace(UNKNOWN_JOINT, name=name)
        return next((joint for joint in self.loop.joints if joint.name == name), unknown)

    def controller(self, name: str) -> ControllerPlan:
        """Return a controller; of one that the plan does not have only its name is known."""
        unknown = ControllerPlan(name, "", "", "{}", (), (), (), active=False, every=1)
        return next((one for one in self.loop.controllers if one.name == name), unknown)

    @property
    def movers(self) -> dict[str, tuple[Mover, ...]]:
        """The servos that move each joint, by its name."""
        servos = {servo.row: (bus, servo) for bus in self.buses for servo in bus.servos}
        # by name, as the plan of a damaged log may lack the joints
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
        """Return whether what a finding accuses is simulated.

        In a robot with a simulated bus all is that the plan does not have elsewhere: on a real bus, as a
        controller or a sensor. A controller may have the name of its bus: the bus is meant then.
        """
        if not any(bus.simulated for bus in self.buses):
            return False
        real = {one.name for one in self.loop.controllers} | self.sensors
        real -= self.by_name.keys()
        for bus in self.buses:
            if not bus.simulated:
                real |= {bus.name, *bus.names.values(), *(servo.joint for servo in bus.servos)}
        of_bus = subject.rpartition(" ")[0]  # `main 7`: a servo that the plan does not have
        return subject not in real and of_bus not in real

    @property
    def sensors(self) -> set[str]:
        """Names of the sources that are sampled by processes of their own."""
        return {one.name for one in self.loop.sources if one.kind == "sensor"}

    @property
    def by_name(self) -> dict[str, LoggedBus]:
        """The buses by name."""
        return {bus.name: bus for bus in self.buses}


def plan_of(log: Log) -> LoggedPlan:
    """Return the plan in a log; an empty one where it has none that can be read. It is not to be changed."""
    noted = log.metadata.get("run", {}).get("simulated", "")
    return _decoded(log.attachments.get("plan.json", b"{}"), noted)


@lru_cache(maxsize=8)
def _decoded(data: bytes, noted: str) -> LoggedPlan:
    """Return a plan that every slice of a log asks for anew, with the buses that were noted as simulated."""
    try:
        plan = decode_plan(data, LoggedPlan)
    except UNREADABLE:
        return LoggedPlan()
    for bus in plan.buses:
        bus.noted = bus.name in noted.split()
    return plan
