"""Cycle: states, commands and goals of the joints in one cycle of the loop, and the layout of their record.

The loop's arrays are views of the record's memory. The bytes of the record are the CDR body (little-endian,
after the encapsulation header) of the log's message dxlrun_msgs/msg/Cycle: 64-bit scalars, then sequences,
each with a 32-bit length and the alignment of its elements. So a record is copied once, into the ring, and
the recorder writes it without conversion.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag, unique
from typing import Any, ClassVar, Self

import msgspec
import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from dxlrun.channels.ring import RING_SECONDS, record_size
from dxlrun.description.source_names import SOURCE_COMMAND
from dxlwire.modes import COMMAND_INTERFACES

Floats = NDArray[np.float64]
"""Array of float64. For joints, shape (joints,): rad, rad/s, Nm, A, or the fraction of maximum effort if the
servo does not measure torque."""
LOST_CYCLES = 3
"""Consecutive missing replies after which a servo is lost, if its last reply is older than LOST_AGE_NS."""
LOST_AGE_NS = 50_000_000
"""Age of the last reply after which a servo is lost. Three cycles at 1 kHz are shorter than the stalls of
hosts, virtual machines and USB adapters; three cycles at 50 Hz are not [i]."""
MOST_CONTROLLERS = 63  # bits of the masks `active` and `published`

SCALARS: tuple[tuple[str, str], ...] = (
    ("cycle", "int64"),
    ("scheduled_ns", "int64"),
    ("woken_ns", "int64"),
    ("read_ns", "int64"),
    ("updated_ns", "int64"),
    ("written_ns", "int64"),
    ("period_ns", "int64"),
    ("skipped", "int64"),
    ("active", "uint64"),
    ("published", "uint64"),
    ("command_count", "int64"),
)
"""Name and type of each scalar field in a cycle record, in the order of its bytes."""

SEQUENCES: tuple[tuple[str, str, str], ...] = (
    ("position", "float64", "joints"),
    ("velocity", "float64", "joints"),
    ("effort", "float64", "joints"),
    ("age_ns", "int64", "joints"),
    ("command_position", "float64", "joints"),
    ("command_velocity", "float64", "joints"),
    ("command_effort", "float64", "joints"),
    ("command_pwm", "float64", "joints"),
    ("goal_position", "float64", "joints"),
    ("goal_velocity", "float64", "joints"),
    ("goal_effort", "float64", "joints"),
    ("goal_pwm", "float64", "joints"),
    ("temperature", "float64", "joints"),
    ("voltage", "float64", "joints"),
    ("controller_ns", "int64", "controllers"),
    ("valid", "bool", "joints"),
    ("clamped", "uint8", "joints"),
    ("hardware_error", "uint8", "joints"),
    ("mode", "uint8", "joints"),
    ("reference", "float64", "references"),
    ("torque", "uint8", "joints"),
    ("source_state", "float64", "source_states"),
    (SOURCE_COMMAND, "float64", "source_commands"),
    ("source_age_ns", "int64", "sources"),
    ("source_valid", "bool", "sources"),
)
"""Name, element type and dimension of each array in a cycle record, in the order of its bytes."""
_OWNERS = {name: per for name, _, per in SEQUENCES}


@unique
class Torque(IntEnum):
    """Torque state of a joint's servo. The log has the numbers."""

    UNKNOWN = 0
    """The torque state was not recorded, in logs of older versions."""
    ON = 1
    """Torque is enabled, and the servo gets goals."""
    DOUBT = 2
    """Uncertain after a lost reply or after torque was enabled. The servo gets goals again once its Torque
    Enable was read."""
    OFF = 3
    """Torque is off because the servo was reset, its torque was cut, or it shut down."""
    RELEASED = 4
    """Torque is off because a client, a policy or the robot file disabled it."""
    LOST = 5
    """Not known, because the servo is lost: it does not reply."""
    REBOOTING = 6
    """The servo reboots at the request of a client. Missing replies do not count as a loss."""
    GIVEN = 7
    """Torque was just enabled. The joint's goal becomes its measured position, and its controllers are
    restarted."""

    @property
    def word(self) -> str:
        """Name of the state in outputs, in lower case.

        `limp` for a joint without torque, whatever the reason.
        """
        return "limp" if self in LIMP else self.name.lower()


