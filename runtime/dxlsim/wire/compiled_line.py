"""Line in C: loads `line.c`, which frames instructions, answers reads and times replies, and gives its
structs and packet functions to Python.

The packets of both protocols are composed and parsed only there."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from ctypes import byref, c_char_p, c_int32, c_int64, c_uint16, c_void_p
from enum import IntEnum, unique
from functools import cache
from pathlib import Path
from weakref import finalize

from dxlsim.wire.servo_packets import GroupRead, Instruction, InstructionPacket, ReadEntry
from dxlwire.compiled import load_compiled, parse_structs

SOURCE = Path(__file__).with_name("line.c")
STRUCTS = parse_structs(SOURCE.read_text())
(
    NodeState,
    GoalState,
    LineState,
    LedgerState,
    Entry,
    Asked,
    Port,
    Ports,
    TerminalState,
    ServerState,
) = (
    STRUCTS[name]
    for name in (
        *("Node", "Goal", "Line", "Ledger", "Entry", "Asked"),
        *("Port", "Ports", "Terminal", "Server"),
    )
)
_Packet, _Receiver = STRUCTS["Packet"], STRUCTS["Receiver"]
TASK = ctypes.CFUNCTYPE(c_int64, c_int32, c_int64, c_int64)
"""Function of Python that a line calls: number of the task, two arguments; the result depends on the task."""
ADVANCE = ctypes.CFUNCTYPE(c_int64, c_int64)
"""Function of Python that lets a virtual clock make the calls that are due until a time, ns."""
STALLED = ctypes.CFUNCTYPE(None, c_int64, c_int64)
"""Function of Python that publishes an interval, ns, in which the process had no core."""
NEVER_NS = 1 << 62  # Time of an event that does not happen
_FAST_READS = frozenset((Instruction.FAST_SYNC_READ, Instruction.FAST_BULK_READ))
_OVERHEAD = 16  # Bytes of a status packet without parameters, and more


@unique
class Task(IntEnum):
    """Tasks that a line leaves to Python; the order is that of line.c."""

    STEP = 0  # Advance the mechanics to a time
    RECEIVES = 1  # Decide if a node receives an instruction that ends at a time
    PRESENT = 2  # Set the registers of so many `asked` ranges to their values at a time
    EXECUTE = (
        3  # Execute an instruction for a node; the result is the error, -1 for an instruction without reply
    )
    EXECUTE_ALL = 4  # Execute an instruction of a recorded bus
    REFUSED = 5  # A node rejects a read with an error
    STAYS_OUT = 6  # A node does not reply to a group read; 1: because of an error
    CHAIN = 7  # Devices wait for the status packets before their own
    OVERHEAR = 8  # Devices receive the status packet of an ID
    NOTE = 9  # Add a text, by address and size, to the ledger
    ACT = 10  # Do the next planned action
    ACT_AFTER = 11  # Do the actions that are planned for this number of packets
    DISTURB = 12  # Apply a fault to the next reply of an ID; the result is 1 if anything was sent
    ALTER = 13  # Apply a fault to an instruction
    PIECE = 14  # Draw the size of the next piece of a delivery
    LEDGER = 15  # Take the entries of the ledger
    RATE = 16  # The host has set another baud rate
    WRITTEN = 17  # A servo follows goals that were written, by their bits


_FUNCTIONS: dict[str, tuple[type | None, tuple[object, ...]]] = {
    "accept": (c_int32, (c_void_p, c_int64)),
    "crc": (c_uint16, (c_char_p, c_int64, c_uint16)),
    "deliver": (None, (c_void_p, c_int64)),
    "discard": (None, (c_void_p,)),
    "discard_packet": (None, (c_void_p,)),
    "drain": (c_int64, (c_void_p, c_int64, c_int64)),
    "early": (c_int64, (c_int64, c_int64)),
    "execute": (None, (c_void_p, c_char_p, c_int64, c_int64)),
    "execute_altered": (None, (c_void_p, c_char_p, c_int64)),
    "feed": (c_int32, (c_void_p, c_char_p, c_int64, c_int64, c_void_p)),
    "find_delivery": (c_int64, (c_void_p,)),
    "forget": (None, (c_void_p,)),
    "free": (None, (c_void_p,)),
    "free_ledger": (None, (c_void_p,)),
    "free_receiver": (None, (c_void_p,)),
    "group_read": (c_int32, (c_int32, c_void_p, c_void_p)),
    "new": (c_void_p, (c_int32, c_int64)),
    "next_delivery": (c_int64, (c_void_p, c_int64)),
    "next_due": (c_int64, (c_void_p,)),
    "open_port": (None, (c_void_p, c_int32)),
    "open_ports": (None, (c_void_p,)),
    "pass_time": (None, (c_void_p, c_int64)),
    "plug": (None, (c_void_p, c_int32)),
    "port_receive": (c_int32, (c_void_p, c_int32, c_void_p, c_int32)),
    "port_send": (c_int32, (c_void_p, c_int32, c_char_p, c_int32)),
    "port_wait": (c_int32, (c_void_p, c_int64, c_void_p)),
    "rates_match": (c_int32, (c_int64, c_int64)),
    "read": (c_int32, (c_int32, c_char_p, c_int32, c_void_p)),
    "read_chunk": (c_int32, (c_void_p,)),
    "receive": (None, (c_void_p, c_char_p, c_int64, c_int64)),
    "receiver": (c_void_p, (c_int32,)),
    "send": (None, (c_void_p, c_char_p, c_int64, c_int64, c_char_p)),
    "send_copy": (None, (c_void_p, c_char_p, c_int64, c_int64, c_int32, c_int32)),
    "send_reply": (None, (c_void_p, c_int32, c_char_p, c_int64, c_int64, c_int64)),
    "set_timer": (None, (c_void_p, c_int64)),
    "serve": (c_int32, (c_void_p,)),
    "start": (None, (c_void_p,)),
    "status": (c_int64, (c_int32, c_int32, c_int32, c_char_p, c_int64, c_void_p)),
    "take": (c_int64, (c_void_p, c_void_p, c_int64)),
    "watch": (None, (c_void_p, c_int32)),
    "withdraw": (None, (c_void_p,)),
}
"""Functions of the library without their prefix, with the types of result and arguments."""


class LineLibrary(ctypes.PyDLL):
    """The compiled line. Calls hold the interpreter lock, because they are shorter than its release; while a
    server sleeps, its functions `release` and `acquire` give the lock to other threads."""


@cache
def line_library() -> LineLibrary:
    """Load the compiled line and declare the types of its functions.

    Raises:
        NotCompiled: The line was not built, or was built from another source.
    """
    found = load_compiled(SOURCE, LineLibrary)
    for name, (result, arguments) in _FUNCTIONS.items():
        function = getattr(found, f"line_{name}", None)  # Only Linux has those of pseudo-terminals
        if function is not None:
            function.argtypes, function.restype = arguments, result
    return found


def line_function(name: str) -> Callable[..., int]:
    """Return a function of the library by its name without prefix."""
    found: Callable[..., int] = getattr(line_library(), f"line_{name}")
    return found


def new_line(protocol: float, start_ns: int, owner: object) -> tuple[int, ctypes.Structure]:
    """Return the address of a new line, which lives as long as its owner, and its state."""
    address = line_function("new")(int(protocol), start_ns)
    _free_with(owner, "free", address)
    return address, LineState.from_address(address)


def new_ledger(owner: object) -> ctypes.Structure:
    """Return the state of a new ledger, whose entries live as long as its owner."""
    state = LedgerState()
    _free_with(owner, "free_ledger", byref(state))
    return state


def _free_with(owner: object, name: str, memory: object) -> None:
    """Free memory by a function of the library as soon as its owner is gone. At the exit of the interpreter
    it stays: the thread of a served bus may still use it."""
    finalize(owner, line_function(name), memory).atexit = False


def packet_of(state: ctypes.Structure) -> InstructionPacket:
    """Return the instruction packet of a `Packet` struct."""
    parameters = ctypes.string_at(state.parameters, state.size)
    raw = ctypes.string_at(state.raw, state.raw_size)
    return InstructionPacket(state.id, state.instruction, parameters, bool(state.intact), state.end, raw)


class InstructionReceiver:
    """Extracts instruction packets from the bytes that a host sends on a line, despite noise; holds at most
    one packet."""

    def __init__(self, protocol: float) -> None:
        self._address = line_function("receiver")(int(protocol))
        self._state = _Receiver.from_address(self._address)
        self._found = _Packet()
        _free_with(self, "free_receiver", self._address)

    @property
    def pending(self) -> int:
        """Number of received bytes of an incomplete packet."""
        return int(self._state.held.size)

    def feed_bytes(self, data: bytes | bytearray, start: int = 0) -> InstructionPacket | None:
        """Process `data` from `start` until a packet is complete, and return the packet.

        None means that all bytes were processed without completing a packet. A packet with a wrong
        checksum is returned, too. Continue at `packet.end`."""
        found = byref(self._found)
        complete = line_function("feed")(self._address, bytes(data), len(data), start, found)
        return packet_of(self._found) if complete else None


def group_read(protocol: float, packet: InstructionPacket) -> GroupRead | None:
    """Parse a sync, bulk or fast read; return None for another or a malformed instruction."""
    parameters, size = packet.parameters, len(packet.parameters)
    given = _Packet(
        parameters=ctypes.cast(c_char_p(parameters), c_void_p),
        size=size,
        id=packet.servo_id,
        instruction=packet.instruction,
        intact=packet.intact,
    )
    entries = (Entry * max(size, 1))()
    count = line_function("group_read")(int(protocol), byref(given), entries)
    if not count:
        return None
    listed = tuple(ReadEntry(each.id, each.address, each.length) for each in entries[:count])
    return GroupRead(packet.instruction, listed, fast=packet.instruction in _FAST_READS)


def read_place(protocol: float, parameters: bytes) -> tuple[int, int] | None:
    """Return address and length from the parameters of a read; None if they are malformed."""
    place = Entry()
    known = line_function("read")(int(protocol), parameters, len(parameters), byref(place))
    return (place.address, place.length) if known else None


def status_packet(protocol: float, servo_id: int, error: int, parameters: bytes = b"") -> bytes:
    """Return the bytes of a status packet, the reply of a servo."""
    made = ctypes.create_string_buffer(2 * len(parameters) + _OVERHEAD)
    size = line_function("status")(int(protocol), servo_id, error, parameters, len(parameters), made)
    return made.raw[:size]


def crc16(data: bytes, crc: int = 0) -> int:
    """Return the CRC-16 of bytes: polynomial 8005 (hex), not reflected; `crc` is that of the bytes before."""
    return line_function("crc")(data, len(data), crc)
