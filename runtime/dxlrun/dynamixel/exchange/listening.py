"""Listener: what arrives on one line, judged: which of it is awaited, and what belongs to nobody."""

from __future__ import annotations

from typing import TypeAlias

from dxlrun.dynamixel.plan.bus_plan import BusPlan
from dxlrun.dynamixel.plan.line import BITS_PER_BYTE
from dxlrun.dynamixel.wire.dialect import Dialect, dialect_of
from dxlrun.dynamixel.wire.receiver import Receiver
from dxlrun.dynamixel.wire.transaction import BROADCAST_ID, Job, Outcome, Reply, Status, Transaction
from dxlrun.run.channels.packets import PacketKind, PacketSink

NEVER = 1 << 62

READY, AWAITING, RESTING, DRAINING = range(4)
# to look into an Enum takes as long as to pack a packet's record
_SENT, _OK, _TIMEOUT = Outcome.SENT, Outcome.OK, Outcome.TIMEOUT
_STATUS = PacketKind.STATUS

_Shape: TypeAlias = tuple[int, int]
"""ID and number of parameter bytes of a status packet."""
_FAST: _Shape = (BROADCAST_ID, 0)
"""Of the one status packet of a fast form, whatever its length."""


class Listener:
    """The ear of a bus.

    A reply counts only when ID and length are exact and when it comes no sooner than the wire allows. Of
    several replies to one instruction each counts by itself, whatever became of the others.
    """

    __slots__ = (
        "_awaited",
        "_before",
        "_cyclic",
        "_deadline_ns",
        "_dialect",
        "_earliest_ns",
        "_job",
        "_last_byte_ns",
        "_open",
        "_overhead",
        "_owed",
        "_receiver",
        "_refused",
        "_reply",
        "_reply_size",
        "_sent_ns",
        "_sink",
        "_state",
        "byte_ns",
        "due_ns",
        "index",
        "noise_bytes",
        "unrequested",
    )

    def __init__(self, index: int, plan: BusPlan, packets: PacketSink) -> None:
        self.index = index
        """Its number in the log."""
        self.noise_bytes = 0
        """Bytes that belonged to no intact packet, since the start."""
        self.unrequested = 0
        """Packets since the start that no request of this host explains: instructions of another one, and the
        replies to them."""
        cyclic = {
            (servo.servo_id, servo.state.length + more)  # as many as late replies are told apart by
            for servo in plan.servos
            for more in range(1 + servo.state.spare)
        }
        self._cyclic = frozenset(cyclic | {_FAST}) if any(plan.fast) else frozenset(cyclic)
        self._before: Transaction | None = None  # the one before the awaited one
        self._owed: dict[_Shape, int] = {}
        """Replies that did not come in time and may come late, beside those to cyclic reads."""
        self._sink = packets
        self.byte_ns = BITS_PER_BYTE * 1_000_000_000 // plan.baud_rate
        """What a byte takes on the wire, ns."""
        self._dialect = dialect_of(plan.protocol)
        self._overhead = self._dialect.OVERHEAD
        self._receiver = Receiver(self._status, self._noise, self._dialect)
        self._reply = Reply(_SENT, 0, b"", 0, 0, False)
        self._job: Job | None = None
        self._awaited: Transaction | None = None
        self._state = READY
        self.due_ns = 0
        """When the replies of the newest transaction are due by the wire."""
        self._sent_ns = self._earliest_ns = self._deadline_ns = 0
        self._reply_size = 0
        self._open = 0  # a bit for each status that is still awaited
        self._refused = False
        self._last_byte_ns = -NEVER

    def _await(self, transaction: Transaction, started_ns: int) -> None:
        """Await the replies to a transaction whose instruction is on its way."""
        reply = self._reply
        self._awaited = transaction
        reply.parameters = b""
        reply.error = reply.strays = 0
        reply.echoed = False
        reply.sent_ns = self._sent_ns = started_ns
        if transaction.awaited:
            reply.outcome = _TIMEOUT
            self._state = AWAITING
            self._earliest_ns = started_ns + (len(transaction.packet) + self._overhead) * self.byte_ns
            self._deadline_ns = started_ns + transaction.timeout_ns
            self._reply_size = transaction.widest
            self._open = (1 << len(transaction.awaited)) - 1
            self._refused = False
        else:
            reply.outcome = _SENT
            self._state = RESTING
            self._deadline_ns = started_ns + transaction.due_ns
        self.due_ns = started_ns + transaction.due_ns

    def _owe(self) -> None:
        """Note the replies to a transaction that is given up; they may still come."""
        if self._awaited is None:
            return
        self._before = self._awaited
        if self._state == AWAITING:
            for index, one in enumerate(self._awaited.awaited):
                shape = one.servo_id, one.length
                if self._open >> index & 1 and shape not in self._cyclic:
                    self._owed[shape] = self._owed.get(shape, 0) + 1

    def _skip_headers(self) -> None:
        # as many bytes as an awaited reply has, and it is not whole: its header is a false one
        receiver = self._receiver
        while self._state == AWAITING and receiver.pending >= self._reply_size:
            receiver.skip_header()

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
            and self._state == AWAITING
            and bytes(data[: self._dialect.ID_AT + 1]) == self._dialect.HEADER + bytes((BROADCAST_ID,))
        )

    def _shared(self, data: memoryview, last_ns: int) -> int:
        """Take what is good of the one status of a fast form; return the number of its bytes."""
        awaited, job = self._awaited, self._job
        if awaited is None or job is None:
            return 0
        parts, used = _good_parts(self._dialect, awaited, data)
        if last_ns < self._sent_ns + (len(awaited.packet) + used) * self.byte_ns:
            return 0  # sooner than the wire allows: left over from before
        reply = self._reply
        for index, part in enumerate(parts):
            reply.error, reply.parameters, reply.last_ns = part.error, part.parameters, last_ns
            self._open &= ~(1 << index)
            job.status(index, reply)
        if not self._open:
            reply.outcome = _OK
            self._state = READY
        return used

    def _status(self, packet: memoryview, first_ns: int, last_ns: int) -> None:
        self._sink.packet(self.index, _STATUS, packet[self._dialect.ID_AT], first_ns, last_ns, packet)
        if self._shares(packet):
            if not self._shared(packet, last_ns):
                self._stray(packet)
            return
        status = self._dialect.opened(packet) if self._state == AWAITING else None
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
            self._state = READY

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
        elif not self._explained(packet):
            self.unrequested += 1

    def _explained(self, packet: memoryview) -> bool:
        """Say whether a packet that is not awaited can be a reply to this host: a late one, or a second one.

        Replies are told apart by ID and length, so those of another host that reads what this one reads are
        taken for late ones.
        """
        status = self._dialect.opened(packet)
        if status is None:
            return False
        shape = _FAST if status.servo_id == BROADCAST_ID else (status.servo_id, len(status.parameters))
        if shape in self._cyclic or shape in _shapes(self._awaited) or shape in _shapes(self._before):
            return True
        owed = self._owed.pop(shape, 0)
        if owed > 1:
            self._owed[shape] = owed - 1
        return owed > 0


def _shapes(transaction: Transaction | None) -> list[_Shape]:
    """Return ID and length of the replies to a transaction."""
    return [] if transaction is None else [(one.servo_id, one.length) for one in transaction.awaited]


def _good_parts(dialect: Dialect, transaction: Transaction, data: memoryview) -> tuple[list[Status], int]:
    """Return what is good of the one status of a fast form that is cut off or spoilt, and its bytes."""
    if dialect.size_at(data, 0, len(data)) != transaction.widest:
        return [], 0
    awaited = transaction.awaited
    try:
        parts = dialect.fast_answers(data, [one.length for one in awaited])
    except ValueError:  # spoilt before its first part
        return [], 0
    count = 0
    while count < len(parts) and parts[count].servo_id == awaited[count].servo_id:
        count += 1
    used = dialect.fast_size(sum(one.length for one in awaited[:count]), count) if count else 0
    return parts[:count], used
