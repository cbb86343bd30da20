"""Exchange kernel: prepares the reads and goals of a cycle for the compiled `kernel.c`, which executes them.

The kernel is a shared object without Python code, called through ctypes and compiled by the build. After
anything unexpected the packet-by-packet parser (`bus`) finishes the cycle. The structs that both sides
share are parsed from `kernel.c`."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator, Sequence
from ctypes import POINTER, c_int32, c_int64, c_uint8, c_void_p
from enum import IntEnum, unique
from functools import partial
from pathlib import Path
from typing import Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlwire.bus_plan import BusPlan, Field
from dxlwire.compiled import array_of, load_compiled, parse_structs
from dxlwire.exceptions import PortError
from dxlwire.exchange.arrays import Floats
from dxlwire.exchange.bus_engine import BEAT_NS, NEVER, Lines
from dxlwire.exchange.device_samples import DeviceSamples
from dxlwire.exchange.goal_writes import SyncWrite
from dxlwire.exchange.samples import Samples
from dxlwire.packets import RECORD_HEADER, PacketLog
from dxlwire.plan.line import BITS_PER_BYTE
from dxlwire.port.ports import ReplyPolling
from dxlwire.transaction import BROADCAST_ID, Transaction
from dxlwire.wire.dialect import dialect_of

_ROOM = 8192  # Size of a line's buffer, bytes; the replies to one read may use a quarter
_ENCODINGS = {"unsigned": 0, "twos_complement": 1, "sign_magnitude": 2, "float32": 3}


@unique
class Answer(IntEnum):
    """Result of a call of the compiled kernel."""

    OK = 0
    WAITING = 1  # Replies are still awaited
    FULL = 2  # The log's batch must be committed first
    UNEXPECTED = 3  # The replies differ from the plan; the parser continues
    # All replies arrived, but a position is further from the last one than is plausible, or a device sent a
    # NaN or an infinite value
    LOOK = 4
    SILENCE = 5  # Nothing was sent: servos got no instruction for longer than their watchdog timeout


AWAITING = 1  # State of a line whose read was sent; 0: no read was sent in this cycle
_NOW = ctypes.CFUNCTYPE(c_int64, c_void_p)
_TRANSFER = ctypes.CFUNCTYPE(c_int32, c_void_p, c_int32, POINTER(c_uint8), c_int32)
_WAIT = ctypes.CFUNCTYPE(c_int32, c_void_p, c_int64, POINTER(c_uint8))
_SLEEP = ctypes.CFUNCTYPE(None, c_void_p, c_int64)

SOURCE = Path(__file__).with_name("kernel.c")
LIBRARY = SOURCE.with_name("libkernel.so")  # Output of the build
STRUCTS = parse_structs(SOURCE.read_text())
_Field, _Servo, _DeviceField, _Block, _Device = (
    STRUCTS[name] for name in ("Field", "Servo", "DeviceField", "Block", "Device")
)
_Part, _Packet, _Read, _Cell, _SyncWrite = (
    STRUCTS[name] for name in ("Part", "Packet", "Read", "Cell", "SyncWrite")
)


def library(path: Path | None = None) -> ctypes.CDLL:
    """Load the compiled kernel and declare the types of its functions.

    Raises:
        NotCompiled: The kernel was not built, or was built from another source.
    """
    found = load_compiled(SOURCE, ctypes.CDLL, path or LIBRARY)
    for name, result, arguments in (
        ("read", c_int32, (c_void_p,)),
        ("write", c_int32, (c_void_p,)),
        ("abandon", None, (c_void_p,)),
        ("take", None, (c_void_p, c_int32, c_int32, c_void_p, c_int64)),
        ("settle", c_int32, (c_void_p, c_int64)),
        ("show", None, (c_void_p, c_int64)),
    ):
        function = getattr(found, f"dxl_{name}")
        function.argtypes, function.restype = arguments, result
    return found


def polling_state(polling: ReplyPolling | None) -> ctypes.Structure:
    """Return the `Polling` struct of kernel.c in its initial state. None disables polling for replies."""
    if polling is None:
        return STRUCTS["Polling"]()
    return STRUCTS["Polling"](
        share=polling.share,
        longest_ns=polling.longest_ns,
        updated_ns=-1,  # The credit was never updated
        step_ns=polling.margin_ns,  # First step by which sleeps are shortened that end after the reply
        margin_ns=polling.margin_ns,
        saved_ns=50_000_000,  # Cap of the polling credit: a long pause must not pay for a burst of polling
        enabled=1,
    )


class PlannedRead(msgspec.Struct, frozen=True):
    """One read of a cycle: its transaction, the members that answer, and the error bytes that they are
    expected to report."""

    transaction: Transaction
    indices: tuple[int, ...]  # Indices of members of the bus, in the order of their replies
    errors: tuple[int, ...]


class KernelProgram:
    """The reads of one bus in a cycle, laid out as C structs for the kernel."""

    def __init__(self, plan: BusPlan, reads: Sequence[PlannedRead]) -> None:
        self._kept: list[object] = []  # Keeps buffers alive: the kernel has only their addresses
        self.count = len(reads)
        self.reads = _array(_Read, [self._read_structure(plan, read) for read in reads])
        self.bytes = max((read.record_bytes for read in self.reads[: self.count]), default=0)
        """Space in the log that the largest read needs with its replies, bytes."""

    def _keep(self, data: bytes) -> int:
        kept = ctypes.create_string_buffer(data, len(data))
        self._kept.append(kept)
        return ctypes.addressof(kept)

    def _read_structure(self, plan: BusPlan, read: PlannedRead) -> ctypes.Structure:
        transaction = read.transaction
        expected, known, packets, parts = (_fast_replies if transaction.fast else _replies)(plan, read)
        byte_ns = BITS_PER_BYTE * 1_000_000_000 // plan.baud_rate
        packet_array, part_array = _array(_Packet, packets), _array(_Part, parts)
        self._kept += [packet_array, part_array]
        instruction = transaction.packet
        recorded = sum(RECORD_HEADER + packet.end - packet.start for packet in packets)
        return _Read(
            instruction=self._keep(instruction),
            expected=self._keep(expected),
            known=self._keep(known),
            packets=ctypes.addressof(packet_array),
            parts=ctypes.addressof(part_array),
            instruction_size=len(instruction),
            size=len(expected),
            packet_count=len(packets),
            part_count=len(parts),
            id=transaction.servo_id,
            fast=transaction.fast,
            firm_size=parts[-1 - transaction.tail].end if 0 < transaction.tail < len(parts) else 0,
            tail_timeout_ns=transaction.tail_timeout_ns,
            tail_margin_ns=transaction.tail_margin_ns,
            due_ns=transaction.due_ns,
            timeout_ns=transaction.timeout_ns,
            least_ns=(len(instruction) + packets[0].end) * byte_ns,
            record_bytes=RECORD_HEADER + len(instruction) + recorded,
        )


_Replies = tuple[bytes, bytes, list[ctypes.Structure], list[ctypes.Structure]]


def _replies(plan: BusPlan, read: PlannedRead) -> _Replies:
    """Return the expected replies to a plain read, one packet per member, with the mask of the bytes that
    are known in advance."""
    dialect = dialect_of(plan.protocol)
    data_at = dialect.OVERHEAD - dialect.CHECKSUM
    expected, known = b"", b""
    packets: list[ctypes.Structure] = []
    parts: list[ctypes.Structure] = []
    for awaited, servo, error in zip(read.transaction.awaited, read.indices, read.errors, strict=True):
        start = len(expected)
        packet = dialect.status_packet(awaited.servo_id, error, bytes(awaited.length))
        expected += packet
        # The mask is 0 for parameters and checksum, which are not known in advance.
        known += b"\xff" * data_at + bytes(len(packet) - data_at)
        packets.append(_Packet(start, len(expected), awaited.servo_id))
        parts.append(_Part(servo, start + data_at, len(expected)))
    return expected, known, packets, parts


def _fast_replies(plan: BusPlan, read: PlannedRead) -> _Replies:
    """Return the expected single reply to a fast read, with the mask of known bytes (e-Manual, Protocol
    2.0, "Fast Sync Read (0x8A)")."""
    dialect = dialect_of(plan.protocol)
    awaited = read.transaction.awaited
    size = dialect.fast_size(sum(one.length for one in awaited), len(awaited))
    expected = dialect.HEADER + bytes((BROADCAST_ID,)) + (size - 7).to_bytes(2, "little") + b"\x55"
    known = b"\xff" * len(expected)
    parts: list[ctypes.Structure] = []
    for one, servo, error in zip(awaited, read.indices, read.errors, strict=True):
        data_at = len(expected) + 2
        expected += bytes((error, one.servo_id)) + bytes(one.length + dialect.CHECKSUM)
        known += b"\xff\xff" + bytes(one.length + dialect.CHECKSUM)
        parts.append(_Part(servo, data_at, len(expected)))
    return expected, known, [_Packet(0, size, BROADCAST_ID)], parts


class SyncWrites(Protocol):
    """The sync writes of one bus."""

    @property
    def sync_writes(self) -> tuple[SyncWrite, ...]:
        """The sync writes, in the order of sending; replaced as a whole when one changes."""
        ...


class KernelGoals(msgspec.Struct, frozen=True):
    """Goals of one bus, with arrays that the exchange kernel reads without a copy."""

    arrays: SyncWrites
    included: NDArray[np.bool_]  # True for each servo that may get goals
    ceiling: Floats  # Speed limit of each servo toward a position, rad/s; NaN: no limit


class Kernel:
    """Interface to the compiled kernel, which reads and writes all lines of a robot in each cycle."""

    def __init__(
        self,
        lines: Lines,
        shared: Sequence[KernelGoals],
        samples: Samples,
        goals: Floats,
        packets: PacketLog,
        *,
        plans: Sequence[BusPlan] = (),
    ) -> None:
        """Pass plans, arrays and ports of all lines to the compiled kernel.

        Args:
            lines: The lines with their open ports.
            shared: One for each line.
            samples: States to fill.
            goals: Shape (4, joints), one row for each of COMMAND_INTERFACES; NaN: no goal.
            packets: Log of the exchanged packets.
            plans: One for each line; empty: those of `lines`.
        """
        self._library = library()
        self._buses = lines.buses
        plans = plans or lines.plans
        self._shared = tuple(shared)
        self._packets = packets
        self._ports = lines.ports
        self._beat = lines.beat
        self._clock = lines.clock
        self._now_ns = lines.clock.now_ns
        self._raised: BaseException | None = None
        self._kept: list[object] = [samples, goals]
        self._buffers = [ctypes.create_string_buffer(_ROOM) for _ in shared]
        self.programs: list[KernelProgram | None] = [None] * len(shared)  # The program that reads each bus
        self._writes: list[tuple[SyncWrite, ...]] = [()] * len(shared)
        self._written: list[object] = [None] * len(shared)
        self._kernel = STRUCTS["Kernel"](beat_ns=BEAT_NS)
        self._lines = self._laid_lines(plans)
        self._lay_states(plans, samples, goals)
        self._lay_devices(plans, samples.devices)
        self._lay_ports()
        desk = packets.desk
        self._room = NEVER
        if desk is not None:
            self._room = len(desk.records)
            self._kernel.desk = ctypes.addressof(array_of(desk.records))
            self._kernel.used = ctypes.addressof(array_of(desk.used.cast("B")))
            self._kernel.desk_room = self._room
        self._pointer = ctypes.cast(ctypes.pointer(self._kernel), c_void_p)
        self.read: Callable[[], int] = partial(self._library.dxl_read, self._pointer)
        """Read every servo once, in C. Returns 0, or a code for `finish_read`."""
        samples.take = partial(self._library.dxl_take, self._pointer)
        samples.settle_all = partial(self._library.dxl_settle, self._pointer)
        samples.show = partial(self._library.dxl_show, self._pointer)
        self.write: Callable[[], int] = partial(self._library.dxl_write, self._pointer)
        """Send the goals that are due, in C. Returns 0, or a code for `finish_write`."""

    def _laid_lines(self, plans: Sequence[BusPlan]) -> ctypes.Array[ctypes.Structure]:
        lines = (STRUCTS["Line"] * max(len(self._buses), 1))()
        first = first_block = 0
        for index, (line, bus, plan, shared) in enumerate(
            zip(lines, self._buses, plans, self._shared, strict=False)
        ):
            line.included = shared.included.ctypes.data
            line.ceiling = shared.ceiling.ctypes.data
            line.buffer = ctypes.addressof(self._buffers[index])
            line.words, _ = bus.words.buffer_info()
            line.room = _ROOM
            line.byte_ns, line.latency_ns = bus.byte_ns, plan.latency_ns
            line.bus = index
            line.protocol = int(plan.protocol)
            line.first_servo, line.servo_count = first, len(plan.servos)
            first += len(plan.servos)
            line.first_block, line.block_count = first_block, len(plan.members) - len(plan.servos)
            first_block += line.block_count
        self._kernel.lines = ctypes.addressof(lines)
        self._kernel.line_count = len(self._buses)
        return lines

    def _lay_states(self, plans: Sequence[BusPlan], samples: Samples, goals: Floats) -> None:
        servos = [servo for plan in plans for servo in plan.servos]
        kernel = self._kernel
        kernel.servo_count = len(servos)
        laid = (_Servo * max(len(servos), 1))()
        for one, servo, quick in zip(laid, servos, samples.jumps.always_possible.tolist(), strict=False):
            layout = servo.state
            one.fields = (_Field * 3)(*map(_field, (layout.position, layout.velocity, layout.effort)))
            one.row, one.quick = servo.row, quick
        kernel.servos = self._lay(laid)
        for name in ("values", "scale", "reference", "fresh", "doubted", "at_ns", "shown_ns"):
            setattr(kernel, name, _data(getattr(samples, name)))
        for name in ("position", "velocity", "effort", "valid", "age_ns"):
            setattr(kernel, name, _data(getattr(samples.states, name)))
        kernel.goals = (c_void_p * 4)(*(_data(row) for row in goals))

    def _lay_devices(self, plans: Sequence[BusPlan], samples: DeviceSamples) -> None:
        kernel, sources = self._kernel, samples.sources
        fields: list[ctypes.Structure] = []
        blocks: list[ctypes.Structure] = []
        devices: list[ctypes.Structure] = []
        for device in (device for plan in plans for device in plan.devices):
            devices.append(_Device(len(blocks), len(device.blocks), device.source))
            for block in device.blocks:
                blocks.append(_Block(len(fields), len(block.fields)))
                fields += [
                    _DeviceField(_field(one.place), one.scale, one.offset, one.column) for one in block.fields
                ]
        kernel.device_count = len(devices)
        kernel.devices = self._lay(_array(_Device, devices))
        kernel.blocks = self._lay(_array(_Block, blocks))
        kernel.fields = self._lay(_array(_DeviceField, fields))
        kernel.device_values, kernel.block_fresh = _data(samples.values), _data(samples.fresh)
        kernel.block_at_ns, kernel.device_shown_ns = _data(samples.at_ns), _data(samples.shown_ns)
        kernel.device_doubted = _data(samples.doubted)
        kernel.source_values, kernel.source_valid = _data(sources.values), _data(sources.valid)
        kernel.source_age_ns = _data(sources.age_ns)

    def _lay(self, array: ctypes.Array[ctypes.Structure]) -> int:
        """Keep an array alive, because the kernel has only its address; return the address."""
        self._kept.append(array)
        return ctypes.addressof(array)

    def _lay_ports(self) -> None:
        """Pass the kernel file descriptors of the ports, or their functions if there are none, as in a
        simulation."""
        if (descriptors := self._ports.descriptors) is not None:
            for line, descriptor in zip(self._lines, descriptors, strict=False):
                line.descriptor = descriptor
            return
        self._kernel.beat_ns = NEVER
        self._kernel.ports = self._ports.functions or self._functions_in_python()

    def _functions_in_python(self) -> int:
        """Return the address of functions that call the methods of the ports."""
        calls = {
            "now": _NOW(self._now),
            "send": _TRANSFER(self._send),
            "receive": _TRANSFER(self._receive),
            "wait": _WAIT(self._wait),
            "sleep": _SLEEP(self._sleep),
        }
        made = STRUCTS["PortFunctions"](**{name: ctypes.cast(call, c_void_p) for name, call in calls.items()})
        self._kept += [calls, made]
        return ctypes.addressof(made)

    # Functions of ports that have no compiled ones. C cannot propagate an exception, such as a
    # KeyboardInterrupt. The exception is stored, every later callback fails, and `_raise` raises it when the
    # kernel has returned.

    def _now(self, _: int | None) -> int:
        try:
            return self._now_ns()
        except BaseException as error:
            self._keep_raised(error)
            return NEVER

    def _send(self, _: int | None, line: int, data: ctypes._Pointer[c_uint8], size: int) -> int:
        try:
            self._ports.ports[line].write_packet(bytes(data[:size]))
        except PortError:
            return -1
        except BaseException as error:
            self._keep_raised(error)
            return -1
        return -1 if self._raised else size

    def _receive(self, _: int | None, line: int, data: ctypes._Pointer[c_uint8], room: int) -> int:
        array = ctypes.cast(data, POINTER(c_uint8 * room)).contents
        try:
            count = self._ports.ports[line].read_into(memoryview(array).cast("B"))
        except PortError:
            return -1  # The parser calls the port again and gets the reason
        except BaseException as error:
            self._keep_raised(error)
            return -1
        return -1 if self._raised else count

    def _sleep(self, _: int | None, until_ns: int) -> None:
        try:
            self._clock.wait_until(until_ns)
        except BaseException as error:
            self._keep_raised(error)

    def _wait(self, _: int | None, deadline_ns: int, ready: ctypes._Pointer[c_uint8]) -> int:
        # After an exception report all lines as readable, so that their calls fail
        indices: Sequence[int] = range(len(self._buses))
        try:
            if self._raised is None:
                indices = self._ports.wait_for_bytes(deadline_ns)
        except BaseException as error:
            self._keep_raised(error)
        for index in indices:
            ready[index] = 1
        return len(indices)

    def _raise(self) -> None:
        """Raise the exception that a callback stored while the kernel ran, if any."""
        if (error := self._raised) is not None:
            self._raised, self._kernel.raised = None, 0
            self.abandon()
            raise error

    def _keep_raised(self, error: BaseException) -> None:
        self._raised, self._kernel.raised = error, 1

    def poll_for_replies(self) -> None:
        """Let the kernel poll for replies instead of sleeping, if the ports are configured for it. Call
        before real-time scheduling starts."""
        self._kernel.polling = polling_state(self._ports.polling)

    def plan(self, index: int, program: KernelProgram) -> bool:
        """Use a program for the reads of a bus from the next cycle on.

        Returns:
            False when the program is too large: the log's batch must hold the packets of all lines at
                once, and the replies to one read must fit into a quarter of the line's buffer.
        """
        sizes = [read.size for read in program.reads[: program.count]]
        if program.bytes * len(self._buses) > self._room or max(sizes, default=0) > _ROOM // 4:
            return False
        line = self._lines[index]
        self.programs[index] = program
        line.planned = int(program.count > 0)
        line.reads, line.read_count = ctypes.addressof(program.reads), program.count
        return True

    def finish_read(self, code: int) -> Answer:
        """Continue a read that returned a code, until it is complete or the parser must take over; return
        the final result."""
        while True:
            self._raise()
            if code == Answer.WAITING:
                self._beat()
            elif code == Answer.FULL:
                self._packets.commit_packets()
            else:
                return Answer(code)
            code = self.read()

    def plan_writes(self) -> None:
        """Pass the kernel the sync writes of each bus whose goals were rebuilt, as after a change of mode
        or limits."""
        for index, shared in enumerate(self._shared):
            if shared.arrays.sync_writes is not self._writes[index]:
                self._take_writes(index, shared.arrays.sync_writes)

    def finish_write(self, code: int) -> dict[int, PortError]:
        """Continue a write that returned a code; return the failures of the lines since the last call, by
        index."""
        while code == Answer.FULL:
            self._packets.commit_packets()
            code = self.write()
        self._raise()
        if code == Answer.OK:
            return {}
        found = {index: self._failure(index) for index in range(len(self._buses))}
        return {index: failure for index, failure in found.items() if failure is not None}

    def _take_writes(self, index: int, writes: tuple[SyncWrite, ...]) -> None:
        self._writes[index] = writes
        laid = [_laid_write(one) for one in writes]
        array = _array(_SyncWrite, [one for one, _ in laid])
        self._written[index] = (array, [kept for _, kept in laid])
        line = self._lines[index]
        line.writes, line.write_count = ctypes.addressof(array), len(laid)

    def _failure(self, index: int) -> PortError | None:
        """Return the write failure of a line and forget it; None without a failure."""
        line = self._lines[index]
        code, line.gone = line.gone, 0
        return self._ports.ports[index].failure(code) if code else None

    def line(self, index: int) -> tuple[ctypes.Structure, PortError | None]:
        """Return the kernel's struct of a line in an unfinished cycle, and the line's write failure."""
        return self._lines[index], self._failure(index)

    def pieces(self, index: int) -> Iterator[tuple[bytes, int]]:
        """Yield the received bytes of a line that the kernel could not use, each piece with its arrival
        time, ns."""
        line, start = self._lines[index], 0
        for piece in line.piece[: line.pieces]:
            yield ctypes.string_at(line.buffer + start, piece.end - start), piece.at_ns
            start = piece.end

    def abandon(self) -> None:
        """End a cycle that the kernel has not finished."""
        self._library.dxl_abandon(self._pointer)


def _laid_write(write: SyncWrite) -> tuple[ctypes.Structure, list[object]]:
    """Return a sync write as a struct for the kernel, and the objects that must stay alive while it is
    used."""
    count, items = len(write.members), max(map(len, write.cells), default=0)
    arrays: dict[str, NDArray[np.generic]] = {
        "members": np.array(write.members, dtype=np.int32),
        "rows": np.array(write.rows, dtype=np.int32),
        "ids": np.array(write.ids, dtype=np.uint8),
        "ticks": np.zeros(count * items, dtype=np.int32),
        "again": np.zeros(count, dtype=np.uint8),
        "served": np.zeros(count, dtype=np.uint8),
        "sent_at": np.zeros(count, dtype=np.int64),
    }
    cells = _array(
        _Cell,
        [
            _Cell(
                at=cell.place.offset,
                size=cell.place.size,
                interface=cell.interface,
                magnitude=cell.magnitude,
                mirrored=cell.place.encoding == "sign_magnitude" and not cell.magnitude,
                low=cell.low,
                high=cell.high,
                free=cell.free,
                sign=cell.sign,
                offset=cell.offset,
                unit=cell.unit,
            )
            for servo in write.cells
            for cell in servo
        ],
    )
    laid = _SyncWrite(
        count=count,
        items=items,
        address=write.layout.address,
        length=write.layout.length,
        lead=write.lead,
        leads=write.leads,
        always=write.always,
        cells=ctypes.addressof(cells),
        **{name: array.ctypes.data for name, array in arrays.items()},
    )
    return laid, [arrays, cells]


def _array(kind: type[ctypes.Structure], items: Sequence[ctypes.Structure]) -> ctypes.Array[ctypes.Structure]:
    """Return a C array of structs, with at least one element: an empty array has no address."""
    return (kind * max(len(items), 1))(*items)


def _field(field: Field) -> ctypes.Structure:
    bit = -1 if field.bit is None else field.bit
    return _Field(field.offset, field.size, _ENCODINGS[field.encoding], bit)


def _data(array: NDArray[np.generic]) -> int:
    """Return the address of a numpy array's memory.

    Raises:
        ValueError: The array is not contiguous.
    """
    if not array.flags.c_contiguous:
        raise ValueError("the kernel requires contiguous arrays")
    return array.ctypes.data
