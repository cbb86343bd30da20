"""Bus: one resumable transaction machine per serial line; `pump` is the one wait that serves all of them.

A machine never waits: it writes an instruction, is fed the bytes that arrive, and is told the time. Whoever
pumps it decides when: read, write, or the gap before the next deadline.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dxlrun.clock import Clock
from dxlrun.dynamixel.exchange.listening import AWAITING, DRAINING, NEVER, READY, RESTING, Listener
from dxlrun.dynamixel.plan.bus_plan import BusPlan
from dxlrun.dynamixel.port.ports import Port
from dxlrun.dynamixel.wire.transaction import (
    BROADCAST_ID,
    Job,
    Outcome,
    Transaction,
)
from dxlrun.errors import PortError
from dxlrun.run.channels.packets import PacketKind, PacketSink

if TYPE_CHECKING:  # the guardian makes servos limp without numpy
    from dxlrun.dynamixel.exchange.kernel import Interrupted

QUIET_BYTES = 20
"""A line that was silent for so many byte times is silent (protocol.md: drain until it is)."""
LEAST_QUIET_NS = 200_000
DRAIN_LIMIT_NS = 5_000_000
"""A line that babbles longer than this is not waited for."""

_INSTRUCTION = PacketKind.INSTRUCTION
_OK = Outcome.OK

__all__ = ["NEVER", "Bus"]


class Bus(Listener):
    """Executes transactions on one line; every byte that goes over it is reported to the packet sink.

    A reply counts only when ID and length are exact and when it comes no sooner than the wire allows. Of
    several replies to one instruction each counts by itself, whatever became of the others. After a timeout
    the line is drained until it is silent, and what comes then is stray.
    """

    __slots__ = (
        "_drain_end_ns",
        "_now_ns",
        "_port",
        "_quiet_ns",
        "failure",
        "free_ns",
        "name",
    )

    def __init__(self, index: int, plan: BusPlan, port: Port, clock: Clock, packets: PacketSink) -> None:
        super().__init__(index, plan, packets)
        self.name = plan.name
        self.failure: PortError | None = None
        """Why the line is gone; a bus with a failure does nothing more."""
        self._port = port
        self._now_ns = clock.now_ns
        self._quiet_ns = max(QUIET_BYTES * self.byte_ns, LEAST_QUIET_NS) + plan.latency_ns
        self.free_ns = 0
        """When everything that was sent is off the wire."""
        self._drain_end_ns = 0

    @property
    def busy(self) -> bool:
        """True while a job is under way."""
        return self._job is not None

    def renew(self, port: Port) -> None:
        """Go on with a line that is back in the place of one that is gone; its job is forgotten."""
        self._port = port
        self.failure = None
        self.drop()
        self._receiver.flush()  # the half of a packet that the lost line brought is nobody's

    def load(self, job: Job) -> None:
        """Take a job; the next `step` begins it. What an aborted job left behind is forgotten."""
        self._owe()
        self._awaited = None
        self._state = READY
        if self.failure is None:
            self._job = job
            self._reply.strays = 0

    def drop(self) -> None:
        """Forget the loaded job; what still comes for it belongs to nobody."""
        self._owe()
        self._job = self._awaited = None
        self._state = READY

    @property
    def pending(self) -> bool:
        """True while the beginning of a packet has arrived, which a new request takes for noise."""
        return self._receiver.pending > 0

    def send(self, packet: bytes | bytearray | memoryview) -> None:
        """Send a prepared packet that nobody answers, between two jobs; does not wait.

        The next transaction starts when the packet is off the wire. Raises PortError when the line is gone.
        """
        if self.failure is None:
            try:
                self._write(packet, BROADCAST_ID)
            except PortError as error:
                self.fail(error)
        if self.failure is not None:
            raise self.failure

    def hear(self) -> int:
        """Take what the line has, and go on; return when to come back at the latest, as `step` does.

        Called when the line has bytes.
        """
        self._receive()
        return self.step(self._now_ns())

    def take_over(self, job: Job, transaction: Transaction, line: Interrupted) -> None:
        """Go on with a job whose transaction the kernel has sent."""
        self.load(job)
        if self._job is None:
            return
        if self.pending:
            self._receiver.flush()
        self._last_byte_ns = max(self._last_byte_ns, line.heard_ns)
        self._await(transaction, line.sent_ns)
        self._deadline_ns = line.deadline_ns
        self.take_pieces(line)

    def take_pieces(self, line: Interrupted) -> None:
        """Take what the kernel received beyond the replies that it has kept."""
        for data, at_ns in line.pieces:
            self._last_byte_ns = at_ns
            self._receiver.feed(data, at_ns)
            self._skip_headers()

    def _receive(self) -> None:
        if self.failure is None:
            try:
                if self._receiver.read_from(self._port, self._now_ns):
                    self._last_byte_ns = self._now_ns()
                    self._skip_headers()
            except PortError as error:
                self.fail(error)

    def step(self, now_ns: int) -> int:
        """Do what is due; return when to come back at the latest, NEVER when there is nothing to do."""
        try:
            while self._job is not None:
                if self._state == READY:
                    now_ns = self._begin(self._job)
                elif now_ns < self._deadline_ns:
                    return self._deadline_ns
                else:
                    self._end(now_ns)
        except PortError as error:
            self.fail(error)
        return NEVER

    def _end(self, now_ns: int) -> None:
        """Do what is due at a transaction's deadline."""
        # bytes may have come while this process was not running: look before giving up
        self._receive()
        if self._state == AWAITING:
            self._give_up(now_ns)
        elif self._state == DRAINING and self._quiet_at() > now_ns:
            self._deadline_ns = self._quiet_at()
        elif self._state in (RESTING, DRAINING):
            self._receiver.flush()
            self._state = READY

    def fail(self, error: PortError) -> None:
        """Take the line for gone; its job is forgotten."""
        self.failure = error
        self._job = None

    def _begin(self, job: Job) -> int:
        """Hand the reply to the job and start its next transaction; return the time after that."""
        reply = self._reply
        self._before = self._awaited
        self._awaited = transaction = job.advance(None if self._awaited is None else reply)
        if transaction is None:
            self._job = None
            return 0
        if self.pending:
            self._receiver.flush()
        packet = transaction.packet
        now_ns = self._write(packet, transaction.servo_id) if packet else self._now_ns()
        self._await(transaction, self._sent_ns if packet else now_ns)
        # this process may have stood still before the bytes left
        self._deadline_ns = max(self._deadline_ns, now_ns + transaction.timeout_ns)
        return now_ns

    def _write(self, packet: bytes | bytearray | memoryview, servo_id: int) -> int:
        """Send a packet; return the time after that."""
        now_ns = self._now_ns
        before = now_ns()
        self._port.write(packet)
        after = now_ns()
        self._sink.packet(self.index, _INSTRUCTION, servo_id, before, after, packet)
        # a second packet waits in the adapter until the first is off the wire
        start = self._sent_ns = self.free_ns if self.free_ns > before else before
        self.free_ns = start + len(packet) * self.byte_ns
        return after

    def _give_up(self, now_ns: int) -> None:
        """End a transaction of which not every reply came in time."""
        self._receiver.flush()  # the reply may stand behind a false header
        if self._state != AWAITING:
            return
        self._owe()
        self._reply.outcome = Outcome.GARBLED if self._reply.strays else Outcome.TIMEOUT
        self._drain_end_ns = now_ns + DRAIN_LIMIT_NS
        self._deadline_ns = self._quiet_at()
        self._state = DRAINING if self._deadline_ns > now_ns else READY

    def _quiet_at(self) -> int:
        return min(self._last_byte_ns + self._quiet_ns, self._drain_end_ns)
