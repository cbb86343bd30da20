"""The plan: everything that a run needs, in one frozen tree that is also JSON in the log."""

from __future__ import annotations

from base64 import b64encode
from typing import Any, Literal, TypeVar

import msgspec

from dxlrun.description.frames.tree import FramesPlan
from dxlrun.errors import Mark
from dxlrun.features.feature import Feature
from dxlrun.plan.loop_plan import LoopPlan, ScheduledCommand
from dxlrun.plan.mechanics_plan import MechanicsPlan
from dxlrun.plan.recording_plan import RecordingPlan
from dxlsim.motor_model import MotorModel
from dxlsim.simulation_plan import AdapterConfig, Load, ServoTimes, Shown
from dxlwire.bus_plan import BusPlan, ServoPlan

Parts = TypeVar("Parts")


class SimulationPlan(msgspec.Struct, frozen=True):
    """What only simulated servos and buses need."""

    loads: dict[str, Load] = {}  # By joint, as it is felt there; one that is missing moves nothing but itself
    adapters: dict[str, AdapterConfig] = {}  # By bus
    times: dict[str, ServoTimes] = {}
    """By servo (`own_name`); one that is missing is as quick as a servo can be."""
    physics: Literal["independent", "mujoco"] = "independent"
    motors: dict[str, MotorModel] = {}
    """By servo (`own_name`); one that is missing has the motor that the simulation knows of its model."""
    devices: dict[str, Shown] = {}  # By device


class Plan(msgspec.Struct, frozen=True):
    """A robot, ready to be executed; nothing in it needs the robot file any more."""

    robot: str
    loop: LoopPlan
    buses: tuple[BusPlan, ...]
    exit_timeout_ns: int
    recording: RecordingPlan
    source_file: str
    source_text: str  # The robot file as it was read
    arguments: dict[str, str]  # The arguments of the robot file as this run took them
    included: dict[str, str] = {}
    """Text of each file that the robot file includes, or names as a motor or a controller, by its name seen
    from there."""
    played: dict[str, str] = {}
    """Text of each motion file that is played, by its name seen from the robot file."""
    frames: FramesPlan | None = None
    """What moves the robot's frames, and how they are logged; None: it has no URDF."""
    simulation: SimulationPlan = SimulationPlan()
    groups: dict[str, tuple[str, ...]] = {}  # Names that stand for some joints
    gateway: bool = True  # Others may steer the run, over a Unix socket
    packages: dict[str, str] = {}
    """Packages of plug-ins that run in this robot, with their distributions: those of its controllers,
    sensors, servo models, physics and hooks of the loop."""
    mechanics: MechanicsPlan = MechanicsPlan()
    """Which servos move which joints; empty: each joint has one servo."""

    @property
    def features(self) -> tuple[Feature, ...]:
        """Features that take part in the run."""
        return self.loop.features

    @property
    def feature_plans(self) -> dict[str, bytes]:
        """What a feature compiled for its own part in the run, by its name."""
        return self.loop.feature_plans

    @property
    def urdf(self) -> str | None:
        """The robot's URDF as it was read; None: the robot file names none."""
        return self.loop.urdf

    @property
    def servos_by_joint(self) -> dict[str, tuple[tuple[BusPlan, ServoPlan], ...]]:
        """The servos that move each joint, with their buses, by its name."""
        servos = {servo.row: (bus, servo) for bus in self.buses for servo in bus.servos}
        return {
            joint.name: tuple(servos[each] for each in self.mechanics.servo_rows(row) if each in servos)
            for row, joint in enumerate(self.loop.joints)
        }

    @property
    def simulated(self) -> bool:
        """True when any bus is simulated."""
        return any(bus.port == "sim" for bus in self.buses)


class MotionPart(msgspec.Struct, frozen=True):
    """One part of a motion, ready for the loop; times since the loop's first deadline."""

    file: str
    controller: str
    start_ns: int
    end_ns: int
    points: int
    commands: tuple[ScheduledCommand, ...]
    mark: Mark

    @property
    def motion_end_ns(self) -> int:
        """End of its way, from which on its goal is judged; at the latest at `end_ns`."""
        goal = self.commands[0].goal
        return self.end_ns if goal is None else goal.end_ns


def to_json(plan: Plan) -> bytes:
    """Encode a plan; bytes are base64."""
    import msgspec  # not above: to check a robot needs no JSON

    return msgspec.json.encode(plan)


def from_json(data: bytes) -> Plan:
    """Decode a plan; raises msgspec.ValidationError when it is not one."""
    return decode_plan(data, Plan)


def decode_plan(data: bytes, parts: type[Parts]) -> Parts:
    """Decode those parts of a plan that a struct has; raises msgspec.MsgspecError when it is not a plan.

    Logs of format 8 say `linear`, a boolean, of joints and servos, in place of their unit. Quotes inside a
    string are escaped in JSON, so only a key matches.
    """
    import msgspec  # not above: to check a robot needs no JSON

    return msgspec.json.decode(_move_sensors(data.replace(b'"linear":true', b'"unit":"m"')), type=parts)


def _move_sensors(data: bytes) -> bytes:
    """Return a plan with its sensors where they are today; logs of earlier versions have them in the loop."""
    if b'"sensors":[{' not in data:
        return data
    tree = msgspec.json.decode(data, type=dict[str, Any])
    sensors = msgspec.json.encode(tree["loop"].pop("sensors", []))
    tree["loop"].setdefault("feature_plans", {})["sensors"] = b64encode(sensors).decode()
    return msgspec.json.encode(tree)
