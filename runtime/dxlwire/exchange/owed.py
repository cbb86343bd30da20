"""Owed replies: keeps record of requests on one line that timed out and whose replies may still arrive.

A status packet carries neither an address nor a sequence number, so a late reply looks like the reply to
the next request for the same number of bytes. One rule handles this for cycle, idle time, start-up and
tools: a status counts only while no reply of its ID and length is owed to another request. A request
therefore asks for a few extra bytes, or is held back, until no matching reply is owed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

from dxlwire.transaction import BROADCAST_ID, ExpectedReply, Transaction

LEAST_WINDOW_NS = 750_000_000
"""Minimum time (ns) for which a reply is owed after its request [i]: stalled machines, virtual machines
and USB adapters delay replies by up to 600 ms."""
MOST_WINDOW_NS = 1_500_000_000  # Limits the wait on a line with even slower replies
# Time after which a slow reply is forgotten, because a stall, such as that of a suspended machine, ends
SLOW_MEMORY_NS = 60_000_000_000
MOST_OWED = 8  # Maximum number of late replies recognized for one repeated request

Question = int | bytes
"""Key by which requests are compared: the address of a read, otherwise the instruction packet."""


class _Entry:
    """One request to one servo whose reply is owed, with the number of its unanswered repetitions."""

    __slots__ = ("count", "first_ns", "last_ns", "length", "question")

    def __init__(self, length: int, question: Question, sent_ns: int) -> None:
        self.length = length
        self.question = question
        self.count = 0
        self.first_ns = self.last_ns = sent_ns


class _Change(NamedTuple):
    """Latest instruction to one servo that may have changed registers, with the times of its repetitions."""

    packet: bytes
    first_ns: int  # Time of the first of its repetitions
    last_ns: int


class OwedReplies:
    """Replies that may still arrive on one line after their timeout, by servo ID and number of parameter
    bytes.

    Replies of a fast form are filed under the broadcast ID and the size of their single packet."""

    def __init__(self, now_ns: Callable[[], int]) -> None:
        """Start without owed replies; `now_ns` returns the time of the run's clock."""
        self._now_ns = now_ns
        self.version = 0  # Increases with each reply that becomes owed
        self._entries: dict[int, list[_Entry]] = {}
        self._changes: dict[int, _Change] = {}
        self._slowest_ns = 0
        self._slowest_at_ns = 0

    @property
    def window_ns(self) -> int:
        """Time for which a reply is owed after its request, ns: more than the slowest recent reply took."""
        if self._slowest_ns and self._now_ns() - self._slowest_at_ns > SLOW_MEMORY_NS:
            self._slowest_ns = 0
        # A margin of 25 % over the slowest reply, because the next one may be slower still.
        return min(max(LEAST_WINDOW_NS, self._slowest_ns * 5 // 4), MOST_WINDOW_NS)

    def add(self, transaction: Transaction, index: int, sent_ns: int) -> None:
        """Record the reply at `index` of a transaction, which was sent at `sent_ns`, as owed: it did not
        arrive in time."""
        servo_id, length, question = _shapes(transaction)[index]
        entries = self._entries.setdefault(servo_id, [])
        # Replies to expired requests are no longer expected.
        entries[:] = [one for one in entries if one.last_ns + self.window_ns > sent_ns]
        entry = next((one for one in entries if (one.length, one.question) == (length, question)), None)
        if entry is None:
            entry = _Entry(length, question, sent_ns)
            entries.append(entry)
        entry.count = min(entry.count + 1, MOST_OWED)
        entry.last_ns = sent_ns
        self.version += 1

    def charge_reply(self, servo_id: int, length: int, error: int) -> bool:
        """Remove the oldest owed reply that a received status may be; return True if there was one."""
        entries = self._entries.get(servo_id, [])
        found = next((one for one in entries if one.length == length), None)
        if found is None:
            # A refusal has no data, whatever was requested, so the answered request stays unknown.
            return bool(entries) and length == 0 and error != 0
        now_ns, window_ns = self._now_ns(), self.window_ns
        if self._slowest_ns <= (late_ns := now_ns - found.last_ns) < window_ns:
            self._slowest_ns, self._slowest_at_ns = late_ns, now_ns
        found.count -= 1
        if not found.count:
            entries.remove(found)
        return True

    def note_answer(self, transaction: Transaction, awaited: ExpectedReply, sent_ns: int) -> None:
        """Note that a request was answered. If a reply is owed to an older, identical request, its time
        now counts from this one."""
        servo_id, length, question = _shape(transaction, awaited)
        for one in self._entries.get(servo_id, ()):
            if (one.length, one.question) == (length, question) and one.last_ns + self.window_ns > sent_ns:
                one.last_ns = sent_ns

    def note_change(self, transaction: Transaction, sent_ns: int) -> None:
        """Note that an instruction which may change registers was sent: replies to older reads of this
        servo are out of date."""
        before, first_ns = self._changes.get(transaction.servo_id), sent_ns
        if before is not None and before.packet == transaction.packet:
            # A retry changes nothing. After the window the servo may have changed the register itself, as by
            # a reboot.
            first_ns = before.first_ns if sent_ns - before.last_ns < self.window_ns else sent_ns
        self._changes[transaction.servo_id] = _Change(transaction.packet, first_ns, sent_ns)

    def free_ns(self, transaction: Transaction, *, any_age: bool = False) -> int:
        """Return the time from which no late reply can be taken for a reply to this transaction, ns; 0: it
        is so now."""
        window_ns, free_ns = self.window_ns, 0
        for servo_id, length, question in _shapes(transaction):
            for one in self._entries.get(servo_id, ()):
                if one.length == length and not self._same(servo_id, one, question, any_age=any_age):
                    free_ns = max(free_ns, one.last_ns + window_ns)
        return free_ns if free_ns and free_ns > self._now_ns() else 0

    def confuses(
        self, transaction: Transaction, awaited: ExpectedReply, *, refusal: bool, any_age: bool
    ) -> bool:
        """Return True if a status that fits `awaited` may be the late reply to another request.

        A refusal has no data, so it may belong to a request of any length."""
        servo_id, length, question = _shape(transaction, awaited)
        if not (entries := self._entries.get(servo_id)):
            return False
        now_ns, window_ns = self._now_ns(), self.window_ns
        return any(
            (refusal or one.length == length)
            and one.last_ns + window_ns > now_ns
            and not self._same(servo_id, one, question, any_age=any_age)
            for one in entries
        )

    def asked_ns(self, transaction: Transaction, sent_ns: int) -> int:
        """Return the send time of the oldest request that a reply to this transaction may answer, ns.

        A late reply to an earlier repetition counts as the reply to this one."""
        times = [
            one.first_ns
            for servo_id, length, question in _shapes(transaction)
            for one in self._entries.get(servo_id, ())
            if (one.length, one.question) == (length, question) and one.last_ns + self.window_ns > sent_ns
        ]
        return min([sent_ns, *times])

    def newest_ns(self, transactions: Iterable[Transaction]) -> int:
        """Return the send time (ns) of the newest request whose late reply could be taken for one of these
        transactions; 0 without one."""
        times = [
            one.last_ns
            for transaction in transactions
            for servo_id, length, _ in _shapes(transaction)
            for one in self._entries.get(servo_id, ())
            if one.length == length
        ]
        return max(times, default=0)

    def _same(self, servo_id: int, one: _Entry, question: Question, *, any_age: bool) -> bool:
        """Return True if a late reply to an older request answers the new request as well as its own reply
        would.

        Args:
            servo_id: The servo.
            one: Repetitions of the older request.
            question: Key of the new request.
            any_age: Accept replies from before a write as well. A write invalidates older readings of
                registers, but not measured states.
        """
        if one.question != question:
            return False
        changes = (self._changes.get(each) for each in (servo_id, BROADCAST_ID))
        return any_age or all(change is None or one.first_ns >= change.first_ns for change in changes)


def _shape(transaction: Transaction, awaited: ExpectedReply) -> tuple[int, int, Question]:
    question = awaited.address if awaited.address >= 0 else transaction.packet
    return awaited.servo_id, awaited.length, question


def _shapes(transaction: Transaction) -> Sequence[tuple[int, int, Question]]:
    if transaction.fast:
        return [(BROADCAST_ID, transaction.widest, transaction.packet)]
    return [_shape(transaction, one) for one in transaction.awaited]
