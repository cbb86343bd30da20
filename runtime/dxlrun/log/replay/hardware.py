"""Recorded hardware and clock: the two seams of the loop, fed from a log instead of a bus and a processor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from dxlrun.control.loop import StopFlag
from dxlrun.errors import PortError
from dxlrun.interfaces import COMMAND_INTERFACES, States
from dxlrun.run.channels.cycle import CycleRecord

_STATES = tuple(field.name for field in fields(States) if field.name != "motion")  # which shows three of them


class RecordedClock:
    """Time as the loop read it in the recorded run, at each place where it matters to controllers."""

    __slots__ = ("_now_ns", "wake_ns")

    def __init__(self, now_ns: int) -> None:
        self._now_ns = now_ns
        self.wake_ns = now_ns
        """When the next wait ends."""

    def now_ns(self) -> int:
        """Return recorded time, ns."""
        return self._now_ns

    def wait_until(self, deadline_ns: int) -> int:
        """Return when the loop woke then, ns."""
        self._now_ns = self.wake_ns
        return self._now_ns

    def move(self, now_ns: int) -> None:
        """Let it be `now_ns`."""
        self._now_ns = now_ns


class RecordedHardware:
    """Servos that say what they said then, bit for bit, and take no goals; see `control.hardware`.

    After each cycle it moves the clock to the deadline of the next recorded one, so that the loop skips the
    periods that were skipped. After the cycle before number `ends` of them it asks the loop to stop: those
    from there on are a policy's. After the last one there is no bus any more.
    """

    def __init__(
        self,
        cycles: NDArray[np.void],
        activation: np.void,
        record: CycleRecord,
        clock: RecordedClock,
        stop: StopFlag,
        *,
        ends: int,
    ) -> None:
        self._ends = ends
        self._states = {name: np.ascontiguousarray(cycles[name]) for name in _STATES}
        self._due, self._woken, self._read, self._written = (
            cycles[name].tolist() for name in ("scheduled_ns", "woken_ns", "read_ns", "written_ns")
        )
        self._activation = activation
        self._record = record
        self._clock = clock
        self._stop = stop
        self._index = 0

    def start(self) -> None:
        """Fill states and goals with those of the activation."""
        record = self._record
        for name in _STATES:
            np.copyto(getattr(record.states, name), self._activation[name])
        for interface in COMMAND_INTERFACES:
            np.copyto(getattr(record.goals, interface), self._activation[f"goal_{interface}"])

    def idle(self, until_ns: int) -> None:
        """Let the coming wait end when it ended then. Raises PortError behind the last cycle."""
        if self._index == len(self._woken):
            raise PortError("the log ends")
        self._clock.wake_ns = self._woken[self._index]

    def read(self) -> None:
        """Fill the states of this cycle."""
        for name in _STATES:
            np.copyto(getattr(self._record.states, name), self._states[name][self._index])
        self._clock.move(self._read[self._index])

    def write(self) -> None:
        """Take no goals: go to where the next cycle was due."""
        following = self._index + 1
        if following < len(self._due):
            self._clock.move(self._due[following])
        else:
            self._clock.move(self._written[self._index])
        if following == self._ends:
            self._stop.request()
        self._index = following

    def set_modes(self, modes: NDArray[np.uint8]) -> None:
        """Switch nothing: when the servos were in which mode is in their states."""

    def set_register(self, row: int, item: str, value: int, done: Callable[[str], None]) -> None:
        """Write nothing, and say nothing of it: what came of it is in the states."""

    def limit_torque(self, fraction: float) -> None:
        """Limit nothing: what the servos did then is in their states."""

    def stop(self) -> tuple[str, ...]:
        """Do nothing: no servo has torque."""
        return ()

    def let_go(self, rows: Sequence[int]) -> None:
        """Do nothing: what the servos did then is in their states."""

    def release(self) -> None:
        """Do nothing: there is nobody who holds."""