LIMP = (Torque.OFF, Torque.RELEASED)
"""Torque states of joints that have no torque and move freely."""
OFFLINE = (Torque.LOST, Torque.REBOOTING)
"""Torque states of joints whose servos are not read, because they are lost or reboot."""
_UNABLE = {
    Torque.OFF: "is limp: it was reset, its torque was cut, or it shut itself down",
    Torque.RELEASED: "is limp: its torque was switched off",
    Torque.LOST: "does not answer",
    Torque.REBOOTING: "is rebooting",
}


@dataclass(frozen=True, slots=True)
class States:
    """Measured states of the joints, with one element for each joint.

    Without a valid reply, the last values stay.
    """

    motion: Floats
    """Shape (3, joints): position, velocity and effort in one array."""
    position: Floats = field(init=False)
    velocity: Floats = field(init=False)
    effort: Floats = field(init=False)
    valid: NDArray[np.bool_]
    """True for joints whose servo sent an intact reply in this cycle."""
    age_ns: NDArray[np.int64]
    """Time since each servo's last valid reply arrived, ns; -1 before the first one."""
    temperature: Floats
    """Temperature of each servo, deg C, read at a low rate; NaN until first read."""
    voltage: Floats
    """Supply voltage at the servo, V, read at a low rate; NaN until first read."""
    hardware_error: NDArray[np.uint8]
    """Bits of each servo's Hardware Error Status (e-Manual); Protocol 1.0: the bits of ERR that are states.
    """
    mode: NDArray[np.uint8]
    """Operating mode of each servo, as a `Mode`; UNKNOWN during a change."""
    torque: NDArray[np.uint8]
    """Torque state of each servo, as a `Torque`, before this cycle's read; DOUBT if the reply reports a new
    error.
    """

    def __post_init__(self) -> None:
        for name, row in zip(("position", "velocity", "effort"), self.motion, strict=True):
            object.__setattr__(self, name, row)

    @property
    def has_lost(self) -> bool:
        """True while any joint's servo is lost.

        Lost joints get no commands, and their controllers are held.
        """
        return Torque.LOST in self.torque.tobytes()

    def unable(self, rows: Iterable[int]) -> tuple[int, str] | None:
        """Return the first of these joints that cannot move (limp, lost, rebooting): row and reason.

        Returns None if all can move.
        """
        for row in rows:
            if why := _UNABLE.get(Torque(self.torque.item(row))):
                return row, why
        return None

    def doubtful(self, rows: Iterable[int]) -> tuple[int, str] | None:
        """Return the first of these joints without a reply or with uncertain torque: row and reason.

        Returns None if all are certain.
        """
        for row in rows:
            if not self.valid.item(row):
                return row, "has not answered"
            if self.torque.item(row) in (Torque.DOUBT, Torque.GIVEN):
                return row, "has not confirmed its torque"
        return None

    @classmethod
    def empty(cls, joints: int) -> States:
        """Return states before the first reply: NaN, not valid, age -1, unknown mode and torque."""
        return cls(
            motion=np.full((3, joints), np.nan),
            valid=np.zeros(joints, dtype=np.bool_),
            age_ns=np.full(joints, -1, dtype=np.int64),
            temperature=np.full(joints, np.nan),
            voltage=np.full(joints, np.nan),
            hardware_error=np.zeros(joints, dtype=np.uint8),
            mode=np.zeros(joints, dtype=np.uint8),
            torque=np.zeros(joints, dtype=np.uint8),
        )


class SourceStates(msgspec.Struct, frozen=True):
    """States of sources other than joints: devices on a bus, sensors, and controllers that provide states."""

    values: Floats
    """Shape (states,), in the order of the layout's `source_states`; NaN until first updated."""
    valid: NDArray[np.bool_]
    """Shape (sources,): True if the source delivered new states in this cycle."""
    age_ns: NDArray[np.int64]
    """Shape (sources,): time since the states were measured, ns; -1 before the first update."""

    @classmethod
    def empty(cls, sources: int = 0, states: int = 0) -> SourceStates:
        """Return states of sources before the first update: NaN, not valid, age -1."""
        return cls(
            values=np.full(states, np.nan),
            valid=np.zeros(sources, dtype=np.bool_),
            age_ns=np.full(sources, -1, dtype=np.int64),
        )


