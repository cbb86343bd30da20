"""One cycle of the loop: states, commands and goals of the joints, and the layout of their record.

The record's memory is the arrays that the loop works on: its bytes are, as they are, the CDR body
(little-endian, after the encapsulation header) of the message dxlrun_msgs/msg/Cycle of the log: scalars of 64
bits, then sequences, each with its length of 32 bits in front and aligned as its elements ask. So the loop
fills arrays, the ring copies once, and the recorder writes what it finds.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag, unique
from typing import Any, ClassVar, Self

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from dxlrun.channels.ring import RING_SECONDS, record_size
from dxlrun.description.source_names import SOURCE_COMMAND
from dxlwire.modes import COMMAND_INTERFACES

Floats = NDArray[np.float64]
"""Shape (joints,): rad, rad/s, Nm, A, or the fraction of maximum where the servo measures no torque."""
LOST_CYCLES = 3
"""A servo that missed so many replies in a row is lost, until it answers again ..."""
LOST_AGE_NS = 50_000_000
"""... and whose last reply is so old: at 50 Hz it is by then, but three cycles at 1 kHz are less than
what hosts, virtual machines and USB adapters stand still for [i]."""
MOST_CONTROLLERS = 63

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
"""Name and type of the fields that a cycle has once."""

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
"""Name, element type and what it has one element of."""
_OWNERS = {name: per for name, _, per in SEQUENCES}


@unique
class Torque(IntEnum):
    """Whether a joint's servo holds torque; the numbers are in the log."""

    UNKNOWN = 0
    """In logs of versions that did not record it."""
    ON = 1
    """It holds torque for certain, and gets goals."""
    DOUBT = 2
    """It gets no goals until its torque enable was read: a reply was lost, or torque was just given."""
    OFF = 3
    """It has none: it was reset, its torque was cut, or it shut itself down."""
    RELEASED = 4
    """It has none, because a client, a policy or the robot file switched it off."""
    LOST = 5
    """It is not known: the servo is lost."""
    REBOOTING = 6
    """The servo reboots because a client requested it: that it is silent is no loss."""
    GIVEN = 7
    """It was just given torque where it is: the loop's goal becomes that, and its controllers start again."""

    @property
    def word(self) -> str:
        """The state in every output; a joint without torque is `limp`, whatever the reason."""
        return "limp" if self in LIMP else self.name.lower()


LIMP = (Torque.OFF, Torque.RELEASED)
"""Joints that move freely."""
OFFLINE = (Torque.LOST, Torque.REBOOTING)
"""Joints whose servos are not read."""
_UNABLE = {
    Torque.OFF: "is limp: it was reset, its torque was cut, or it shut itself down",
    Torque.RELEASED: "is limp: its torque was switched off",
    Torque.LOST: "does not answer",
    Torque.REBOOTING: "is rebooting",
}


@dataclass(frozen=True, slots=True)
class States:
    """States of the joints: one row a joint; an invalid row keeps its last values and its age grows."""

    motion: Floats
    """Shape (3, joints): position, velocity and effort, for use all at once."""
    position: Floats = field(init=False)
    velocity: Floats = field(init=False)
    effort: Floats = field(init=False)
    valid: NDArray[np.bool_]
    """True where this cycle's reply arrived intact."""
    age_ns: NDArray[np.int64]
    """Time since the reply that the row shows arrived; -1 while none ever did."""
    temperature: Floats
    """deg C, read now and then; NaN until it was."""
    voltage: Floats
    """V at the servo, read now and then; NaN until it was."""
    hardware_error: NDArray[np.uint8]
    """Bits of the e-Manual's Hardware Error Status; Protocol 1.0: those of ERR that are states; 0: none."""
    mode: NDArray[np.uint8]
    """A Mode: in which the servo is known to be; UNKNOWN while that changes."""
    torque: NDArray[np.uint8]
    """A Torque: whether the servo holds torque, as known before this cycle's read; in doubt where a reply
    of it reports an error that is new."""

    def __post_init__(self) -> None:
        for name, row in zip(("position", "velocity", "effort"), self.motion, strict=True):
            object.__setattr__(self, name, row)

    @property
    def has_lost(self) -> bool:
        """True while one of these joints is lost: nothing is commanded to it, and the others are held."""
        return Torque.LOST in self.torque.tobytes()

    def unable(self, rows: Iterable[int]) -> tuple[int, str] | None:
        """Return the first joint, of these rows, that goes nowhere, and why; None: there is none."""
        for row in rows:
            if why := _UNABLE.get(Torque(self.torque.item(row))):
                return row, why
        return None

    def doubtful(self, rows: Iterable[int]) -> tuple[int, str] | None:
        """Return the first joint, of these rows, whose reply or torque is missing for now, and which."""
        for row in rows:
            if not self.valid.item(row):
                return row, "has not answered"
            if self.torque.item(row) in (Torque.DOUBT, Torque.GIVEN):
                return row, "has not confirmed its torque"
        return None

    @classmethod
    def empty(cls, joints: int) -> States:
        """Return arrays of NaN, invalid, of no age and of unknown mode."""
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


