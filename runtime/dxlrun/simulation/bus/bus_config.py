"""What a simulated bus is when the simulation starts, and what its servos did since."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from dxlrun.simulation.bus.adapter import AdapterConfig
from dxlrun.simulation.servo.simulated_servo import ServoConfig

_WHOLE_REPLIES = AdapterConfig()


@dataclass(frozen=True, slots=True)
class BusConfig:
    """One serial line and the servos that hang on it."""

    name: str
    baud_rate: int
    """bit/s, of the host and, at the start, of every servo"""
    servos: tuple[ServoConfig, ...]
    protocol: float = 1.0
    """1.0 or 2.0: one bus speaks one protocol"""
    control_tables: tuple[str, ...] = ()
    """Texts of the control tables that plug-ins brought along: this process loads no plug-ins."""
    adapter: AdapterConfig = _WHOLE_REPLIES
    """What is between the line and the host."""
    absent: Literal["silent", "slot"] = "silent"
    """Protocol 2.0, a listed servo is not heard: those after it never answer, or after its time [?]."""


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
