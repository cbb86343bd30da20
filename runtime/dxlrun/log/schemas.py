"""Schemas: the declarations of topics, messages and metadata of the log.

Messages are ROS 2 definitions (`ros2msg`), encoded as CDR little-endian, so that rosbag2, Foxglove,
PlotJuggler and Rerun open a log without conversion. Every channel has the RIHS01 hash of its type (REP 2016).
"""

from __future__ import annotations

import os
import struct
import time
from enum import StrEnum
from typing import TYPE_CHECKING

import msgspec

from dxlrun.channels.cycle import SCALARS, SEQUENCES, CycleLayout
from dxlrun.description.frames.tree import FramesPlan
from dxlrun.description.source_names import SOURCE_COMMAND, SOURCE_COMMANDS
from dxlrun.messages import Header, JointState, Quaternion, String, Time, Vector3
from dxlrun.messages.declared import declared_message
from dxlrun.messages.definition import RULE, MessageType
from dxlrun.plan.machine_load import MachineLoad
from dxlrun.plan.recording_plan import RecordingPlan

if TYPE_CHECKING:
    import numpy as np

    from dxlrun.plan.robot_plan import Plan

PROFILE = "ros2"
ENCODING = "cdr"
SCHEMA_ENCODING = "ros2msg"


class LogTopic(StrEnum):
    """Topics of every log. The topic of a bus begins with `BUS_PREFIX`; controllers add their own topics."""

    CYCLE = "/cycle"
    ACTIVATION = "/activation"
    """One message of the type of /cycle: states and goals at the activation of the controllers."""
    COMMANDS = "/commands"
    EVENT = "/events"
    ROSOUT = "/rosout"
    JOINT_STATES = "/joint_states"
    JOINT_COMMANDS = "/joint_commands"
    DIAGNOSTICS = "/diagnostics"
    MACHINE = "/machine"
    FRAMES = "/tf"
    STILL_FRAMES = "/tf_static"
    ROBOT_DESCRIPTION = "/robot_description"


BUS_PREFIX = "/bus/"

METADATA_NAME = "dxlrun"
"""Name of the metadata record that identifies a log of dxlrun."""
SUMMARY_NAME = "dxlrun_summary"
"""Name of the last metadata record of a finished log."""
FAILURES_NAME = "failures"
"""Name of the metadata record with failures outside the loop, one sentence each."""
HEADER_ATTACHMENT = "header.json"
COMPRESSED_SUFFIX, COMPRESSED_TYPE = ".zst", "application/zstd"
"""Suffix and media type of a compressed attachment."""
KEPT_ATTACHMENT = "kept.json"
"""Attachment with the states that controllers kept in earlier runs and began with."""
FORMAT = "9"
"""Log format; increased when readers of the previous version would misread a log."""
READ_FORMATS = ("8", FORMAT)
"""Readable log formats. Format 8 has another name for the unit of a joint: see
`plan.robot_plan.decode_plan`."""


def bus_topic(bus: str) -> str:
    """Return the topic of a bus' packets."""
    return f"{BUS_PREFIX}{bus}"


_TIME = f"{RULE}\nMSG: builtin_interfaces/Time\n{declared_message(Time, '').type.text}"
_HEADER = f"{RULE}\nMSG: std_msgs/Header\n{declared_message(Header, '').type.text}"

JOINT_STATE = declared_message(JointState, "").type
STRING = declared_message(String, "").type

ROS_LOG = MessageType(
    "rcl_interfaces/msg/Log",
    f"""builtin_interfaces/Time stamp
uint8 level
string name
string msg
string file
string function
uint32 line
{_TIME}""",
)


DIAGNOSTICS = MessageType(
    "diagnostic_msgs/msg/DiagnosticArray",
    f"""std_msgs/Header header
diagnostic_msgs/DiagnosticStatus[] status
{_HEADER}{RULE}
MSG: diagnostic_msgs/DiagnosticStatus
# 0 OK, 1 warning, 2 error, 3 stale
byte level
string name
string message
string hardware_id
diagnostic_msgs/KeyValue[] values
{RULE}
MSG: diagnostic_msgs/KeyValue
string key
string value
""",
)

