"""Bus: exchanges packets on one serial line without blocking. Lines: all serial lines of a robot, with one
wait.

A bus writes an instruction and receives incoming bytes and the time from its caller. `Lines` executes the
jobs of all buses concurrently: cyclic reads, idle work, set-up and tools."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable, Sequence
from typing import TypeAlias

from dxlwire.bus_plan import BusPlan
from dxlwire.clock import Clock
from dxlwire.exceptions import PortError
from dxlwire.exchange.owed import OwedReplies
from dxlwire.packets import PacketKind, PacketSink
from dxlwire.plan.line import BITS_PER_BYTE, lengthen
from dxlwire.port.ports import Port, Ports
from dxlwire.transaction import (
    BROADCAST_ID,
    NO_REGISTER,
    Job,
    Program,
    ProgramJob,
    Reply,
    Result,
    Status,
    Transaction,
    TransactionOutcome,
)
from dxlwire.wire.dialect import Dialect, dialect_of
from dxlwire.wire.receiver import Receiver

NEVER = 1 << 62
QUIET_BYTES = 20
"""Silence, in byte times, after which a line counts as quiet (docs/reference/protocol.md: drain until it
is)."""
LEAST_QUIET_NS = 200_000  # Minimum of that time, reached at 1 Mbit/s and above
DRAIN_LIMIT_NS = 5_000_000  # A line that keeps sending noise for longer than this is not drained any further
PATIENT_DRAIN_LIMIT_NS = 200_000_000  # The same limit for a job that has no deadline
LOST_LINE_STEP_NS = 200_000  # Interval at which the other lines are checked while one is lost
BEAT_NS = 5_000_000
"""Longest interval between two calls of `beat`, not counting one wait, and longest wait of the kernel, ns. A
wait that ends before the next tick of a stock Linux (4 ms) sets the timer of the processor and resets it,
which takes some 10 us in a virtual machine."""
MOST_LATE_NS = 1_000_000
"""Cap for the measured lateness of replies, ns. A later reply is an accident, such as a stall of this
process, and not a property of the line."""
_FORGOTTEN = 6  # Each reply that is less late lowers a line's lateness by 2 ** -6

FREE_NS, LATE_NS, LOST, ASKED_NS, SILENCE_NS = range(5)
"""Indices of `Bus.words`, the memory shared with the exchange kernel.

