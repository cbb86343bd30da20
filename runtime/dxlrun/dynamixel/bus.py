"""Bus: one resumable transaction machine per serial line; `pump` is the one wait that serves all of them.

A machine never waits: it writes an instruction, is fed the bytes that arrive, and is told the time. Whoever
pumps it decides when: read, write, or the gap before the next deadline.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from dxlrun.clock import Clock
from dxlrun.dynamixel.bus_plan import BusPlan
from dxlrun.dynamixel.dialect import dialect_of
from dxlrun.dynamixel.line import BITS_PER_BYTE
from dxlrun.dynamixel.port import Port, Ports
from dxlrun.dynamixel.receiver import Receiver
from dxlrun.dynamixel.transaction import (
    BROADCAST_ID,
    Job,
    Outcome,
    Reply,
    Status,
    Transaction,
)
from dxlrun.errors import PortError
from dxlrun.packets import PacketKind, PacketSink

if TYPE_CHECKING:  # the guardian makes servos limp without numpy
    from dxlrun.dynamixel.burst import Burst
    from dxlrun.dynamixel.lane import Lane

NEVER = 1 << 62
QUIET_BYTES = 20
"""A line that was silent for so many byte times is silent (protocol.md: drain until it is)."""
LEAST_QUIET_NS = 200_000
DRAIN_LIMIT_NS = 5_000_000
"""A line that babbles longer than this is not waited for."""

_READY, _AWAITING, _RESTING, _DRAINING = range(4)
# to look into an Enum takes as long as to pack a packet's record
_SENT, _OK, _TIMEOUT = Outcome.SENT, Outcome.OK, Outcome.TIMEOUT
_INSTRUCTION, _STATUS = PacketKind.INSTRUCTION, PacketKind.STATUS


class Bus:
    """Executes transactions on one line; every byte that goes over it is reported to the packet sink.

    A reply counts only when ID and length are exact and when it comes no sooner than the wire allows. Of
    several replies to one instruction each counts by itself, whatever became of the others. After a timeout
    the line is drained until it is silent, and what comes then is stray.
    """

    __slots__ = (
        "_awaited",
        "_burst",
        "_deadline_ns",
        "_dialect",
        "_drain_end_ns",
        "_earliest_ns",
        "_free_ns",
        "_job",
        "_lane",
        "_last_byte_ns",
        "_now_ns",
        "_open",
        "_overhead",
        "_port",
        "_quiet_ns",
        "_receiver",
        "_refused",
        "_reply",
        "_reply_size",
        "_room",
        "_sent_ns",
        "_sink",
        "_state",
        "buffer",
        "byte_ns",
        "due_ns",
        "failure",
        "index",
        "name",
        "noise_bytes",
        "room",
    )

    def __init__(self, index: int, plan: BusPlan, port: Port, clock: Clock, packets: PacketSink) -> None:
        self.name = plan.name
        self.failure: PortError | None = None
        """Why the line is gone; a bus with a failure does nothing more."""
        self.noise_bytes = 0
        """Bytes that belonged to no intact packet, since the start."""
        self.index = index
        """Its number in the log."""
        self._port = port
        self._now_ns = clock.now_ns
        self._sink = packets
        self.byte_ns = BITS_PER_BYTE * 1_000_000_000 // plan.baud_rate
        """What a byte takes on the wire, ns."""
        self._quiet_ns = max(QUIET_BYTES * self.byte_ns, LEAST_QUIET_NS) + plan.latency_ns
        self._dialect = dialect_of(plan.protocol)
        self._overhead = self._dialect.OVERHEAD
        self._receiver = Receiver(self._status, self._noise, self._dialect, self._gathered)
        self._reply = Reply(_SENT, 0, b"", 0, 0, False)
        self._job: Job | None = None
        self._lane: Lane | None = None
        self._awaited: Transaction | None = None
        self._state = _READY
        self.due_ns = 0
        """When the replies of the newest transaction are due by the wire."""
        self._burst: Burst | None = None  # until anything came
        self._room = self._receiver.space
        self.room = self._receiver.room
        """The most bytes that a burst of replies may have."""
        self.buffer = self._receiver.buffer
        """Where replies lie."""
        self._sent_ns = self._earliest_ns = self._deadline_ns = self._free_ns = 0
        self._drain_end_ns = 0
        self._reply_size = 0
        self._open = 0  # a bit for each status that is still awaited
        self._refused = False
        self._last_byte_ns = -NEVER

    @property
    def busy(self) -> bool:
        """True while a job is under way."""
        return self._job is not None

    @property
    def complete(self) -> bool:
        """True when everything that the newest transaction awaits has come."""
        return self._state == _READY and self._reply.outcome is _OK

    def renew(self, port: Port) -> None:
        """Go on with a line that is back in the place of one that is gone; its job is forgotten."""
        self._port = port
        self.failure = None
        self._job = self._awaited = self._burst = None
        self._state = _READY
        self._receiver.flush()  # the half of a packet that the lost line brought is nobody's

    def load(self, job: Job, lane: Lane | None = None) -> None:
        """Take a job; the next `step` begins it. What an aborted job left behind is forgotten.

        `lane`: the quick way through it, if there is one; see `straight`.
        """
        self._awaited = self._burst = None
        self._state = _READY
        self.receive()  # what came since the last job belongs to nobody
        if self.failure is not None:
            return
        self._job, self._lane = job, lane
        self._reply.strays = 0

    def straight(self, ports: Ports, beat: Callable[[], None]) -> None:
        """Go the quick way through a job that was just loaded; `step` does what is left of it.

        The line is the only one.
        """
        lane, self._lane = self._lane, None
        if lane is None or self._job is None:
            return
        if self._receiver.pending:
            self._receiver.flush()
        while self._now_ns() < self._free_ns:
            if ports.wait(self._free_ns):
                return  # nobody was asked
        try:
            lane.run(self._port, ports, self._room, self._now_ns, self._sink, beat)
        except PortError as error:
            lane.end()
            self._fail(error)
            return
        self._last_byte_ns = lane.at_ns
        transaction = lane.end()
        if transaction is None:
            self._job = None
            self.due_ns = lane.sent_ns + lane.stretches[-1].transaction.due_ns
            return
        self._burst = self._job.burst
        self._await(transaction, lane.sent_ns)
        self._free_ns = lane.sent_ns + len(transaction.packet) * self.byte_ns
        self._hear(lane.count, lane.at_ns)

    def begin_behind(self) -> None:
        """Send the first instruction of the loaded job at once, though the line may not be free yet.

        It waits in the adapter behind what was sent before, and its times count from when the line is free.
        """
        if self._job is not None:
            try:
                self._begin(self._job)
            except PortError as error:
                self._fail(error)

    def drop(self) -> None:
        """Forget the loaded job; what still comes for it belongs to nobody."""
        self._job = self._awaited = self._burst = None
        self._state = _READY

    def send(self, packet: bytes | bytearray | memoryview) -> None:
        """Send a prepared packet that nobody answers, between two jobs; does not wait.

        The next transaction starts when the packet is off the wire. Raises PortError when the line is gone.
        """
        if self.failure is None:
            try:
                self._write(packet, BROADCAST_ID)
            except PortError as error:
                self._fail(error)
        if self.failure is not None:
            raise self.failure

    def receive(self) -> None:
        """Take what the line has; called when it has bytes."""
        if self.failure is None:
            try:
                self._take_bytes()
            except PortError as error:
                self._fail(error)

    def _take_bytes(self) -> None:
        receiver = self._receiver
        if self._burst is None or receiver.pending:
            if receiver.read_from(self._port, self._now_ns):
                self._last_byte_ns = self._now_ns()
                self._skip_headers()
        # nearly always all replies are there at once: no need to keep book of what came when
        elif count := self._port.read_into(self._room):
            self._hear(count, self._now_ns())

    def _hear(self, count: int, at_ns: int) -> None:
        """Take the first bytes of a burst."""
        burst, self._burst = self._burst, None
        if burst is None or not count:
            self._burst = burst
            return
        self._last_byte_ns = at_ns
        if count == burst.size and self._state == _AWAITING and burst.whole() and self._in_time(burst, at_ns):
            self._take_all(burst, at_ns, [])
            return
        self._receiver.expect(burst)
        self._receiver.accept(count, at_ns)
        self._skip_headers()

    def _skip_headers(self) -> None:
        # as many bytes as an awaited reply has, and it is not whole: its header is a false one
        receiver = self._receiver
        while self._state == _AWAITING and receiver.pending >= self._reply_size and not receiver.gathering:
            receiver.skip_header()

    def step(self, now_ns: int) -> int:
        """Do what is due; return when to come back at the latest, NEVER when there is nothing to do."""
        try:
            while self._job is not None:
                if self._state == _READY:
                    if now_ns < self._free_ns:
                        return self._free_ns
                    now_ns = self._begin(self._job)
                elif now_ns < self._deadline_ns:
                    return self._deadline_ns
                else:
                    self._end(now_ns)
        except PortError as error:
            self._fail(error)
        return NEVER

    def _end(self, now_ns: int) -> None:
        """Do what is due at a transaction's deadline."""
        # bytes may have come while this process was not running: look before giving up
        self.receive()
        if self._state == _AWAITING:
            self._give_up(now_ns)
        elif self._state == _DRAINING and self._quiet_at() > now_ns:
            self._deadline_ns = self._quiet_at()
        elif self._state in (_RESTING, _DRAINING):
            self._receiver.flush()
            self._state = _READY

    def _fail(self, error: PortError) -> None:
        self.failure = error
        self._job = None

    def _begin(self, job: Job) -> int:
        """Hand the reply to the job and start its next transaction; return the time after that."""
        reply = self._reply
        self._awaited = transaction = job.advance(None if self._awaited is None else reply)
        if transaction is None:
            self._job = None
            return 0
        if self._receiver.pending:
            self._receiver.flush()
        self._burst = job.burst
        packet = transaction.packet
        now_ns = self._write(packet, transaction.servo_id) if packet else self._now_ns()
        self._await(transaction, self._sent_ns if packet else now_ns)
        return now_ns

    def _await(self, transaction: Transaction, started_ns: int) -> None:
        """Await the replies to a transaction whose instruction is on its way."""
        reply, burst = self._reply, self._burst
        self._awaited = transaction
        self._receiver.expect(None)
        reply.parameters = b""
        reply.error = reply.strays = 0
        reply.echoed = False
        reply.sent_ns = self._sent_ns = started_ns
        if transaction.awaited:
            reply.outcome = _TIMEOUT
            self._state = _AWAITING
            self._earliest_ns = started_ns + (len(transaction.packet) + self._overhead) * self.byte_ns
            self._deadline_ns = started_ns + transaction.timeout_ns
            self._reply_size = transaction.widest
            self._open = (1 << len(transaction.awaited)) - 1
            self._refused = False
            if burst is not None:
                burst.bind(self.buffer)
        else:
            reply.outcome = _SENT
            self._state = _RESTING
            self._deadline_ns = started_ns + transaction.due_ns
        self.due_ns = started_ns + transaction.due_ns

    def _write(self, packet: bytes | bytearray | memoryview, servo_id: int) -> int:
        """Send a packet; return the time after that."""
        now_ns = self._now_ns
        before = now_ns()
        self._port.write(packet)
        after = now_ns()
        self._sink.packet(self.index, _INSTRUCTION, servo_id, before, after, packet)
        # a second packet waits in the adapter until the first is off the wire
        start = self._sent_ns = self._free_ns if self._free_ns > before else before
        self._free_ns = start + len(packet) * self.byte_ns
        return after

    def _give_up(self, now_ns: int) -> None:
        """End a transaction of which not every reply came in time."""
        self._receiver.flush()  # the reply may stand behind a false header
        if self._state != _AWAITING:
            return
        self._reply.outcome = Outcome.GARBLED if self._reply.strays else _TIMEOUT
        self._drain_end_ns = now_ns + DRAIN_LIMIT_NS
        self._deadline_ns = self._quiet_at()
        self._state = _DRAINING if self._deadline_ns > now_ns else _READY

    def _quiet_at(self) -> int:
        return min(self._last_byte_ns + self._quiet_ns, self._drain_end_ns)

    def _gathered(self, burst: Burst, ends: list[int], times: list[int]) -> bool:
        """Take all replies of a transaction that came in pieces; False: some came too soon to be of now."""
        spans = burst.spans(ends, times)
        if self._state != _AWAITING or not self._in_time(burst, spans[0][1]):
            return False
        self._take_all(burst, spans[-1][1], spans)
        return True

    def _in_time(self, burst: Burst, first_ns: int) -> bool:
        """Say whether the first reply is of now: one of before, or an echo, comes sooner than the wire."""
        return first_ns >= self._earliest_ns + (burst.first_size - self._overhead) * self.byte_ns

    def _take_all(self, burst: Burst, last_ns: int, spans: list[tuple[int, int]]) -> None:
        """Take all replies of a transaction; `spans`: of each status packet, when they came in pieces."""
        job = self._job
        if job is None:
            return
        packet, index = self._sink.packet, self.index
        for number, (servo_id, data) in enumerate(burst.packets):
            first, last = spans[number] if spans else (last_ns, last_ns)
            packet(index, _STATUS, servo_id, first, last, data)
        reply = self._reply
        reply.outcome, reply.last_ns = _OK, last_ns
        self._open = 0
        self._state = _READY
        moments = [last for _, last in spans]
        job.take(burst, moments if len(moments) == burst.count else last_ns)

    def _noise(self, data: memoryview, first_ns: int, last_ns: int) -> None:
        self._sink.packet(self.index, PacketKind.NOISE, BROADCAST_ID, first_ns, last_ns, data)
        # a status of a fast form that is cut off, or spoilt at a place: the parts before it are good
        unused = len(data) - (self._shared(data, last_ns) if self._shares(data) else 0)
        if unused:
            self.noise_bytes += unused
            self._reply.strays += 1

    def _shares(self, data: memoryview) -> bool:
        """Say whether a fast form is awaited, and this looks like its one status, whole or not."""
        awaited = self._awaited
        return (
            awaited is not None
            and awaited.fast
            and self._state == _AWAITING
            and bytes(data[: self._dialect.ID_AT + 1]) == self._dialect.HEADER + bytes((BROADCAST_ID,))
        )

    def _shared(self, data: memoryview, last_ns: int) -> int:
        """Take what is good of the one status of a fast form; return the number of its bytes."""
        awaited, job = self._awaited, self._job
        if awaited is None or job is None:
            return 0
        from dxlrun.dynamixel.burst import good_parts  # not above: see there

        parts, used = good_parts(self._dialect, awaited, data)
        if last_ns < self._sent_ns + (len(awaited.packet) + used) * self.byte_ns:
            return 0  # sooner than the wire allows: left over from before
        reply = self._reply
        for index, part in enumerate(parts):
            reply.error, reply.parameters, reply.last_ns = part.error, part.parameters, last_ns
            self._open &= ~(1 << index)
            job.status(index, reply)
        if not self._open:
            reply.outcome = _OK
            self._state = _READY
        return used

    def _status(self, packet: memoryview, first_ns: int, last_ns: int) -> None:
        self._sink.packet(self.index, _STATUS, packet[self._dialect.ID_AT], first_ns, last_ns, packet)
        if self._shares(packet):
            if not self._shared(packet, last_ns):
                self._stray(packet)
            return
        status = self._dialect.opened(packet) if self._state == _AWAITING else None
        index = -1 if status is None else self._turn(status, last_ns)
        if status is None or index < 0 or self._job is None:
            self._stray(packet)
            return
        reply = self._reply
        reply.error, reply.parameters, reply.last_ns = status.error, bytes(status.parameters), last_ns
        self._open &= ~(1 << index)
        if status.error and self._refuses(status, index):
            self._refused = True
        else:
            self._job.status(index, reply)
        if not self._open:
            reply.outcome = Outcome.REFUSED if self._refused else _OK
            self._state = _READY

    def _turn(self, status: Status, last_ns: int) -> int:
        """Return which of the awaited statuses this is; -1 when it is none of them."""
        servo_id, error, parameters = status
        length = len(parameters)
        # an echo, or left over from before, comes sooner than the wire allows
        if self._awaited is None or last_ns < self._earliest_ns + length * self.byte_ns:
            return -1
        for index, one in enumerate(self._awaited.awaited):
            if one.servo_id == servo_id and self._open >> index & 1:
                return index if length == one.length or (error and self._refuses(status, index)) else -1
        return -1

    def _refuses(self, status: Status, index: int) -> bool:
        assert self._awaited is not None  # noqa: S101  a status has its turn
        length = self._awaited.awaited[index].length
        return self._dialect.refused(status.error, len(status.parameters), length)

    def _stray(self, packet: memoryview) -> None:
        self._reply.strays += 1
        if self._awaited is not None and packet == self._awaited.packet:
            self._reply.echoed = True
