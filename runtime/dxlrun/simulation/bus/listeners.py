"""Who hears an instruction: looked up once for each ID, until a servo changes its ID or rate."""

from __future__ import annotations

from dataclasses import dataclass

from dxlrun.simulation.memory.cells import IDENTITY
from dxlrun.simulation.servo.simulated_servo import SimulatedServo


@dataclass(slots=True)
class ServoCounts:
    """What a servo did on the line since the start."""

    heard: int = 0
    """Intact instructions to it, those to all servos among them."""
    answered: int = 0
    errors: int = 0
    """Answers that tell of an error."""
    last_error: int = 0
    """Of its last answer, as it stood in the packet."""

    def answer(self, error: int, times: int = 1) -> None:
        """Count an answer, or several alike."""
        self.answered += times
        self.errors += times * (error != 0)
        self.last_error = error


class Listeners:
    """The servos of a line by the IDs that reach them."""

    def __init__(self, baud_rate: int) -> None:
        self._baud_rate = baud_rate
        self._servos: list[SimulatedServo] = []
        self._of: dict[int, tuple[SimulatedServo, ...]] = {}

    def add(self, servo: SimulatedServo) -> None:
        """Take note of a servo that hangs on the line now."""
        self._servos.append(servo)
        self._of.clear()
        servo.registers.watch(IDENTITY, self._of.clear)

    def change_rate(self, baud_rate: int) -> None:
        """Take note that the host talks at another rate, bit/s."""
        self._baud_rate = baud_rate
        self._of.clear()

    def of(self, servo_id: int) -> tuple[SimulatedServo, ...]:
        """Return who hears an ID; rates may differ by less than 3 % (e-Manual, Baud Rate (4))."""
        found = self._of.get(servo_id)
        if found is None:
            rate, tolerance = self._baud_rate, 0.03 * self._baud_rate
            heard = [each for each in self._servos if each.listens_to(servo_id)]
            found = tuple(each for each in heard if abs(each.baud_rate - rate) < tolerance)
            self._of[servo_id] = found
        return found
