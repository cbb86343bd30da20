"""Robot plan: all data of a run in one frozen tree, which is JSON in the log."""

from __future__ import annotations

from base64 import b64encode
from typing import Any, Literal, TypeVar

import msgspec

from dxlrun.description.frames.tree import FramesPlan
from dxlrun.errors import Mark
from dxlrun.features import FEATURES
from dxlrun.features.feature import Feature, SolvedPose
from dxlrun.plan.loop_plan import LoopPlan, ScheduledCommand
from dxlrun.plan.mechanics_plan import MechanicsPlan
from dxlrun.plan.recording_plan import RecordingPlan
from dxlsim.motor_model import MotorModel
from dxlsim.simulation_plan import AdapterConfig, DeviceReadings, Load, ServoTimes
from dxlwire.bus_plan import BusPlan, ServoPlan

Parts = TypeVar("Parts")


class SimulationPlan(msgspec.Struct, frozen=True):
    """Data for simulated servos and buses only."""

    loads: dict[str, Load] = {}  # Load at each joint, by joint; default: no load
    adapters: dict[str, AdapterConfig] = {}  # Adapters by bus
    times: dict[str, ServoTimes] = {}
    """Delays by servo (`own_name`); default: the shortest delays of a servo."""
    physics: Literal["independent", "mujoco"] = "independent"
    motors: dict[str, MotorModel] = {}
    """Motors by servo (`own_name`); default: the simulation's motor for the model."""
    devices: dict[str, DeviceReadings] = {}  # Simulated states by device


class Plan(msgspec.Struct, frozen=True):
    """Compiled robot with all data of a run; complete without the robot file. It is JSON in the log."""

    robot: str
    loop: LoopPlan
    buses: tuple[BusPlan, ...]
    exit_timeout_ns: int
    recording: RecordingPlan
    source_file: str
    source_text: str  # Text of the robot file
    arguments: dict[str, str]  # Values of the robot file's arguments in this run
    included: dict[str, str] = {}
    """Text of each file that the robot file includes, or names as a motor or a controller, by path relative
    to the robot file."""
    played: dict[str, str] = {}
    """Text of each played motion file, by path relative to the robot file."""
    frames: FramesPlan | None = None
    """Kinematics and logging of the robot's frames; None: no URDF."""
    simulation: SimulationPlan = SimulationPlan()
    groups: dict[str, tuple[str, ...]] = {}  # Joints of named groups
    omitted: tuple[str, ...] = ()
    """Joints of the robot file that this run omits, then groups that have no other joint."""
    gateway: bool = True  # True if clients may connect over a Unix socket
    packages: dict[str, str] = {}
    """Distributions of the plug-in packages that run in this robot, by package: controllers, sensors, servo
    models, physics and hooks of the loop."""
    poses: dict[str, SolvedPose] = {}
    """Poses by name, which policies, motions and clients use."""
    mechanics: MechanicsPlan = MechanicsPlan()
    """Assignment of servos to joints; empty: each joint has one servo."""

    @property
    def features(self) -> tuple[Feature, ...]:
        """Features of the robot file whose code takes part in the run."""
        return self.loop.features

    @property
    def feature_plans(self) -> dict[str, bytes]:
        """Encoded plan of each feature, by name of the feature."""
        return self.loop.feature_plans

    @property
    def urdf(self) -> str | None:
        """Text of the robot's URDF; None: the robot file does not name one."""
        return self.loop.urdf

    @property
    def servos_by_joint(self) -> dict[str, tuple[tuple[BusPlan, ServoPlan], ...]]:
        """Buses and servos that move each joint, by joint name."""
        servos = {servo.row: (bus, servo) for bus in self.buses for servo in bus.servos}
        return {
            joint.name: tuple(servos[each] for each in self.mechanics.servo_rows(row) if each in servos)
            for row, joint in enumerate(self.loop.joints)
        }

    @property
    def simulated(self) -> bool:
        """True if the servos of any bus are simulated."""
        return any(bus.port == "sim" for bus in self.buses)


class MotionPart(msgspec.Struct, frozen=True):
    """Compiled part of a motion. Times are since the loop's first deadline."""

    file: str
    controller: str
    start_ns: int
    end_ns: int | None  # None: it is played until it is cancelled
    points: int  # 0 for a controller's own motion
    commands: tuple[ScheduledCommand, ...]
    mark: Mark

    @property
    def motion_end_ns(self) -> int | None:
        """End of the motion, when its goal is judged; at most `end_ns`, and None as that."""
        goal = self.commands[0].goal
        return self.end_ns if goal is None else goal.end_ns


def to_json(plan: Plan) -> bytes:
    """Encode a plan as JSON, with bytes as base64."""
    import msgspec  # not above: to check a robot needs no JSON

    return msgspec.json.encode(plan)


def from_json(data: bytes) -> Plan:
    """Decode a plan. Raises msgspec.ValidationError for other data."""
    return decode_plan(data, Plan)


def decode_plan(data: bytes, parts: type[Parts]) -> Parts:
    """Decode the fields of a plan that a struct declares. Raises msgspec.MsgspecError for other data.

    Logs of format 8 have the boolean `linear` of joints and servos instead of their unit. Quotes in a JSON
    string are escaped, so the replacement matches only keys.
    """
    import msgspec  # not above: to check a robot needs no JSON

    return msgspec.json.decode(_move_sections(data.replace(b'"linear":true', b'"unit":"m"')), type=parts)


def _move_sections(data: bytes) -> bytes:
    """Move sections and policies that the loop has in plans of earlier versions to their features."""
    if b'"of_features":' in data:
        return data
    tree = msgspec.json.decode(data, type=dict[str, Any])
    if "loop" not in tree:
        return data
    loop = msgspec.convert(tree["loop"], dict[str, Any])
    policies = msgspec.convert(loop.get("policies", {}), dict[str, Any])
    own = {one.name: policies.pop(one.name) for one in FEATURES if one.name in policies}
    sections = {one.name: loop.pop(one.name, None) for one in FEATURES}
    sections["on_lost_servo"] = policies.pop("groups", None)
    plans = {name: b64encode(msgspec.json.encode(one)).decode() for name, one in sections.items() if one}
    loop["feature_plans"] = loop.get("feature_plans", {}) | plans
    loop["policies"] = policies | {"of_features": own}
    return msgspec.json.encode(tree | {"loop": loop})