- `FREE_NS`: time at which everything sent is off the wire.
- `LATE_NS`: recent worst lateness of replies, not counting the adapter's latency.
- `LOST`: 1 while the line is lost.
- `ASKED_NS`: time of the last request to the servos; 0 while their watchdogs are not armed.
- `SILENCE_NS`: timeout of the servos' watchdogs; 0 without watchdogs.
"""

_READY, _AWAITING, _RESTING, _DRAINING, _HOLDING = range(5)
# An attribute lookup on an Enum takes as long as packing a packet's record.
_SENT, _OK, _TIMEOUT = TransactionOutcome.SENT, TransactionOutcome.OK, TransactionOutcome.TIMEOUT
_INSTRUCTION, _STATUS = PacketKind.INSTRUCTION, PacketKind.STATUS

_Shape: TypeAlias = tuple[int, int]  # ID and number of parameter bytes of a status packet
_FAST: _Shape = (BROADCAST_ID, 0)  # Shape of the single status packet of a fast form, whatever its length


class BusEngine:
    """Executes transactions on one serial line and matches replies to them. Reports every byte on the line to
    the packet sink.

    A reply counts only when ID and length match exactly and it comes no sooner than the wire allows. Each
    of several replies to one instruction counts on its own, even when another one is lost. After a timeout
    the line is drained until it is silent. A reply that may answer an older request does not count, see
    `OwedReplies`."""

    def __init__(self, index: int, plan: BusPlan, port: Port, clock: Clock, packets: PacketSink) -> None:
        self.index = index  # Its number in the log
        self.plan = plan  # With its servos as `place_servo` placed them
        self.now_ns = clock.now_ns
        self.failure: PortError | None = None
        """Reason why the line is lost; None while it works. A bus with a failure sends and reads nothing."""
        self.noise_bytes = 0  # Bytes that belonged to no intact packet, since the start
        self.unrequested = 0
        """Packets since the start that no request of this host explains: instructions of another host, and
        the replies to them."""
        self.words = array("q", (0, 0, 0, 0, 0))  # Memory that the exchange kernel shares, see `FREE_NS`
        self.byte_ns = BITS_PER_BYTE * 1_000_000_000 // plan.baud_rate
        """Time that one byte takes on the wire, ns."""
        self._latency_ns = plan.latency_ns
        # The adapter may hold bytes back for its latency, so the line is silent only after that time.
        self._quiet_ns = max(QUIET_BYTES * self.byte_ns, LEAST_QUIET_NS) + plan.latency_ns
        self._port = port
        self._sink = packets
        self._dialect: Dialect = dialect_of(plan.protocol)
        self.receiver = Receiver(self._take_packet, self._take_noise, self._dialect)
        """Splits the received bytes into packets. Its `pending` bytes are the beginning of a packet; a new
        request discards them as noise."""
        cyclic = {
            (one.servo_id, one.length + more)  # Lengths that distinguish late replies
            for one in plan.members
            for more in range(1 + one.spare)
        }
        self._cyclic = frozenset(cyclic | {_FAST}) if any(plan.fast) else frozenset(cyclic)
        self.owed = OwedReplies(clock.now_ns)
        """Replies that did not arrive before their timeout and may still arrive."""
        self._written: bytes | bytearray | memoryview = b""  # The packet that was sent last
        self._job: Job | None = None
        self._cyclic_job = self._waits = False
        self._held: Transaction | None = None  # Waits until no owed reply can be taken for its own
        self._held_until_ns = 0
        self._asked_length = 0  # Parameter bytes that the job asked for; a read may return spare bytes
        self._before: Transaction | None = None  # The transaction before the awaited one
        self._awaited: Transaction | None = None
        self._reply = Reply(_SENT, 0, b"", 0, 0, False)
        self._state = _READY
        self._sent_ns = self._earliest_ns = self._deadline_ns = self._drain_end_ns = 0
        # Planned deadline of a reply whose deadline was extended; 0 without an extension
        self._planned_deadline_ns = 0
        self._last_byte_ns = -NEVER
        self._answered_ns = -NEVER  # Time at which the replies to an abandoned request are off the line
        self._open = 0  # One bit for each status that is still awaited
        self._refused = False

    # The line

    @property
    def busy(self) -> bool:
        """True while a job is loaded and not finished."""
        return self._job is not None

    @property
    def late_ns(self) -> int:
        """Recent worst lateness of replies on this line, ns, not counting the adapter's latency."""
        return self.words[LATE_NS]

    def load_job(self, job: Job, *, cyclic: bool = False, waits: bool = False) -> None:
        """Load a job; the next `process_due` starts it. An unfinished job is dropped.

        Args:
            job: The transactions to execute.
            cyclic: The job reads the states of a cycle, and chooses the lengths of its reads itself.
            waits: The job has no deadline. A transaction is held back while a late reply could be taken
                for its own.
        """
        self.drop_job()
        self._cyclic_job, self._waits = cyclic, waits
        if self.failure is None:
            self._job = job
            self._reply.strays = 0

    def drop_job(self) -> None:
        """Remove the loaded job. Replies that still arrive for it count as stray."""
        self._note_owed()
        if self._state == _AWAITING and self._awaited is not None:
            self._answered_ns = self._sent_ns + self._awaited.due_ns + self._quiet_ns
        self._job = self._awaited = self._held = None
        self._state = _READY

    def mark_lost(self, error: PortError) -> None:
        """Mark the line as lost because of `error`, and drop its job."""
        self.failure = error
        self.words[LOST] = 1
        self._job = None

    def retry(self) -> None:
        """Clear the failure, so that the line is used again."""
        self.failure = None
        self.words[LOST] = 0

    def replace_port(self, port: Port) -> None:
        """Continue on a reopened port in place of the lost one: clear the failure and drop the job."""
        self._port = port
        self.retry()
        self.drop_job()

    def send(self, packet: bytes | bytearray | memoryview) -> None:
        """Send a packet that no servo answers, between two jobs, without blocking.

        The next transaction starts when the packet is off the wire.

        Raises:
            PortError: The line is lost.
        """
        if self.failure is None:
            try:
                self._write_packet(packet, BROADCAST_ID)
            except PortError as error:
                self.mark_lost(error)
        if self.failure is not None:
            raise self.failure

    def await_replies(self, received_ns: int, sent_ns: int, deadline_ns: int) -> None:
        """Take over from the exchange kernel: await the replies to the loaded job's next transaction,
        which the kernel has sent.

        Args:
            received_ns: Arrival time of the replies to the transaction before.
            sent_ns: Time at which the instruction left.
            deadline_ns: Time at which the transaction times out.
        """
        if self._job is None or (transaction := self._job.next_transaction(None)) is None:
            return
        if self.receiver.pending:
            self.receiver.flush()
        self._awaited = transaction
        self._asked_length = max(one.length for one in transaction.awaited)
        self._last_byte_ns = max(self._last_byte_ns, received_ns)
        self._await(transaction, sent_ns)
        self._deadline_ns = deadline_ns

    def parse_bytes(self, data: bytes, at_ns: int) -> None:
        """Parse bytes that the exchange kernel received and could not use; `at_ns` is their arrival time."""
        self._last_byte_ns = at_ns
        self.receiver.feed_bytes(data, at_ns)
        self._skip_headers()

    # Time

    def read_and_process(self) -> int:
        """Read the bytes that have arrived, match them to the current transaction, and continue like
        `process_due`.

        Called when the line is readable."""
        self._receive()
        return self.process_due(self.now_ns())

    def process_due(self, now_ns: int) -> int:
        """Do what is due now: start the next transaction or handle a deadline. Return the latest time of
        the next call, NEVER without a job."""
        try:
            while self._job is not None:
                if self._state == _READY:
                    now_ns = self._begin_transaction(self._job)
                elif now_ns < self._deadline_ns:
                    return self._deadline_ns
                else:
                    self._handle_deadline(now_ns)
        except PortError as error:
            self.mark_lost(error)
        return NEVER

    def _receive(self) -> None:
        if self.failure is None:
            try:
                if self.receiver.read_from(self._port, self.now_ns):
                    self._last_byte_ns = self.now_ns()
                    self._skip_headers()
            except PortError as error:
                self.mark_lost(error)

    def _begin_transaction(self, job: Job) -> int:
        """Pass the last reply to the job and start its next transaction; return the time after that, ns."""
        reply, done = self._reply, self._awaited
        if done is not None and reply.outcome is _OK:
            self._note_lateness(reply.last_ns - self._sent_ns - done.due_ns - self._latency_ns)
            if not self._cyclic_job:
                reply.stalled_ns = self._port.late_ns(self.words[FREE_NS], reply.last_ns)
        self._before = done
        self._awaited = None
        transaction = job.next_transaction(None if done is None else reply)
        if transaction is None:
            self._job = None
            return 0
        reply.strays = 0
        self._asked_length = max((one.length for one in transaction.awaited), default=0)
        if transaction.packet and not self._cyclic_job:
            self._receive()  # Bytes that arrived before the request are not part of its reply
            self._drain_end_ns = self.now_ns() + PATIENT_DRAIN_LIMIT_NS
            if self.failure is not None or (self._waits and self._hold_back(transaction)):
                return self.now_ns()
            transaction, _ = self.choose(transaction)
        return self._send_awaited(transaction)

    def choose(self, transaction: Transaction) -> tuple[Transaction, int]:
        """Return the transaction with the reply length that no owed reply has, or is soonest free of them,
        and its earliest send time; 0: now."""
        best, best_ns = transaction, self.owed.free_ns(transaction)
        for more in range(1, transaction.spare + 1):
            if not best_ns:
                break
            longer = lengthen(transaction, more, self._dialect, self.byte_ns)
            free_ns = self.owed.free_ns(longer)
            if free_ns < best_ns:
                best, best_ns = longer, free_ns
        return best, best_ns

    def _hold_back(self, transaction: Transaction) -> bool:
        """Hold a transaction back until the line is quiet and no owed reply can be taken for its own.

        Returns:
            False when the transaction can be sent now.
        """
        if not transaction.awaited:
            return False
        now_ns = self.now_ns()
        _, free_ns = self.choose(transaction)
        # A duplicate follows its original at once, so the latency of the adapter does not count.
        # A job dropped in the middle of a reply, as on Ctrl-C: the next write would collide with its rest.
        quiet_ns = min(max(self._quiet_at() - self._latency_ns, self._answered_ns), self._drain_end_ns)
        until_ns = min(max(free_ns, quiet_ns), now_ns + transaction.patience_ns)
        if until_ns <= now_ns:
            return False
        self._held = transaction
        self._held_until_ns = now_ns + transaction.patience_ns
        self._state, self._deadline_ns = _HOLDING, until_ns
        return True

    def _release_held(self, now_ns: int) -> None:
        """Send the transaction that was held back. Hold it back again if new bytes have arrived since."""
        transaction, self._held = self._held, None
        if transaction is not None and now_ns < self._held_until_ns:
            patient = self._held_until_ns
            if self._hold_back(transaction):
                self._held_until_ns = min(self._held_until_ns, patient)
                return
        if transaction is not None:
            self._state = _READY
            self._send_awaited(self.choose(transaction)[0])

    def _send_awaited(self, transaction: Transaction) -> int:
        """Send a transaction and await its replies; return the time after the send, ns."""
        self._awaited = transaction
        if self.receiver.pending:
            self.receiver.flush()
        packet = transaction.packet
        now_ns = self._write_packet(packet, transaction.servo_id) if packet else self.now_ns()
        self._await(transaction, self._sent_ns if packet else now_ns)
        # This process may have been suspended before the bytes left.
        self._deadline_ns = max(self._deadline_ns, now_ns + transaction.timeout_ns)
        if packet and not self._cyclic_job and all(one.address == NO_REGISTER for one in transaction.awaited):
            self.owed.note_change(transaction, self._sent_ns)
        return now_ns

    def _write_packet(self, packet: bytes | bytearray | memoryview, servo_id: int) -> int:
        """Write a packet to the port, log it, and note when it is off the wire; return the time after the
        write, ns."""
        now_ns, words = self.now_ns, self.words
        before = now_ns()
        self._port.write_packet(packet)
        after = now_ns()
        self._written = packet
        self._sink.packet(self.index, _INSTRUCTION, servo_id, before, after, packet)
        # A second packet waits in the adapter until the first is off the wire.
        free = words[FREE_NS]
        # A conditional takes a third of the time of max()
        start = self._sent_ns = free if free > before else before
        words[FREE_NS] = start + len(packet) * self.byte_ns
        return after

    def _await(self, transaction: Transaction, started_ns: int) -> None:
        """Start to await the replies to a transaction whose instruction was sent at `started_ns`."""
        reply = self._reply
        reply.parameters = b""
        reply.error = 0
        reply.echoed = False
        self._sent_ns = started_ns
        reply.sent_ns = started_ns
        # A late reply to an older repetition is accepted, so the data may be as old as that repetition.
        reply.asked_ns = started_ns if self._cyclic_job else self.owed.asked_ns(transaction, started_ns)
        if transaction.awaited:
            reply.outcome = _TIMEOUT
            self._state = _AWAITING
            # Even a reply without parameters cannot end before instruction and overhead have passed the wire.
            self._earliest_ns = started_ns + (len(transaction.packet) + self._dialect.OVERHEAD) * self.byte_ns
            self._deadline_ns = started_ns + transaction.timeout_ns
            self._open = (1 << len(transaction.awaited)) - 1
            self._refused = False
            self._planned_deadline_ns = 0
        else:
            reply.outcome = _SENT
            self._state = _RESTING
            self._deadline_ns = started_ns + transaction.due_ns

    def _handle_deadline(self, now_ns: int) -> None:
        """Handle the deadline of the current transaction: a timeout, the end of a drain, or the end of a
        pause."""
        # Bytes may have arrived while this process was suspended: read them before the timeout counts.
        self._receive()
        if self._state == _AWAITING:
            if not self._extend_deadline(now_ns):
                self._give_up(now_ns)
        elif self._state == _DRAINING and self._quiet_at() > now_ns:
            self._deadline_ns = self._quiet_at()
        elif self._state in (_RESTING, _DRAINING):
            self.receiver.flush()
            self._state = _READY
        elif self._state == _HOLDING:
            self.receiver.flush()
            self._release_held(now_ns)

    def _extend_deadline(self, now_ns: int) -> bool:
        """Ask the port for a later deadline, which it grants if the other side was stalled; return True if
        the deadline was extended."""
        self._planned_deadline_ns = self._planned_deadline_ns or self._deadline_ns
        self._deadline_ns = self._port.extend_deadline(
            self._planned_deadline_ns, self.words[FREE_NS], self._last_byte_ns, now_ns
        )
        return self._deadline_ns > now_ns

    def stalled_ns(self, since_ns: int, until_ns: int) -> int:
        """Return how long the simulated servos at the other end of the line had no processor between two
        times, ns."""
        return self._port.stalled_ns(since_ns, until_ns)

    def _give_up(self, now_ns: int) -> None:
        """End a transaction that timed out with replies missing, and drain the line."""
        self.receiver.flush()  # A false header may hide the reply
        if self._state != _AWAITING:
            return
        self._note_owed()
        self._reply.outcome = TransactionOutcome.GARBLED if self._reply.strays else _TIMEOUT
        # A line with endless noise must not block the next transaction.
        self._drain_end_ns = now_ns + DRAIN_LIMIT_NS
        self._deadline_ns = self._quiet_at()
        self._state = _DRAINING if self._deadline_ns > now_ns else _READY

    def _quiet_at(self) -> int:
        return min(self._last_byte_ns + self._quiet_ns, self._drain_end_ns)

    def _note_lateness(self, late_ns: int) -> None:
        """Update the line's worst lateness by that of one reply. Idle time starts no transaction that
        could end that late. Same rule in kernel.c."""
        kept_ns = self.words[LATE_NS]
        kept_ns -= (kept_ns >> _FORGOTTEN) + 1
        self.words[LATE_NS] = max(min(late_ns, MOST_LATE_NS), kept_ns, 0)

    # Incoming packets: match each one to the pending request, count the rest as stray

    def _skip_headers(self) -> None:
        # Enough bytes for an awaited reply without a complete packet: its header is a false one.
        receiver, awaited = self.receiver, self._awaited
        while awaited is not None and self._state == _AWAITING and receiver.pending >= awaited.widest:
            receiver.skip_header()
        if awaited is not None and awaited.tail and awaited.fast and self._state == _AWAITING:
            firm = awaited.awaited[: -awaited.tail]
            if firm and receiver.pending >= self._dialect.fast_size(sum(a.length for a in firm), len(firm)):
                self._await_devices(awaited, self._last_byte_ns)

    def _take_noise(self, data: memoryview, first_ns: int, last_ns: int) -> None:
        # A fast form's status that is truncated or corrupted: the entries before the damage are valid
        # replies.
        used = self._take_fast(data, last_ns) if self._is_fast(data) else 0
        if used:
            self._sink.packet(self.index, _STATUS, BROADCAST_ID, first_ns, last_ns, data[:used])
        if rest := data[used:]:
            self._sink.packet(self.index, PacketKind.NOISE, BROADCAST_ID, first_ns, last_ns, rest)
            self.noise_bytes += len(rest)
            self._reply.strays += 1

    def _take_packet(self, packet: memoryview, first_ns: int, last_ns: int) -> None:
        kind = _STATUS if self._take_reply(packet, last_ns) else self._stray(packet)
        self._sink.packet(self.index, kind, packet[self._dialect.ID_AT], first_ns, last_ns, packet)

    def _take_reply(self, packet: memoryview, last_ns: int) -> bool:
        if self._is_fast(packet):
            return self._take_fast(packet, last_ns) > 0
        status = self._dialect.opened(packet) if self._state == _AWAITING else None
        if status is None or self._job is None or (place := self._place(status, last_ns)) is None:
            return False
        index, refused = place
        reply = self._reply
        parameters = bytes(status.parameters[: self._asked_length])
        reply.error, reply.parameters, reply.last_ns = status.error, parameters, last_ns
        self._open &= ~(1 << index)
        if refused:
            self._refused = True
        else:
            self._job.status(index, reply)
        if not self._open:
            reply.outcome = TransactionOutcome.REFUSED if self._refused else _OK
            self._state = _READY
        elif (awaited := self._awaited) is not None and awaited.tail:
            firm = (1 << len(awaited.awaited) - awaited.tail) - 1
            if not self._open & firm:
                self._await_devices(awaited, last_ns)
        return True

    def _await_devices(self, awaited: Transaction, last_ns: int) -> None:
        """Shorten the deadline for devices, because all servos in the same read have answered by
        `last_ns`. Same rule in kernel.c."""
        self._planned_deadline_ns = 0
        brief_ns = max(self._sent_ns + awaited.tail_timeout_ns, last_ns + awaited.tail_margin_ns)
        self._deadline_ns = min(self._deadline_ns, brief_ns)

    def _place(self, status: Status, last_ns: int) -> tuple[int, bool] | None:
        """Match a status packet to the open replies; return (index, True for a refusal), or None if no
        open reply fits."""
        servo_id, error, parameters = status
        length = len(parameters)
        # An echo or a leftover of the request before comes sooner than the wire allows.
        if self._awaited is None or last_ns < self._earliest_ns + length * self.byte_ns:
            return None
        for index, one in enumerate(self._awaited.awaited):
            if one.servo_id == servo_id and self._open >> index & 1:
                refused = error != 0 and self._dialect.refused(error, length, one.length)
                if not refused and length != one.length:
                    return None
                any_age = self._cyclic_job or self._awaited.any_age
                if self.owed.confuses(self._awaited, one, refusal=refused, any_age=any_age):
                    return None
                if not self._cyclic_job:  # The kernel, which reads most cycles, does not note it either
                    self.owed.note_answer(self._awaited, one, self._sent_ns)
                return index, refused
        return None

    def _is_fast(self, data: memoryview) -> bool:
        """Return True if a fast sync or bulk read is awaited and the data begins like its single status
        packet."""
        awaited = self._awaited
        return (
            awaited is not None
            and awaited.fast
            and self._state == _AWAITING
            and bytes(data[: self._dialect.ID_AT + 1]) == self._dialect.HEADER + bytes((BROADCAST_ID,))
        )

    def _take_fast(self, data: memoryview, last_ns: int) -> int:
        """Pass the intact entries of a fast read's single status packet to the job; return the number of
        bytes used."""
        awaited, job = self._awaited, self._job
        if awaited is None or job is None:
            return 0
        parts, used = _good_parts(self._dialect, awaited, data)
        if last_ns < self._sent_ns + (len(awaited.packet) + used) * self.byte_ns:
            return 0  # Sooner than the wire allows: a leftover of the request before
        reply = self._reply
        for index, part in enumerate(parts):
            reply.error, reply.parameters, reply.last_ns = part.error, part.parameters, last_ns
            self._open &= ~(1 << index)
            job.status(index, reply)
        if not self._open:
            reply.outcome = _OK
            self._state = _READY
        return used

    def _note_owed(self) -> None:
        """Register the missing replies of an abandoned transaction as owed, because they may still arrive."""
        awaited = self._awaited
        if awaited is None:
            return
        self._before = awaited
        if self._state != _AWAITING:
            return
        if not awaited.fast:
            for index in range(len(awaited.awaited)):
                if self._open >> index & 1:
                    self.owed.add(awaited, index, self._sent_ns)
        # A fast form is a single packet, which is owed only if none of its entries has arrived.
        elif self._open == (1 << len(awaited.awaited)) - 1:
            self.owed.add(awaited, 0, self._sent_ns)

    def _stray(self, packet: memoryview) -> PacketKind:
        """Return the kind of an intact packet that is not awaited (echo, late reply, other host, status), and
        count it.

        Replies are distinguished by ID and length. Replies to another host that reads the same items are
        therefore taken for duplicates."""
        reply, awaited = self._reply, self._awaited
        if packet == self._written or (awaited is not None and packet == awaited.packet):
            reply.echoed = True
            return PacketKind.ECHO
        status, shape = self._dialect.opened(packet), _FAST
        if status is not None:
            fast = status.servo_id == BROADCAST_ID
            shape = _FAST if fast else (status.servo_id, len(status.parameters))
            length = len(packet) if fast else shape[1]
            if self.owed.charge_reply(status.servo_id, length, status.error):
                if self._state == _HOLDING:  # The held transaction may have waited for this reply
                    self._deadline_ns = self.now_ns()
                    self._drain_end_ns = self._deadline_ns + PATIENT_DRAIN_LIMIT_NS
                return PacketKind.LATE
        if status is None or self._dialect.instructs(packet):
            self.unrequested += 1
            return PacketKind.OTHER_HOST
        explained = shape in self._cyclic or shape in _shapes(awaited) or shape in _shapes(self._before)
        self.unrequested += not explained
        reply.strays += 1
        return _STATUS