@dataclass(frozen=True, slots=True)
class SourceStates:
    """States of what is no joint: of devices on a bus, sensors, and controllers that provide some."""

    values: Floats
    """Shape (states,), in the order of the layout's `source_states`; NaN until there is one."""
    valid: NDArray[np.bool_]
    """Shape (sources,): True where this cycle brought its states."""
    age_ns: NDArray[np.int64]
    """Shape (sources,): time since its states were true; -1 while none ever came."""

    @classmethod
    def empty(cls, sources: int = 0, states: int = 0) -> SourceStates:
        """Return the states before anything came."""
        return cls(
            values=np.full(states, np.nan),
            valid=np.zeros(sources, dtype=np.bool_),
            age_ns=np.full(sources, -1, dtype=np.int64),
        )


@dataclass(frozen=True, slots=True)
class Commands:
    """Commands of the joints: one row a joint, NaN = not commanded.

    Which of them count depends on the joint's mode, see `mode_of`.
    """

    values: Floats
    """Shape (4, joints): all of them, in the order of COMMAND_INTERFACES, for use all at once."""
    position: Floats = field(init=False)
    """rad"""
    velocity: Floats = field(init=False)
    """rad/s. Beside a position: magnitude of the speed toward it, NaN = as fast as the servo can. Alone: the
    speed at which the joint turns, with its sign."""
    effort: Floats = field(init=False)
    """In the unit of the state's effort: Nm, A, or the fraction of maximum. Beside a position: the most that
    the servo may exert, a magnitude. Alone: with its sign."""
    pwm: Floats = field(init=False)
    """Fraction of the full voltage, -1..1"""

    def __post_init__(self) -> None:
        for name, row in zip(COMMAND_INTERFACES, self.values, strict=True):
            object.__setattr__(self, name, row)

    @classmethod
    def empty(cls, joints: int) -> Commands:
        """Return arrays of NaN."""
        return cls(np.full((len(COMMAND_INTERFACES), joints), np.nan))

    def clear(self) -> None:
        """Command nothing any more."""
        self.values.fill(np.nan)


@unique
class Clamp(IntFlag):
    """What the last gate did to a joint's command in a cycle; the bits are in the log."""

    LOWER = 1
    """Raised to the lower position limit."""
    UPPER = 2
    """Lowered to the upper position limit."""
    STEP = 4
    """The change since the last goal was cut to the step limit, or to what the acceleration limit allows."""
    VELOCITY = 8
    """The velocity was cut to the velocity limit."""
    NOT_FINITE = 16
    """NaN after a finite value, or infinite: the last goal was kept, the controller is at fault."""
    EFFORT = 32
    """The effort was cut to the effort limit."""
    PWM = 64
    """The PWM was cut to the full voltage."""
    OUTWARD = 128
    """A velocity, an effort or a PWM that leads out of the position limits was cut, at the end to 0."""


