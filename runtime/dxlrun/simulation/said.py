"""What the servos of a line said to a read in turn, to be said again as long as nothing of it changes.

A robot that stands is read a thousand times a second, and each time every servo shows the same.
"""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun.simulation.bus_config import ServoCounts
from dxlrun.simulation.listeners import Listeners
from dxlrun.simulation.packets import FastStatus, ReadEntry, ReadInTurn, Reply
from dxlrun.simulation.servo import SimulatedServo

Answers = Sequence[tuple[ReadEntry, list[Reply]]]
"""Who was asked, and who answered."""


class Said:
    """The answers to one read, of servos that rest."""

    __slots__ = ("_heard", "_listeners", "_mechanics", "_still", "answers", "parts", "reading")

    def __init__(
        self,
        reading: ReadInTurn,
        answers: Answers,
        shared: FastStatus | None,
        listeners: Listeners,
        counts: Sequence[tuple[SimulatedServo, ServoCounts]],
    ) -> None:
        """`shared`: an empty status packet, where the servos share one; `counts`: of who answered."""
        self.reading = reading
        self.answers = answers
        self.parts = shared and [shared.part(replies[0]) for _, replies in answers]
        """What each of them adds to the status packet that they share."""
        self._mechanics = counts[0][0].mechanics
        self._still = self._mechanics.still
        first = reading.entries[0].servo_id
        self._listeners = listeners, first, listeners.of(first)
        self._heard = [
            (servo, servo.registers.changes, count, replies[0].error)
            for (servo, count), (_, replies) in zip(counts, answers, strict=True)
        ]

    def again(self, reading: ReadInTurn, now_ns: int) -> bool:
        """Let the servos hear a read at a time; return whether they say the same, which is counted."""
        listeners, first, before = self._listeners
        if reading is not self.reading or listeners.of(first) is not before:
            return False
        for servo, changes, _, _ in self._heard:
            if not servo.hears(now_ns) or servo.registers.changes != changes:
                return False
        if self._mechanics.still != self._still:
            return False
        for _, _, count, error in self._heard:
            count.heard += 1
            count.answer(error)
        return True


def asked(
    reading: ReadInTurn,
    listeners: Listeners,
    counts: dict[SimulatedServo, ServoCounts],
    slots: bool,
    end_ns: int,
) -> list[tuple[ReadEntry, list[Reply]]]:
    """Return what each listed servo says to a read that ended at a time; without slots none behind a gap."""
    answers: list[tuple[ReadEntry, list[Reply]]] = []
    for entry in reading.entries:
        replies = []
        for servo in listeners.of(entry.servo_id):
            if servo.servo_id != entry.servo_id:
                continue  # only by its secondary ID, to which it never answers
            count = counts[servo]
            count.heard += 1
            reply = servo.answer_in_turn(reading, entry, end_ns)
            if reply is None:
                continue
            count.answer(reply.error)
            if reading.fast and entry is not reading.entries[0]:
                # only the first one of a shared status waits
                reply = Reply(reply.servo_id, reply.error, reply.parameters, 0)
            replies.append(reply)
        answers.append((entry, replies))
        if not replies and not slots:
            break
    return answers


def said(
    reading: ReadInTurn,
    answers: Answers,
    shared: FastStatus | None,
    listeners: Listeners,
    counts: dict[SimulatedServo, ServoCounts],
) -> Said | None:
    """Return what can be said again; None: it may be something else the next time."""
    found = []
    for entry, replies in answers:
        servos = listeners.of(entry.servo_id)
        if len(replies) != 1 or len(servos) != 1 or not servos[0].shows_the_same(entry):
            return None
        found.append((servos[0], counts[servos[0]]))
    return Said(reading, answers, shared, listeners, found) if len(found) == len(reading.entries) else None


class Repeated:
    """A status packet that several servos put together as they did before."""

    __slots__ = ("_parts",)

    def __init__(self, parts: Sequence[bytes]) -> None:
        self._parts = iter(parts)

    def part(self, _: Reply) -> bytes:
        """Return the bytes that the next servo adds."""
        return next(self._parts)


def nothing_shared(_: tuple[int, ...]) -> FastStatus | None:
    """Return None: each servo sends a status packet of its own."""
    return None