def _shapes(transaction: Transaction | None) -> list[_Shape]:
    return [] if transaction is None else [(one.servo_id, one.length) for one in transaction.awaited]


def _good_parts(dialect: Dialect, transaction: Transaction, data: memoryview) -> tuple[list[Status], int]:
    """Return the intact entries at the start of a truncated or corrupted status of a fast read, and their
    size in bytes."""
    if dialect.size_at(data, 0, len(data)) != transaction.widest:
        return [], 0
    awaited = transaction.awaited
    try:
        parts = dialect.fast_answers(data, [one.length for one in awaited])
    except ValueError:  # Corrupted before its first entry
        return [], 0
    count = 0
    while count < len(parts) and parts[count].servo_id == awaited[count].servo_id:
        count += 1
    used = dialect.fast_size(sum(one.length for one in awaited[:count]), count) if count else 0
    return parts[:count], used


class Lines:
    """The serial lines of a robot: the jobs of all are executed concurrently, with one wait for all lines."""

    def __init__(
        self,
        plans: Sequence[BusPlan],
        ports: Ports,
        clock: Clock,
        packets: PacketSink | Sequence[PacketSink],
        beat: Callable[[], None] = lambda: None,
    ) -> None:
        """Create a `BusEngine` for each line on ports that are open already.

        Args:
            plans: One plan for each line.
            ports: The open ports, in the order of `plans`.
            clock: Clock of the run.
            packets: One sink for all lines, or one for each.
            beat: Called at least every BEAT_NS, not counting one wait.
        """
        self.ports = ports
        self.clock = clock
        self.beat = beat
        sinks = packets if isinstance(packets, Sequence) else [packets] * len(plans)
        self.buses = tuple(
            BusEngine(index, plan, port, clock, sink)
            for index, (plan, port, sink) in enumerate(zip(plans, ports.ports, sinks, strict=True))
        )

    @property
    def plans(self) -> tuple[BusPlan, ...]:
        """Plans of the lines, with their servos as they are placed now."""
        return tuple(bus.plan for bus in self.buses)

    @property
    def failure(self) -> PortError | None:
        """Failure of the first lost line; None while all lines work."""
        return next((bus.failure for bus in self.buses if bus.failure is not None), None)

    def discard_input(self, buses: Iterable[BusEngine]) -> None:
        """Read and discard what has arrived on these lines, before a request is sent on them.

        A packet that arrived before a request must not be taken for its reply. Replies come in the order
        of requests, so one extra reply would shift all later ones."""
        here = {bus.index: bus for bus in buses if bus.failure is None}
        for index in self.ports.wait_for_bytes(0):
            if index in here:
                here[index].read_and_process()

    def pump(self) -> None:
        """Execute the loaded jobs of all lines with one wait over all ports; return when every job is
        finished.

        Everything that can be sent is sent before a reply is awaited. Nothing is raised: a lost line gets
        a `failure`, and the other lines continue."""
        buses, clock_ns, wait = self.buses, self.clock.now_ns, self.ports.wait_for_bytes
        now_ns, beat_ns = clock_ns(), 0
        deadlines = [bus.process_due(now_ns) for bus in buses]
        while (deadline := min(deadlines, default=NEVER)) != NEVER:
            if now_ns >= beat_ns:
                self.beat()
                beat_ns = now_ns + BEAT_NS
            ready = wait(deadline)
            heard = not ready
            for index in ready:
                bus = buses[index]
                if bus.failure is None:
                    heard = True
                    deadlines[index] = bus.read_and_process()
            if not heard:
                # A lost line is always readable: check the other lines at an interval instead of waiting.
                self.clock.wait_until(min(deadline, clock_ns() + LOST_LINE_STEP_NS))
                for bus in buses:
                    bus.read_and_process()
            now_ns = clock_ns()
            if now_ns >= deadline or not heard:
                deadlines = [bus.process_due(now_ns) for bus in buses]

    def run_programs(self, programs: Sequence[Program[Result]]) -> list[Result | None]:
        """Run one program per line to completion, concurrently. Blocks; for set-up and tools, never in the
        loop.

        Returns:
            The result of each program; None where the line is lost, see `Bus.failure`.
        """
        jobs = [ProgramJob(program) for program in programs]
        for bus, job in zip(self.buses, jobs, strict=True):
            bus.load_job(job, waits=True)
        self.discard_input(self.buses)
        self.pump()
        return [job.result for job in jobs]
