"""The plan: everything that a run needs, in one frozen tree that is also JSON in the log."""

from __future__ import annotations

from dataclasses import dataclass, field

import msgspec

from dxlrun.control.loop_plan import LoopPlan
from dxlrun.dynamixel.bus_plan import BusPlan


@dataclass(frozen=True, slots=True)
class Plan:
    """A robot, ready to be executed; nothing in it needs the robot file any more."""

    robot: str
    loop: LoopPlan
    buses: tuple[BusPlan, ...]
    exit_timeout_ns: int
    recording_directory: str
    source_file: str
    source_text: str
    """The robot file as it was read."""
    arguments: dict[str, str]
    """The arguments of the robot file as this run took them."""
    included: dict[str, str] = field(default_factory=dict)
    """Text of each file that the robot file includes, by its name seen from there."""
    urdf: str | None = None
    """The robot's URDF as it was read."""
    gateway: bool = True
    """Others may steer the run, over a Unix socket."""

    @property
    def simulated(self) -> bool:
        """True when any bus is simulated."""
        return any(bus.port == "sim" for bus in self.buses)


def to_json(plan: Plan) -> bytes:
    """Encode a plan; bytes are base64."""
    return msgspec.json.encode(plan)


def from_json(data: bytes) -> Plan:
    """Decode a plan; raises msgspec.ValidationError when it is not one."""
    return msgspec.json.decode(data, type=Plan)