class CycleLayout:
    """The numpy dtype of a robot's cycle record; rows are in the order of the plan's joints and controllers.

    `references` are the names of the controllers' reference interfaces: `arm_pid/shoulder/position`.
    `sources` are devices, sensors and the controllers that provide states, each with the names of its states;
    `source_commands` are names such as `light/led`. Raises ValueError for more than 63 controllers (they are
    bits of a mask).
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
            raise ValueError(f"at most {MOST_CONTROLLERS} controllers, not {len(controllers)}")
        self.joints = tuple(joints)
        self.controllers = tuple(controllers)
        self.references = tuple(references)
        self.sources = tuple(sources or ())
        self.source_states = tuple(
            f"{source}/{state}" for source, states in (sources or {}).items() for state in states
        )
        """Names of all states of the sources: `imu/angular_velocity.x`."""
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
        """The bytes of each sequence's elements in a record."""
        for name, kind, per in SEQUENCES:
            element = np.dtype(kind).newbyteorder("<")
            count = counts[per]
            self.lengths[f"{name}_length"] = count
            at = -(-end // 4) * 4
            # An empty CDR sequence is its length alone: nothing follows that would have to be aligned.
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
        """Bytes of one record."""
        return self.dtype.itemsize

    def place(self, name: str) -> int:
        """Return where the elements of a sequence of 64 bits begin in `CycleRecord.floats`."""
        first: int = self.places[name].start
        return first // 8

    def names_of(self, sequence: str) -> tuple[str, ...]:
        """Return the names of the elements of a sequence that belong to no joint: `light/led`."""
        names: tuple[str, ...] = getattr(self, _OWNERS[sequence])
        return names

    def source_slice(self, source: str) -> slice:
        """Return where the states of a source are among `source_states`."""
        places = [index for index, name in enumerate(self.source_states) if name.partition("/")[0] == source]
        return slice(places[0], places[-1] + 1) if places else slice(0, 0)


class _Scalars(ctypes.LittleEndianStructure):
    """The fields that a cycle has once."""

    _fields_ = tuple((name, getattr(ctypes, f"c_{kind}")) for name, kind in SCALARS)


class CycleRecord(_Scalars):
    """One cycle's memory, filled again and again: the arrays that hardware, controllers and gate share.

    Times are int64 ns of the run's clock, shape of arrays is (joints,) or (controllers,).
    """

    COMPUTED: ClassVar = {"source_state": "state", "reference": "reference", SOURCE_COMMAND: "command"}
    """Sequences of float64 that belong to no joint, as a cycle computes them, with the word for one."""

    cycle: int
    """Number of the period since the loop's first deadline, skipped ones counted."""
    scheduled_ns: int
    """The deadline of this cycle: start + cycle * period."""
    woken_ns: int
    """After the wake-up."""
    read_ns: int
    """After the states were read."""
    updated_ns: int
    """After the controllers and the gate."""
    written_ns: int
    """After the goals were sent."""
    period_ns: int
    """The true time since the cycle before, as controllers saw it, capped."""
    skipped: int
    """Whole periods that were declared skipped before this cycle."""
    active: int
    """Bit i: controller i is active."""
    published: int
    """Bit i: controller i marked this cycle for the topics it publishes."""
    command_count: int
    """Commands handed to controllers in this cycle."""
    _array: NDArray[np.void]

    def __new__(cls, layout: CycleLayout) -> Self:
        """Lay a record out in memory of its own."""
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
        """The bytes of the record; a view, not a copy."""
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
        """The servos' states."""
        self.commands = Commands(_rows(array, "command_position", len(COMMAND_INTERFACES)))
        """What the controllers want, merged; NaN = not commanded."""
        self.goals = Commands(_rows(array, "goal_position", len(COMMAND_INTERFACES)))
        """What goes to the servos, after the last gate."""
        self.controller_ns: NDArray[np.int64] = array["controller_ns"][0]
        """How long each controller's update took; 0 where it was not updated in this cycle."""
        self.clamped: NDArray[np.uint8] = array["clamped"][0]
        """Bits of Clamp, one element a joint."""
        self.reference: Floats = _row(array, "reference")
        """What controllers command of each other's references, one element a name of the layout's references;
        NaN = not commanded."""
        self.sources = SourceStates(
            values=_row(array, "source_state"),
            valid=array["source_valid"][0],
            age_ns=array["source_age_ns"][0],
        )
        """States of devices, sensors and controllers."""
        self.source_commands: Floats = _row(array, SOURCE_COMMAND)
        """Commands of sources, one element a name of the layout's source_commands; NaN = not commanded."""
        self.computed: tuple[Floats, ...] = tuple(_row(array, name) for name in self.COMPUTED)
        """The sequences of COMPUTED."""
        self.floats: Floats = np.frombuffer(self.raw[: layout.size - layout.size % 8], dtype="<f8")
        """The record as float64: the element at `layout.place(name)` is the first of a sequence of them."""
        for name, kind, _ in SEQUENCES:
            if kind == "float64":
                array[name] = np.nan
        self.states.age_ns[:] = -1
        self.sources.age_ns[:] = -1
        self._renewed = tuple(
            (self.raw[place], bytes(place.stop - place.start))
            for place in (layout.places["clamped"], layout.places["controller_ns"])
        )

    def renew(self) -> None:
        """Begin a cycle: nothing was published, taken, clamped or updated in it yet."""
        self.published = self.command_count = 0
        for part, nothing in self._renewed:
            part[:] = nothing

    def wake(self, cycle: int, scheduled_ns: int, woken_ns: int, period_ns: int) -> None:
        """Take what is known of a cycle when it begins."""
        self.cycle, self.scheduled_ns, self.woken_ns, self.period_ns = (
            cycle,
            scheduled_ns,
            woken_ns,
            period_ns,
        )

    def set_times(self, read_ns: int, updated_ns: int, written_ns: int) -> None:
        """Take when the parts of a cycle ended."""
        self.read_ns, self.updated_ns, self.written_ns = read_ns, updated_ns, written_ns

    @property
    def valid(self) -> NDArray[np.bool_]:
        """True where this cycle's reply arrived intact."""
        return self.states.valid

    @property
    def age_ns(self) -> NDArray[np.int64]:
        """Time since the reply that the row shows arrived; -1 while none ever did."""
        return self.states.age_ns


def _row(array: NDArray[np.void], name: str) -> Floats:
    row: Floats = array[name][0]
    return row


def _rows(array: NDArray[np.void], first: str, count: int) -> Floats:
    """Return float64 sequences from `first` on, which stand in equal distances: one length lies between."""
    row = _row(array, first)
    return as_strided(row, (count, row.size), (row.nbytes + row.itemsize, row.itemsize))


def cycle_capacity(period_ns: int, size: int) -> int:
    """Return how many bytes of a ring hold 10 s of cycles of this size, with a margin of a second."""
    return record_size(size) * max(64, (RING_SECONDS + 1) * 1_000_000_000 // period_ns)
