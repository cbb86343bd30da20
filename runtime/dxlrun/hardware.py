"""Hardware: the contract that the loop reads from and writes to; a bus, a simulation, a log."""

from __future__ import annotations

from typing import Protocol

LOST_CYCLES = 3
"""A servo that missed so many replies in a row is lost, until it answers again."""


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

    def limit_torque(self, fraction: float) -> None:
        """Let no servo exert more than a fraction of its own limit; the next start-up takes it back."""
        ...

    def idle(self, until_ns: int) -> None:
        """Use the gap before the next cycle (probes, draining); return before `until_ns` by a margin."""
        ...

    def stop(self) -> tuple[str, ...]:
        """Switch torque off on every servo, read it back, raise nothing; return a sentence per failure."""
        ...