@dataclass(frozen=True, slots=True)
class Commands:
    """Commands or goals of the joints by interface, with one element for each joint; NaN = not commanded.

    The joint's mode decides which commands apply, see `mode_of`.
    """

    values: Floats
    """Shape (4, joints): all commands in one array, in the order of COMMAND_INTERFACES."""
    position: Floats = field(init=False)
    """Commanded position, rad or m."""
    velocity: Floats = field(init=False)
    """Commanded velocity, rad/s or m/s. With a position: speed toward it, a magnitude, NaN = as fast as the
    servo can. Alone: signed velocity of the joint."""
    effort: Floats = field(init=False)
    """Unit of the state's effort: Nm, A, or the fraction of maximum. With a position: effort limit of the
    servo, a magnitude. Alone: signed effort."""
    pwm: Floats = field(init=False)
    """Commanded PWM, fraction of the full voltage, -1..1."""

    def __post_init__(self) -> None:
        for name, row in zip(COMMAND_INTERFACES, self.values, strict=True):
            object.__setattr__(self, name, row)

    @classmethod
    def empty(cls, joints: int) -> Commands:
        """Return commands that are all NaN, "not commanded", for a number of joints."""
        return cls(np.full((len(COMMAND_INTERFACES), joints), np.nan))

    def clear(self) -> None:
        """Set all commands to NaN, "not commanded"."""
        self.values.fill(np.nan)


@unique
class Clamp(IntFlag):
    """Reductions that the gate applied to a joint's command in a cycle, as bits. The log has the bits."""

    LOWER = 1
    """Position raised to the lower limit."""
    UPPER = 2
    """Position lowered to the upper limit."""
    STEP = 4
    """Change of the goal reduced to the step limit or the acceleration limit."""
    VELOCITY = 8
    """Velocity reduced to the velocity limit."""
    NOT_FINITE = 16
    """Command infinite, or NaN after a finite value: a fault of the controller. The last goal was kept."""
    EFFORT = 32
    """Effort reduced to the effort limit."""
    PWM = 64
    """PWM reduced to the full voltage."""
    OUTWARD = 128
    """Velocity, effort or PWM toward a position limit reduced, to 0 at the limit."""


