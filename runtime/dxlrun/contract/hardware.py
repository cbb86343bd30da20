"""Hardware: interface of the loop to servos on buses, to joints that share servos, or to a replayed log."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dxlrun.plan.loop_plan import ServoLimit


class Hardware(Protocol):
    """Hardware of a robot's joints. Its constructor gets the arrays for states and goals."""

    def start(self, engaging: Callable[[], None] = lambda: None) -> None:
        """Run the start-up sequence up to torque on, and fill states and goals with the measured positions.

        Args:
            engaging: Called before torque is enabled on any servo.

        Raises:
            StartUpError: Servos differ from the plan; the message has all problems, and torque is off.
            PortError: A port failed.
        """

    @property
    def servo_limits(self) -> Mapping[int, Sequence[ServoLimit]]:
        """Registers that limit the goals of each joint's servos, by row; known after `start`.

        It is a new object whenever registers were read again after a servo returned.
        """
        ...

    def read_states(self) -> None:
        """Read the states. A lost packet makes its row invalid and does not raise."""

    def write_goals(self) -> None:
        """Send the goals."""

    def set_modes(self, modes: NDArray[np.uint8]) -> None:
        """Request mode changes, which are executed in idle time. Returns at once.

        During the change, `states.mode` of a joint is UNKNOWN and the joint gets no goals. It becomes the new
        mode after that was read back. If the servo refuses, it becomes the old mode, and an event reports
        that. A later call replaces requests that have not started.

        Args:
            modes: Mode of each joint (`dxlwire.modes.Mode`), shape (joints,); UNKNOWN: no change.
        """

    def write_register(
        self, row: int, item: str, value: int, done: Callable[[str, int | None], None]
    ) -> None:
        """Write a RAM item of a joint's servo in idle time, and read it back. Returns at once.

        The value is written again if the servo is reset.

        Args:
            row: Row of the joint. Rows of single servos follow, for joints with several servos.
            item: Control table item, already checked.
            value: Raw value, already checked.
            done: Called once, now or later, with the problem (empty on success) and the previous value.
        """

    def read_register(self, row: int, item: str, done: Callable[[str, int | None], None]) -> None:
        """Read a control table item of a joint's servo in idle time. Returns at once.

        Args:
            row: Row of the joint, as in `write_register`.
            item: Control table item.
            done: Called once with the problem (empty on success) and the value.
        """

    def switch_torque(self, row: int, on: bool, done: Callable[[str], None]) -> None:
        """Disable the torque of a joint in idle time, or enable it at the measured position. Returns at once.

        A disabled joint gets no goals and no torque until it is enabled. `states.torque` shows the change
        from the next read on.

        Args:
            row: Row of the joint.
            on: True to enable torque.
            done: Called once, now or later, with the problem; empty on success.
        """

    def follow_goals(self, rows: Sequence[int]) -> None:
        """Send goals to joints in the state `Torque.GIVEN`, from this cycle's write on.

        They do not get goals before this call. The loop has set their goals to the measured positions.
        """

    def reboot_servo(self, row: int, done: Callable[[str], None]) -> None:
        """Reboot a joint's servo in idle time. `done` is called after it has recovered or after a timeout."""

    def limit_torque(self, fraction: float) -> None:
        """Limit the torque of all servos to a fraction of their own limits. The next start-up reverts it."""

    def idle(self, until_ns: int, time_ns: int) -> None:
        """Use the idle time before the next cycle.

        Args:
            until_ns: Deadline of the cycle; the call returns earlier by a margin.
            time_ns: Controllers' time of that cycle.
        """

    def stop(self) -> tuple[str, ...]:
        """Disable torque on all servos and read it back; return a sentence for each failure. Never raises."""

    def leave_torque_on(self) -> None:
        """Leave the robot holding with torque on, instead of `stop`. Nothing is sent after this call."""
