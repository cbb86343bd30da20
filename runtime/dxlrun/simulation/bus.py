"""A simulated bus: bytes in -> timed bytes out; one half-duplex line, its servos, faults and ledger.

The rules of the line:

- A byte takes 10 bits. An instruction acts when its last byte has passed; a reply starts after the servo's
  return delay, and the host gets it when its last byte has passed.
- Who talks does not listen. Where the host talks into a reply, its bytes arrive as 0, and the reply is lost
  from there on.
- Servos that talk at once (a broadcast ping, two servos with one ID) give one reply of their bytes ANDed, as
  drivers that both pull a line low would [i].
- A pause inside an instruction ends it: more than 100 ms (Protocol 1.0), more than 1.5 ms (Protocol 2.0).
- Servos that are read in turn answer one after the other, each its return delay after the one before it.
- A servo at another baud rate hears nothing.
"""

from __future__ import annotations

import heapq
import itertools
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

from dxlrun.simulation import protocol1, protocol2
from dxlrun.simulation.ledger import Ledger
from dxlrun.simulation.mechanics import Mechanics
from dxlrun.simulation.packets import BROADCAST, Codec, InstructionPacket, ReadEntry, ReadInTurn, Reply
from dxlrun.simulation.servo import ServoConfig, SimulatedServo

STATUS_BYTES = 11
"""Bytes of a status packet of Protocol 2.0 without data: the slot of an absent servo is as long [i]."""

UNREAD_LIMIT = 4096
"""Bytes that wait for a host that does not take them; more are lost, as in the kernel's terminal buffer."""


@dataclass(frozen=True, slots=True)
class BusConfig:
    """One serial line and the servos that hang on it."""

    name: str
    baud_rate: int
    """bit/s, of the host and, at the start, of every servo"""
    servos: tuple[ServoConfig, ...]
    protocol: float = 1.0
    """1.0 or 2.0: one bus speaks one protocol"""
    control_tables: tuple[str, ...] = ()
    """Texts of the control tables that plug-ins brought along: this process loads no plug-ins."""


@dataclass(frozen=True, slots=True)
class _Chunk:
    """Bytes on their way to the host."""

    first_ns: int
    """When the first of them begins to pass the wire."""
    due_ns: int
    """When the last of them has passed it."""
    data: bytes
    note: str = ""


@dataclass(frozen=True, slots=True)
class _Fault:
    """What happens to the next reply of a servo."""

    text: str
    change: Callable[[bytes], bytes]
    delay_ns: int = 0


