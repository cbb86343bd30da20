"""The plan in a log, as far as the analysis reads it."""

from __future__ import annotations

import math
from functools import lru_cache

import msgspec

from dxlrun.control.loop_plan import TOLERATED_SKIPS, ScheduleName
from dxlrun.log.reader import UNREADABLE, Log


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


class LoggedBus(msgspec.Struct):
    """One bus of the plan."""

    name: str = ""
    port: str = ""
    protocol: float | None = None
    baud_rate: int = 0
    latency_ns: int = 0
    return_delay_ns: int = 0
    split: bool = False
    servos: list[LoggedServo] = []


class LoggedJoint(msgspec.Struct):
    """One joint of the plan; its limits in rad/s."""

    name: str
    velocity: float | None = None
    top_speed: float | None = None
    top_effort: float | None = None
    """In the unit of its effort; None: that is a fraction of the maximum."""


class LoggedLoop(msgspec.Struct):
    """The loop of the plan."""

    tolerated_skips: float = TOLERATED_SKIPS
    schedule: ScheduleName = "absolute"
    joints: list[LoggedJoint] = []


class LoggedPlan(msgspec.Struct):
    """Loop and buses; all keys that are not read here are left out."""

    loop: LoggedLoop = msgspec.field(default_factory=LoggedLoop)
    buses: list[LoggedBus] = []

    @property
    def by_name(self) -> dict[str, LoggedBus]:
        """The buses by name."""
        return {bus.name: bus for bus in self.buses}


def plan_of(log: Log) -> LoggedPlan:
    """Return the plan in a log; an empty one where it has none that can be read. It is not to be changed."""
    return _decoded(log.attachments.get("plan.json", b"{}"))


@lru_cache(maxsize=8)
def _decoded(data: bytes) -> LoggedPlan:
    """Return a plan that every slice of a log asks for anew."""
    try:
        return msgspec.json.decode(data, type=LoggedPlan)
    except UNREADABLE:
        return LoggedPlan()