FRAMES = MessageType(
    "tf2_msgs/msg/TFMessage",
    f"""geometry_msgs/TransformStamped[] transforms
{RULE}
MSG: geometry_msgs/TransformStamped
std_msgs/Header header
string child_frame_id
geometry_msgs/Transform transform
{_HEADER}{RULE}
MSG: geometry_msgs/Transform
geometry_msgs/Vector3 translation
geometry_msgs/Quaternion rotation
{RULE}
MSG: geometry_msgs/Vector3
{declared_message(Vector3, "").type.text}{RULE}
MSG: geometry_msgs/Quaternion
{declared_message(Quaternion, "").type.text}""",
)

_FOREVER = "sec: 9223372036\n    nsec: 854775807"
LATCHED = f"""- history: 1
  depth: 1
  reliability: 1
  durability: 1
  deadline:
    {_FOREVER}
  lifespan:
    {_FOREVER}
  liveliness: 1
  liveliness_lease_duration:
    {_FOREVER}
  avoid_ros_namespace_conventions: false"""
"""Quality of service in the format of rosbag2: keep last, reliable, transient local, so that late
subscribers also get the message. The integers are those of rmw/types.h, because older versions of rosbag2
read no words here."""


def _cycle_text() -> str:
    lines = [
        "# One cycle of the loop. Times: ns of the run's clock; wall time = that + epoch_offset_ns",
        "# of the metadata. Rows: in the order of the metadata's joints and controllers; rad, rad/s;",
        "# effort: Nm, A or the fraction of maximum; pwm: fraction of the full voltage; deg C, V.",
        "# NaN = not known or not commanded. active, published: bit i is controller i. clamped:",
        "# 1 lower, 2 upper, 4 step, 8 velocity, 16 not finite, 32 effort, 64 pwm, 128 outward.",
        "# hardware_error: of the model's error item, or states of Protocol 1.0's ERR. mode: 0 not",
        "# known, 1 position, 2 velocity, 3 effort, 4 pwm, 5 position with an effort limit.",
        "# reference: in the order of the metadata's references. torque: 0 not known, 1 on, 2 in doubt,",
        f"# 3 off, 4 switched off on request, 5 lost, 6 reboots on request. source_state, {SOURCE_COMMAND}:",
        f"# in the order of the metadata's sources and {SOURCE_COMMANDS}, SI units.",
        "# Records + skipped = elapsed periods.",
    ]
    lines += [f"{kind} {name}" for name, kind in SCALARS]
    lines += [f"{kind}[] {name}" for name, kind, _ in SEQUENCES]
    return "\n".join(lines) + "\n"


CYCLE = MessageType(
    "dxlrun_msgs/msg/Cycle",
    _cycle_text(),
)

BUS_PACKETS = MessageType(
    "dxlrun_msgs/msg/BusPackets",
    """# Packets on a bus, an element each, in order. cycle_delta, first_ns_delta: of the first packet the
# value, of each other one the difference from the packet before; sum them up. cycle: in whose period it
# was, -1: before the first one. kind: 1 instruction, 2 status, 3 noise, 4 status that came too late, 5
# instruction of another host, 6 echo of an instruction. Times, ns of the run's clock: of an instruction
# before its write(), and how long that took; else after the read() that brought the first byte, and how
# long after it the last one came. data: the bytes of all packets, one behind the other; length: how many
# are of each.
int64[] cycle_delta
int64[] first_ns_delta
int64[] duration_ns
uint8[] kind
uint8[] servo_id
uint16[] length
uint8[] data
""",
)

EVENT = MessageType(
    "dxlrun_msgs/msg/Event",
    """# Something that happened beside the regular cycle. part: 0; 1, 2 ... for what follows of a long text.
# data: JSON for programs, where they need more than code and source; empty: none.
int64 t_ns
uint16 code
uint8 severity
uint8 part
string name
string source
string text
string data
""",
)

COMMAND = MessageType(
    "dxlrun_msgs/msg/Command",
    """# A command that a cycle took, for a controller or (no name) for the loop itself; an event says when it
# was refused. t_ns: of the cycle's wake-up. planned: its number in the commands of plan.json, whose
# array it is; -1: the array is data. lease_ns: for how long a set-point of a stream counts; 0: for ever.
# text: JSON for the loop; for a controller empty, or in hexadecimal what is no array of numbers.
# request: what data was prepared from: the command as JSON, of play a list of all; empty: nothing was, it
# was too long, or it is in plan.json.
int64 t_ns
int64 cycle
int64 planned
int64 lease_ns
string controller
string kind
string origin
string text
float64[] data
string request
""",
)

