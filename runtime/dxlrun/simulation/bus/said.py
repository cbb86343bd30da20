"""What the servos of a line said to a read in turn, to be said again as long as nothing of it changes.

A robot that stands is read a thousand times a second, and each time every servo shows the same.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from dxlrun.simulation.bus.flow import Answers, Flow
from dxlrun.simulation.bus.listeners import Listeners, ServoCounts
from dxlrun.simulation.servo.simulated_servo import SimulatedServo
from dxlrun.simulation.wire.packets import Codec, ReadEntry, ReadInTurn, Reply


class Said:
    """The answers to one read; said again as long as their servos rest."""

    __slots__ = ("_heard", "_listeners", "_mechanics", "_still", "_times", "answers", "flow", "reading")

    def __init__(
        self,
        reading: ReadInTurn,
        answers: Answers,
        flow: Flow | None,
        listeners: Listeners,
        resting: Sequence[tuple[SimulatedServo, ServoCounts]],
    ) -> None:
        """`flow`: where each servo answers alone; `resting`: who would say the same again, all or nobody."""
        self.reading = reading
        self.answers = answers
        self.flow = flow
        self._times = 0
        first = reading.entries[0].servo_id
        self._listeners = listeners, first, listeners.of(first)
        self._heard = [
            (servo.body, servo.registers, servo.registers.changes, count, replies[0].error)
            for (servo, count), (_, replies) in zip(resting, answers, strict=False)
        ]
        self._mechanics = resting[0][0].mechanics if resting else None
        self._still = self._mechanics.still if self._mechanics else 0

    def again(self, reading: ReadInTurn, now_ns: int) -> bool:
        """Let the servos hear a read at a time; return whether they say the same, which is counted.

        A servo that hears nothing any more was changed as well.
        """
        mechanics = self._mechanics
        listeners, first, before = self._listeners
        if mechanics is None or reading is not self.reading or listeners.of(first) is not before:
            return False
        mechanics.advance(now_ns)
        if mechanics.still != self._still:
            return False
        for _, memory, changes, _, _ in self._heard:
            if memory.changes != changes:
                return False
        for body, _, _, _, _ in self._heard:
            body.hear_again(now_ns)
        self._times += 1
        return True

    def count(self) -> None:
        """Enter what was said again into the servos' counts."""
        times, self._times = self._times, 0
        for _, _, _, count, error in self._heard if times else ():
            count.heard += times
            count.answer(error, times)


class Readings:
    """Asks the servos of a line for what a read in turn wants, or lets them say what they said before."""

    def __init__(
        self,
        codec: Codec,
        duration_ns: Callable[[int], int],
        listeners: Listeners,
        counts: Mapping[SimulatedServo, ServoCounts],
    ) -> None:
        """`duration_ns`: how long so many bytes take."""
        self._codec = codec
        self._duration_ns = duration_ns
        self._listeners = listeners
        self._counts = counts
        self._said: Said | None = None

    def said(self, reading: ReadInTurn, slots: bool, end_ns: int) -> Said:
        """Return what each listed servo says to a read that ended then; without slots none behind a gap."""
        if self._said is None or not self._said.again(reading, end_ns):
            self.count()
            answers = self._asked(reading, slots, end_ns)
            flow = self._flow(reading, answers, slots)
            self._said = Said(reading, answers, flow, self._listeners, self._resting(reading, answers))
        return self._said

    def count(self) -> None:
        """Bring the servos' counts up to date."""
        if self._said is not None:
            self._said.count()

    def _asked(self, reading: ReadInTurn, slots: bool, end_ns: int) -> list[tuple[ReadEntry, list[Reply]]]:
        answers: list[tuple[ReadEntry, list[Reply]]] = []
        for entry in reading.entries:
            replies = []
            for servo in self._listeners.of(entry.servo_id):
                if servo.servo_id != entry.servo_id:
                    continue  # only by its secondary ID, to which it never answers
                count = self._counts[servo]
                count.heard += 1
                reply = servo.answer_in_turn(reading, entry, end_ns)
                if reply is None:
                    continue
                count.answer(reply.error)
                replies.append(reply)
            answers.append((entry, replies))
            if not replies and not slots:
                break
        return answers

    def _flow(self, reading: ReadInTurn, answers: Answers, slots: bool) -> Flow | None:
        """Return the answers as a flow; None: not each of the listed servos answers alone."""
        if len(answers) < len(reading.entries) or any(len(replies) != 1 for _, replies in answers):
            return None
        if reading.fast:
            part = self._codec.fast_status(reading.lengths).part
            parts = [part(reply) for _, (reply,) in answers]
        else:
            status = self._codec.status_packet
            parts = [status(reply.servo_id, reply.error, reply.parameters) for _, (reply,) in answers]
        return Flow(reading, answers, parts, self._duration_ns, slots)

    def _resting(self, reading: ReadInTurn, answers: Answers) -> list[tuple[SimulatedServo, ServoCounts]]:
        """Return who would say the same again: each that was asked, or nobody."""
        resting = []
        for entry, replies in answers:
            servos = self._listeners.of(entry.servo_id)
            if len(replies) != 1 or len(servos) != 1 or not servos[0].shows_the_same(entry):
                return []
            resting.append((servos[0], self._counts[servos[0]]))
        return resting if len(resting) == len(reading.entries) else []