class SimulatedBus:
    """One line; time comes from the caller and never goes back."""

    def __init__(
        self, config: BusConfig, ledger: Ledger, start_ns: int, mechanics: Mechanics | None = None
    ) -> None:
        self.name = config.name
        self.baud_rate = config.baud_rate
        """The host's rate, bit/s."""
        self.echo = False
        """True: the adapter gives the host its own bytes back."""
        self.skips_absent = False
        """Protocol 2.0, a listed servo is absent: True: those after it answer later; False: never [?]."""
        self.ledger = ledger
        self._now_ns = start_ns
        self.mechanics = mechanics or Mechanics(start_ns)
        """What the servos move; several buses of one robot share it."""
        self._host_free_ns = start_ns
        self._codec: Codec = protocol2 if config.protocol == 2.0 else protocol1
        self._receiver = self._codec.receiver()
        self._pending: list[_Chunk] = []
        self._faults: dict[int, deque[_Fault]] = {}
        self._agenda: list[tuple[int, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self.servos = tuple(
            SimulatedServo(
                servo, config.baud_rate, start_ns, self.note, config.protocol, mechanics=self.mechanics
            )
            for servo in config.servos
        )

    # The line

    def receive(self, data: bytes | bytearray | memoryview, at_ns: int) -> None:
        """Take bytes that the host hands to its adapter at `at_ns`; they follow those still on the wire."""
        self._pass_time(at_ns)
        heard = bytearray(data)
        self.ledger.add(at_ns, self.name, "in", bytes(heard))
        start_ns = max(at_ns, self._host_free_ns)
        if self._receiver.pending and start_ns - self._host_free_ns > self._codec.LONGEST_PAUSE_NS:
            self.note(f"an instruction of {self._receiver.pending} bytes was broken off")
            self._receiver.forget()
        self._host_free_ns = start_ns + self._wire_ns(len(heard))
        position = 0
        while position < len(heard):
            if self._pending:
                self._collide(heard, position, start_ns)
            packet = self._receiver.feed(heard, position)
            if packet is None:
                break
            position = packet.end
            self._execute(packet, start_ns + self._wire_ns(position))
        if self.echo:
            self._pending.append(_Chunk(start_ns, self._host_free_ns, bytes(data), "echo"))
            self._pending.sort(key=_due)

    def change_rate(self, baud_rate: int) -> None:
        """Let the host talk and listen at another rate from now on, bit/s."""
        self.note(f"the host's rate is {baud_rate} bit/s")
        self.baud_rate = baud_rate

    def next_due_ns(self) -> int | None:
        """Return when the next bytes can be taken or the next planned fault happens; None: nothing will."""
        times = [self._pending[0].due_ns] if self._pending else []
        if self._agenda:
            times.append(self._agenda[0][0])
        return min(times, default=None)

    def take(self, now_ns: int) -> bytes:
        """Return the bytes that have reached the host by `now_ns`, each once."""
        self._pass_time(now_ns)
        if not self._pending or self._pending[0].due_ns > now_ns:
            return b""
        arrived = bytearray()
        while self._pending and self._pending[0].due_ns <= now_ns:
            chunk = self._pending.pop(0)
            self.ledger.add(chunk.due_ns, self.name, "out", chunk.data, chunk.note)
            arrived += chunk.data
        return bytes(arrived)

    # What tests see and do

    @property
    def now_ns(self) -> int:
        """The time that the bus has reached."""
        return self._now_ns

    def servo(self, servo_id: int) -> SimulatedServo:
        """Return the first servo that has this ID now; raises LookupError when none has."""
        for servo in self.servos:
            if servo.servo_id == servo_id:
                return servo
        raise LookupError(f"bus {self.name} has no servo with ID {servo_id}")

    def advance(self, now_ns: int) -> None:
        """Bring every servo to a time, so that a test can look at it."""
        self._pass_time(now_ns)
        for servo in self.servos:
            servo.advance(now_ns)

    def at(self, t_ns: int, action: Callable[[], None]) -> None:
        """Plan a fault: `action` is called when the bus' time reaches `t_ns`."""
        heapq.heappush(self._agenda, (t_ns, next(self._order), action))

    def note(self, text: str) -> None:
        """Enter a note into the ledger, at the bus' time."""
        self.ledger.add(self._now_ns, self.name, "note", note=text)

    def corrupt_next(self, servo_id: int, index: int = -1, flip: int = 0x01) -> None:
        """Flip bits of one byte of a servo's next reply."""

        def change(reply: bytes) -> bytes:
            broken = bytearray(reply)
            broken[index] ^= flip
            return bytes(broken)

        self._plan_fault(servo_id, _Fault(f"byte {index} of its reply corrupted by {flip:#04x}", change))

    def truncate_next(self, servo_id: int, keep: int) -> None:
        """Let only the first `keep` bytes of a servo's next reply through; 0 loses it."""
        self._plan_fault(servo_id, _Fault(f"its reply cut to {keep} bytes", lambda reply: reply[:keep]))

    def delay_next(self, servo_id: int, delay_ns: int) -> None:
        """Let a servo's next reply start later."""
        self._plan_fault(
            servo_id, _Fault(f"its reply delayed by {delay_ns} ns", lambda reply: reply, delay_ns)
        )

    def inject_noise(self, data: bytes, at_ns: int) -> None:
        """Put bytes on the line that no servo sent, toward the host, beginning at `at_ns`."""
        self.note(f"noise of {len(data)} bytes at {at_ns} ns")
        self._send(_Chunk(at_ns, at_ns + self._wire_ns(len(data)), data, "noise"))

    # Inside

    def _pass_time(self, now_ns: int) -> None:
        while self._agenda and self._agenda[0][0] <= now_ns:
            t_ns, _, action = heapq.heappop(self._agenda)
            self._now_ns = max(self._now_ns, t_ns)
            action()
        self._now_ns = max(self._now_ns, now_ns)

    def _wire_ns(self, size: int) -> int:
        return size * 10_000_000_000 // self.baud_rate

    def _execute(self, packet: InstructionPacket, end_ns: int) -> None:
        reading = self._codec.read_in_turn(packet)
        if reading is not None:
            self._read_in_turn(reading, end_ns)
            return
        for servo in self.servos:
            if packet.servo_id not in (servo.servo_id, BROADCAST) or not self._hears(servo):
                continue
            reply = servo.execute(packet, end_ns)
            if reply is not None:
                self._answer(reply, self._status(reply), end_ns)

    def _read_in_turn(self, reading: ReadInTurn, end_ns: int) -> None:
        """Let the listed servos answer, each when the one before it has ended."""
        fast = self._codec.fast_status(reading.lengths) if reading.fast else None
        free_ns = end_ns
        for entry in reading.entries:
            reply = self._reply_in_turn(reading, entry, end_ns)
            if reply is not None:
                data = self._status(reply) if fast is None else fast.part(reply)
                free_ns = self._answer(reply, data, free_ns)
            elif reading.has_slots and self.skips_absent:
                free_ns += self._wire_ns(STATUS_BYTES + entry.length)
            else:
                self.note(f"servo {entry.servo_id} does not answer: those after it wait for it in vain")
                return

    def _reply_in_turn(self, reading: ReadInTurn, entry: ReadEntry, end_ns: int) -> Reply | None:
        servo = next((each for each in self.servos if each.servo_id == entry.servo_id), None)
        if servo is None or not self._hears(servo):
            return None
        reply = servo.answer_in_turn(reading, entry, end_ns)
        if reply is not None and reading.fast and entry is not reading.entries[0]:
            return replace(reply, delay_ns=0)  # only the first one of a shared status waits
        return reply

    def _status(self, reply: Reply) -> bytes:
        return self._codec.status_packet(reply.servo_id, reply.error, reply.parameters)

    def _hears(self, servo: SimulatedServo) -> bool:
        """Return whether the rates differ by less than 3 % (e-Manual, Baud Rate (4))."""
        return abs(servo.baud_rate - self.baud_rate) < 0.03 * self.baud_rate

    def _answer(self, reply: Reply, data: bytes, free_ns: int) -> int:
        """Send a servo's bytes, faults and all, some time after the line is free; return when they end."""
        first_ns = free_ns + reply.delay_ns
        faults = self._faults.get(reply.servo_id)
        if faults:
            fault = faults.popleft()
            self.note(f"servo {reply.servo_id}: {fault.text}")
            data = fault.change(data)
            first_ns += fault.delay_ns
        end_ns = first_ns + self._wire_ns(len(data))
        if data:
            self._send(_Chunk(first_ns, end_ns, data))
        return end_ns

    def _plan_fault(self, servo_id: int, fault: _Fault) -> None:
        self._faults.setdefault(servo_id, deque()).append(fault)

    def _send(self, chunk: _Chunk) -> None:
        """Put bytes on their way to the host, mixed with what is on the wire at the same time."""
        if sum(len(waiting.data) for waiting in self._pending) + len(chunk.data) > UNREAD_LIMIT:
            self.note(f"{len(chunk.data)} bytes to the host are lost: it does not read")
            return
        for other in [each for each in self._pending if _overlap(each, chunk.first_ns, chunk.due_ns)]:
            self._pending.remove(other)
            self.note(f"collision: {other.data.hex(' ')} and {chunk.data.hex(' ')} at once")
            chunk = self._mixed(other, chunk)
        self._pending.append(chunk)
        self._pending.sort(key=_due)

    def _mixed(self, one: _Chunk, other: _Chunk) -> _Chunk:
        early, late = sorted((one, other), key=lambda chunk: chunk.first_ns)
        offset = round((late.first_ns - early.first_ns) / self._wire_ns(1))
        mixed = bytearray(early.data).ljust(offset + len(late.data), b"\xff")
        for index, byte in enumerate(late.data, start=offset):
            mixed[index] &= byte
        return _Chunk(early.first_ns, early.first_ns + self._wire_ns(len(mixed)), bytes(mixed), "collision")

    def _collide(self, heard: bytearray, position: int, start_ns: int) -> None:
        """Spoil what the host sends from `position` on while a servo talks, and the rest of what it says."""
        byte_ns = self._wire_ns(1)
        begin_ns, end_ns = start_ns + self._wire_ns(position), start_ns + self._wire_ns(len(heard))
        for chunk in [each for each in self._pending if _overlap(each, begin_ns, end_ns)]:
            first = max(position, (chunk.first_ns - start_ns) // byte_ns)
            last = min(len(heard), -(-(chunk.due_ns - start_ns) // byte_ns))
            heard[first:last] = bytes(last - first)
            kept = max(0, (begin_ns - chunk.first_ns) // byte_ns)
            self.note(f"collision: the host talks into {chunk.data.hex(' ')}, {kept} bytes of it arrive")
            self._pending.remove(chunk)
            if kept:
                due_ns = chunk.first_ns + self._wire_ns(kept)
                self._pending.append(_Chunk(chunk.first_ns, due_ns, chunk.data[:kept], "collision"))
                self._pending.sort(key=_due)


def _due(chunk: _Chunk) -> int:
    return chunk.due_ns


def _overlap(chunk: _Chunk, begin_ns: int, end_ns: int) -> bool:
    return chunk.note != "echo" and chunk.first_ns < end_ns and begin_ns < chunk.due_ns