MACHINE = MessageType(
    "dxlrun_msgs/msg/Machine",
    """# The machine and the loop's process over interval_ns up to t_ns, ns of the run's clock.
# Rows: one a core. user to idle: shares of the interval. frequency: Hz. temperature: deg C of the
# hottest sensor. memory_pressure: share of the interval in which some process waited for memory.
# loop_core: where the loop ran last. loop_running, loop_waiting: s on a core, and s in which it could
# run but had none; its context switches and page faults. NaN (core: -1): the system does not tell.
int64 t_ns
int64 interval_ns
int32 loop_core
float64[] user
float64[] system
float64[] irq
float64[] softirq
float64[] steal
float64[] idle
float64[] frequency
float64 temperature
float64 memory_pressure
float64 loop_running
float64 loop_waiting
float64 loop_voluntary
float64 loop_involuntary
float64 loop_minor_faults
float64 loop_major_faults
""",
)


class LoggedController(msgspec.Struct, frozen=True):
    """A controller of the run; its index is its bit in the masks of a cycle."""

    name: str
    joints: tuple[str, ...]
    publishes: tuple[str, ...]
    """Topics that the controller publishes in the cycles that it marks."""


def epoch_offset_ns() -> int:
    """Return wall time minus monotonic time, ns. Read once, so that a clock step does not distort the log."""
    return time.time_ns() - time.monotonic_ns()


class LogHeader(msgspec.Struct, frozen=True):
    """Description of a run that is known before the first record; sent to the recorder as JSON."""

    robot: str
    joints: tuple[str, ...]
    buses: tuple[str, ...]
    controllers: tuple[LoggedController, ...]
    period_ns: int
    epoch_offset_ns: int
    """Wall time (ns since 1970) minus the run's clock."""
    references: tuple[str, ...] = ()
    """Names of the references in a cycle: `arm_pid/shoulder/position`."""
    sources: dict[str, tuple[str, ...]] = {}
    """Devices, sensors and controllers that provide states, with the names of these states."""
    source_commands: tuple[str, ...] = msgspec.field(default=(), name=SOURCE_COMMANDS)
    """Names of the source commands in a cycle: `light/led`."""
    source_units: dict[str, str] = {}
    """SI units of source states by `imu/angular_velocity.x`; empty in logs of earlier versions."""
    attachments: dict[str, bytes] = {}
    """Attachments by name: robot file, plan."""
    metadata: dict[str, dict[str, str]] = {}
    """Metadata records by name: versions, kernel, scheduler."""
    robot_description: str | None = None
    """The robot's URDF."""
    frames: FramesPlan | None = None
    """Plan of the moved frames and their logging; None without a URDF."""

    @classmethod
    def from_plan(cls, plan: Plan, epoch_offset_ns: int) -> LogHeader:
        """Return the header of a run, without attachments and metadata."""
        loop = plan.loop
        return cls(
            robot=plan.robot,
            joints=tuple(joint.name for joint in loop.joints),
            buses=tuple(bus.name for bus in plan.buses),
            controllers=tuple(
                LoggedController(controller.name, controller.joints, controller.publishes)
                for controller in loop.controllers
            ),
            period_ns=loop.period_ns,
            epoch_offset_ns=epoch_offset_ns,
            references=loop.references,
            sources=loop.source_states,
            source_commands=loop.source_commands,
            source_units=loop.source_units,
            robot_description=plan.urdf,
            frames=plan.frames,
        )

    @property
    def layout(self) -> CycleLayout:
        """Layout of the cycles' records."""
        names = [controller.name for controller in self.controllers]
        return CycleLayout(self.joints, names, self.references, self.sources, self.source_commands)


_SPAN = struct.Struct("=qq")


