"""Hardware: the contract that the loop reads from and writes to; a bus, a simulation, a log."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class Hardware(Protocol):
    """Joints that can be read and commanded; the arrays (States, goals) are given when it is built."""

    def start(self) -> None:
        """Run the start-up sequence to torque on; the first states and goals (= present) are then filled.

        Raises StartUpError (a servo is not what the plan says; all found problems in one message, no torque
        left on) or PortError.
        """
        ...

    def read(self) -> None:
        """Fill the state arrays; a lost packet makes its row invalid, it is never an exception."""
        ...

    def write(self) -> None:
        """Send the goal arrays."""
        ...

    def set_modes(self, modes: NDArray[np.uint8]) -> None:
        """Bring joints into these modes (interfaces.Mode, shape (joints,), UNKNOWN = leave it as it is).

        Returns at once: it is done in the gaps between cycles. Meanwhile `states.mode` of such a joint is
        UNKNOWN and it gets no goal; it becomes the new mode when that was read back, or what it was before
        when the servo refused, which an event tells. A later call replaces what is still waiting.
        """
        ...

    def set_register(self, row: int, item: str, value: int, done: Callable[[str], None]) -> None:
        """Write a RAM item of a joint's servo in the gaps between cycles and read it back.

        Returns at once. `done` is called once, here or in a later gap: with an empty text when the servo has
        it, else with what went wrong. `item` and `value` (the integer on the wire) were checked against the
        control table. A servo that is reset gets it again, with what the robot file declares.
        """
        ...

    def limit_torque(self, fraction: float) -> None:
        """Let no servo exert more than a fraction of its own limit; the next start-up takes it back."""
        ...

    def idle(self, until_ns: int) -> None:
        """Use the gap before the next cycle (probes, draining); return before `until_ns` by a margin."""
        ...

    def stop(self) -> tuple[str, ...]:
        """Switch torque off on every servo, read it back, raise nothing; return a sentence per failure."""
        ...

    def let_go(self, rows: Sequence[int]) -> None:
        """Switch the torque of these joints off in the coming gaps, for the rest of the run."""
        ...

    def release(self) -> None:
        """Leave the robot holding with its torque on, in place of `stop`: nothing is sent any more."""
        ...