class CycleLayout:
    """Names of a robot's joints, controllers and sources, and the layout of its cycle record as a dtype.

    Args:
        joints: Names of the joints, in the order of the plan.
        controllers: Names of the controllers, in the order of the plan.
        references: Names of the controllers' reference interfaces: `arm_pid/shoulder/position`.
        sources: Names of the states of each device, sensor and controller that provides states.
        source_commands: Names of the commands of sources: `light/led`.

    Raises:
        ValueError: More than 63 controllers, which are bits of a mask.
    """

    __slots__ = (
        "controllers",
        "dtype",
        "joints",
        "lengths",
        "places",
        "references",
        "source_commands",
        "source_states",
        "sources",
    )

    def __init__(
        self,
        joints: Sequence[str],
        controllers: Sequence[str],
        references: Sequence[str] = (),
        sources: Mapping[str, Sequence[str]] | None = None,
        source_commands: Sequence[str] = (),
    ) -> None:
        if len(controllers) > MOST_CONTROLLERS:
            raise ValueError(f"{len(controllers)} controllers, more than {MOST_CONTROLLERS}")
        self.joints = tuple(joints)
        self.controllers = tuple(controllers)
        self.references = tuple(references)
        self.sources = tuple(sources or ())
        self.source_states = tuple(
            f"{source}/{state}" for source, states in (sources or {}).items() for state in states
        )
        """Names of all states of devices, sensors and controllers: `imu/angular_velocity.x`."""
        self.source_commands = tuple(source_commands)
        counts = {
            "joints": len(self.joints),
            "controllers": len(self.controllers),
            "references": len(self.references),
            "sources": len(self.sources),
            "source_states": len(self.source_states),
            "source_commands": len(self.source_commands),
        }
        names = [name for name, _ in SCALARS]
        formats: list[Any] = [np.dtype(kind).newbyteorder("<") for _, kind in SCALARS]
        offsets = [8 * index for index in range(len(SCALARS))]
        end = 8 * len(SCALARS)
        self.lengths: dict[str, int] = {}
        self.places: dict[str, slice] = {}
        """Range of bytes of each array's elements in a record, by name of the array."""
        for name, kind, per in SEQUENCES:
            element = np.dtype(kind).newbyteorder("<")
            count = counts[per]
            self.lengths[f"{name}_length"] = count
            at = -(-end // 4) * 4
            # An empty CDR sequence has only its length, without padding for elements.
            body = -(-(at + 4) // element.itemsize) * element.itemsize if count else at + 4
            names += [f"{name}_length", name]
            formats += [np.dtype("<u4"), (element, (count,))]
            offsets += [at, body]
            end = body + count * element.itemsize
            self.places[name] = slice(body, end)
        self.dtype: np.dtype[np.void] = np.dtype(
            {"names": names, "formats": formats, "offsets": offsets, "itemsize": end}
        )

    @property
    def size(self) -> int:
        """Size of a cycle record, bytes."""
        return self.dtype.itemsize

    def float_index(self, name: str) -> int:
        """Return the index in `CycleRecord.floats` at which an array with 64-bit elements begins."""
        first: int = self.places[name].start
        return first // 8

    def names_of(self, sequence: str) -> tuple[str, ...]:
        """Return the names of an array's elements, such as `light/led`, or joint names."""
        names: tuple[str, ...] = getattr(self, _OWNERS[sequence])
        return names

    def source_slice(self, source: str) -> slice:
        """Return the slice of `source_states` that a source's states take; empty for an unknown source."""
        places = [index for index, name in enumerate(self.source_states) if name.partition("/")[0] == source]
        return slice(places[0], places[-1] + 1) if places else slice(0, 0)


class _Scalars(ctypes.LittleEndianStructure):
    """Scalar fields at the begin of a cycle record, as a C struct."""

    _fields_ = tuple((name, getattr(ctypes, f"c_{kind}")) for name, kind in SCALARS)


class CycleRecord(_Scalars):
    """Record of the current cycle: the arrays that hardware, controllers and gate share.

    Each cycle overwrites it. Times are int64 ns of the run's clock. Arrays have the shape (joints,) or
    (controllers,).
    """

    COMPUTED: ClassVar = {"source_state": "state", "reference": "reference", SOURCE_COMMAND: "command"}
    """Arrays that replays compare, which are not of joints: name, and the noun for an element."""

    cycle: int
    """Number of the period since the loop's first deadline, including skipped periods."""
    scheduled_ns: int
    """Deadline of this cycle: start + cycle * period."""
    woken_ns: int
    """Time at which the loop woke up for this cycle."""
    read_ns: int
    """Time after the servos' states were read."""
    updated_ns: int
    """Time after controllers and gate computed the goals."""
    written_ns: int
    """Time after the goals were sent to the servos."""
    period_ns: int
    """Measured time since the previous cycle, limited as controllers get it."""
    skipped: int
    """Number of periods skipped before this cycle."""
    active: int
    """Bit i: controller i is active."""
    published: int
    """Bit i: controller i marked this cycle for publication on its topics of `publishes`."""
    command_count: int
    """Number of commands that controllers accepted in this cycle."""
    _array: NDArray[np.void]

    def __new__(cls, layout: CycleLayout) -> Self:
        """Allocate a record."""
        array: NDArray[np.void] = np.zeros(1, dtype=layout.dtype)
        record = cls.from_buffer(array.view(np.uint8).data)
        record._array = array
        return record

    def __init__(self, layout: CycleLayout) -> None:
        self.layout = layout
        array = self._array
        for name, count in layout.lengths.items():
            array[name] = count
        self.raw: memoryview = array.view(np.uint8).data
        """Bytes of the whole record, as a view of its memory."""
        self.states = States(
            motion=_rows(array, "position", 3),
            valid=array["valid"][0],
            age_ns=array["age_ns"][0],
            temperature=_row(array, "temperature"),
            voltage=_row(array, "voltage"),
            hardware_error=array["hardware_error"][0],
            mode=array["mode"][0],
            torque=array["torque"][0],
        )
        """States of the servos."""
        self.commands = Commands(_rows(array, "command_position", len(COMMAND_INTERFACES)))
        """Merged commands of the controllers; NaN = not commanded."""
        self.goals = Commands(_rows(array, "goal_position", len(COMMAND_INTERFACES)))
        """Goals that are sent to the servos, from the gate."""
        self.controller_ns: NDArray[np.int64] = array["controller_ns"][0]
        """Duration of each controller's update, ns; 0 without an update in this cycle."""
        self.clamped: NDArray[np.uint8] = array["clamped"][0]
        """Clamps of each joint's command in this cycle, as bits of Clamp."""
        self.reference: Floats = _row(array, "reference")
        """Commands of controllers for the references of other controllers, in the order of the layout's
        references; NaN = not commanded."""
        self.sources = SourceStates(
            values=_row(array, "source_state"),
            valid=array["source_valid"][0],
            age_ns=array["source_age_ns"][0],
        )
        """States of devices, sensors and controllers."""
        self.source_commands: Floats = _row(array, SOURCE_COMMAND)
        """Commands for devices, in the order of the layout's source_commands; NaN = not commanded."""
        self.computed: tuple[Floats, ...] = tuple(_row(array, name) for name in self.COMPUTED)
        """Arrays of the sequences that COMPUTED names."""
        self.floats: Floats = np.frombuffer(self.raw[: layout.size - layout.size % 8], dtype="<f8")
        """Whole record as an array of float64. `layout.place(name)` is the index at which an array begins."""
        for name, kind, _ in SEQUENCES:
            if kind == "float64":
                array[name] = np.nan
        self.states.age_ns[:] = -1
        self.sources.age_ns[:] = -1
        self._renewed = tuple(
            (self.raw[place], bytes(place.stop - place.start))
            for place in (layout.places["clamped"], layout.places["controller_ns"])
        )

    def reset_counts(self) -> None:
        """Reset marks, command count, clamps and controllers' durations at the begin of a cycle."""
        self.published = self.command_count = 0
        for part, nothing in self._renewed:
            part[:] = nothing

    def wake(self, cycle: int, scheduled_ns: int, woken_ns: int, period_ns: int) -> None:
        """Set the cycle's number, deadline, wake-up time and measured period."""
        self.cycle, self.scheduled_ns, self.woken_ns, self.period_ns = (
            cycle,
            scheduled_ns,
            woken_ns,
            period_ns,
        )

    def set_times(self, read_ns: int, updated_ns: int, written_ns: int) -> None:
        """Set the times after read, update and write."""
        self.read_ns, self.updated_ns, self.written_ns = read_ns, updated_ns, written_ns

    @property
    def valid(self) -> NDArray[np.bool_]:
        """True for joints whose servo sent an intact reply in this cycle."""
        return self.states.valid

    @property
    def age_ns(self) -> NDArray[np.int64]:
        """Time since each servo's last valid reply arrived, ns; -1 before the first one."""
        return self.states.age_ns


def _row(array: NDArray[np.void], name: str) -> Floats:
    row: Floats = array[name][0]
    return row


def _rows(array: NDArray[np.void], first: str, count: int) -> Floats:
    """Return consecutive float64 sequences as one array.

    Their stride is constant: one sequence, and the length and padding of the next.
    """
    row = _row(array, first)
    return as_strided(row, (count, row.size), (row.nbytes + row.itemsize, row.itemsize))


def cycle_capacity(period_ns: int, size: int) -> int:
    """Return the size of the ring for cycle records, bytes, for 11 s at the loop's period.

    Args:
        period_ns: Period of the loop.
        size: Size of a cycle record, bytes.
    """
    return record_size(size) * max(64, (RING_SECONDS + 1) * 1_000_000_000 // period_ns)