class CycleSpan:
    """Time span of a run that the cycles in a log cover, from the first deadline to the last cycle."""

    __slots__ = ("begin_ns", "last_ns")

    def __init__(self, begin_ns: int | None = None, last_ns: int | None = None) -> None:
        self.begin_ns, self.last_ns = begin_ns, last_ns

    @classmethod
    def load(cls, descriptor: int) -> CycleSpan:
        """Return the span that a recorder has stored in a memory file; an empty span before that."""
        data = os.pread(descriptor, _SPAN.size, 0)
        return cls(*_SPAN.unpack(data)) if len(data) == _SPAN.size else cls()

    def store(self, descriptor: int) -> None:
        """Store the span in a memory file, where it survives this process."""
        if self.begin_ns is not None and self.last_ns is not None:
            os.pwrite(descriptor, _SPAN.pack(self.begin_ns, self.last_ns), 0)

    def extend_span(self, record: np.void, period_ns: int) -> None:
        """Extend the span by a record of /cycle or /activation, which has number -1 and the first deadline.

        In a later part, the first record is not the first of the run; its number gives the first deadline.
        """
        number = int(record["cycle"])
        if self.begin_ns is None:
            self.begin_ns = int(record["scheduled_ns"]) - max(0, number) * period_ns
        if number >= 0:
            self.last_ns = int(record["written_ns"])

    @property
    def last_cycle_text(self) -> str:
        """Clause about the last cycle of an incomplete log."""
        if self.begin_ns is None or self.last_ns is None:
            return "it has no cycle"
        return f"its last cycle is at {(self.last_ns - self.begin_ns) / 1e9:.1f} s of the run"


class RecorderJob(msgspec.Struct, frozen=True):
    """Job of a recorder, sent as JSON through a file descriptor."""

    path: str
    header: LogHeader
    rings: dict[str, int]
    """File descriptors of the rings, by name."""
    recording: RecordingPlan = RecordingPlan()
    span: int = -1
    """File descriptor of the memory file for the CycleSpan of flushed cycles; -1: none."""


class LogSummary(msgspec.Struct, frozen=True):
    """Numbers of written and lost records of a log."""

    messages: int
    bytes: int
    """Size of the file."""
    gaps: int
    """Number of records that the recorder did not receive from the rings."""
    error: str | None = None
    """Reason why the log is incomplete: a full disk, a deleted file."""
    unwritten: int = 0
    """Number of messages in the unfinished chunk when writing stopped, and of later records."""


class LogClosed(msgspec.Struct, frozen=True, tag=True):
    """Recorder to supervisor: the log is closed."""

    summary: LogSummary
    start_up_load: MachineLoad = MachineLoad()
    """Load of the machine from the start of the loop's process to its first cycle."""
    run_load: MachineLoad = MachineLoad()
    """Load of the machine from the first cycle on."""


_TEXTS = {
    one.encode_name: one
    for one in msgspec.structs.fields(LogHeader)
    if one.name not in {"attachments", "metadata", "robot_description", "frames"}
}
"""Fields of the header by name in the metadata: strings unchanged, others as JSON."""
_ADDED = frozenset({"source_units"})
"""Names that early logs of the same format do not have."""


def to_metadata(header: LogHeader) -> dict[str, str]:
    """Return the header as text for the metadata, without attachments, metadata, URDF and frames."""
    values = {name: getattr(header, field.name) for name, field in _TEXTS.items()}
    return {"format": FORMAT} | {
        name: value if isinstance(value, str) else msgspec.json.encode(value).decode()
        for name, value in values.items()
    }


def from_metadata(text: dict[str, str]) -> LogHeader:
    """Return the header that `to_metadata` wrote. Raises ValueError when something is missing or wrong."""
    if text.get("format") not in READ_FORMATS:
        raise ValueError(
            f"it has log format {text.get('format', 'none')}, and this version reads formats "
            f"{' and '.join(READ_FORMATS)} only; use the version of dxlrun that recorded it"
        )
    try:
        values = {
            name: text[name] if field.type is str else msgspec.json.decode(text[name])
            for name, field in _TEXTS.items()
            if name in text or name not in _ADDED
        }
        return msgspec.convert(values, LogHeader)
    except (KeyError, ValueError, msgspec.MsgspecError) as error:
        raise ValueError(f"the metadata {error} is missing or wrong") from error
