"""What the loop asks of a robot's hardware: servos on buses, joints that share servos, or a replayed log."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dxlrun.plan.loop_plan import ServoLimit


class Hardware(Protocol):
    """Joints that can be read and commanded; the arrays (States, goals) are given when it is built."""

    def start(self, engaging: Callable[[], None] = lambda: None) -> None:
        """Run the start-up sequence to torque on; the first states and goals (= present) are then filled.

        `engaging` is called before any servo gets torque. Raises StartUpError (a servo is not as planned; all
        found problems in one message, no torque left on) or PortError.
        """

    @property
    def servo_limits(self) -> Mapping[int, Sequence[ServoLimit]]:
        """The registers that limit the goals of each joint's servos, by row; known once it has started.

        Another object when they were read again, of a servo that returned.
        """
        ...

    def read(self) -> None:
        """Fill the state arrays; a lost packet makes its row invalid, it is never an exception."""

    def write(self) -> None:
        """Send the goal arrays."""

    def set_modes(self, modes: NDArray[np.uint8]) -> None:
        """Bring joints into these modes (interfaces.Mode, shape (joints,), UNKNOWN = leave it as it is).

        Returns at once: it is done in idle time. Meanwhile `states.mode` of such a joint is
        UNKNOWN and it gets no goal; it becomes the new mode when that was read back, or what it was before
        when the servo refused, which an event reports. A later call replaces what is still waiting.
        """

    def set_register(self, row: int, item: str, value: int, done: Callable[[str, int | None], None]) -> None:
        """Write a RAM item of a joint's servo in idle time and read it back.

        `row`: of the joint; where several servos move one joint, the rows of single servos follow those.
        Returns at once. `done` is called once, here or later: with an empty text when the servo has
        it, else with what went wrong, and with what it had before. `item` and `value` (the integer on the
        wire) were checked against the control table. A servo that is reset gets it again, with what the robot
        file declares.
        """

    def read_register(self, row: int, item: str, done: Callable[[str, int | None], None]) -> None:
        """Read an item of a joint's servo in idle time; `done` takes what went wrong, and what it has."""

    def switch_torque(self, row: int, on: bool, done: Callable[[str], None]) -> None:
        """Switch the torque of a joint off in the coming idle time, or on where it stands.

        Returns at once. `done` is called once, here or later, with what went wrong, or an empty text. A joint
        that was switched off gets no goals and no torque until it is switched on; `states.torque` shows it
        from the next read on.
        """

    def follow_goals(self, rows: Sequence[int]) -> None:
        """Let joints that were just given torque (`Torque.GIVEN`) get goals from this cycle's write on.

        The loop has set their goals to where the joints are; until this call they get none.
        """

    def reboot(self, row: int, done: Callable[[str], None]) -> None:
        """Reboot a joint's servo in idle time; `done` is called when it is in order again, or is given up."""

    def limit_torque(self, fraction: float) -> None:
        """Let no servo exert more than a fraction of its own limit; the next start-up takes it back."""

    def idle(self, until_ns: int, time_ns: int) -> None:
        """Use the idle time before the next cycle; return before `until_ns` by a margin.

        `time_ns`: the controllers' time of that cycle.
        """

    def stop(self) -> tuple[str, ...]:
        """Switch torque off on every servo, read it back, raise nothing; return a sentence per failure."""

    def release(self) -> None:
        """Leave the robot holding with its torque on, in place of `stop`: nothing is sent any more."""
