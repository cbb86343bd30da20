"""How a servo of Protocol 1.0 protects itself: error bits, Torque Limit 0, and the EEPROM's lock."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Set as AbstractSet

from dxlrun.simulation.memory.access import LockRules
from dxlrun.simulation.memory.cells import Memory, Run
from dxlrun.simulation.motion.shaft import Shaft
from dxlrun.simulation.servo.body import Body
from dxlrun.simulation.wire.protocol1 import ErrorBit


class LockBody(Body):
    """A servo of Protocol 1.0."""

    def __init__(self, memory: Memory, shaft: Shaft, note: Callable[[str], None]) -> None:
        super().__init__(memory, shaft, note)
        self._rules = LockRules(memory)

    def refusal(self, run: Run) -> int:
        """Return the error bits of a write, 0 when it is allowed."""
        return self._rules.refusal(run)

    def state(self) -> int:
        """Return the error bits that last as long as their cause."""
        memory = self.memory
        error = int(ErrorBit.OVERLOAD) if self.overload else 0
        if not memory["min_voltage_limit"] <= round(self.voltage * 10) <= memory["max_voltage_limit"]:
            error |= ErrorBit.VOLTAGE
        if round(self.temperature) > memory["temperature_limit"]:
            error |= ErrorBit.OVERHEATING
        return error

    def protect(self, refused: int = 0) -> None:
        """Set Torque Limit to 0 when Shutdown (18) lists an error; Torque Enable (24) stays as it is."""
        error = self.state() | refused
        memory = self.memory
        if error & memory["shutdown"] and memory["torque_limit"]:
            self.note(f"servo {self.servo_id}: shutdown, torque limit 0: {ErrorBit(error)!r}")
            memory["torque_limit"] = 0
            self.shaft.plan(("torque_limit",))

    def _start_up(self) -> None:
        self._started_ns = self.shaft.now_ns
        self.memory["torque_limit"] = self.memory["max_torque"]  # e-Manual, Torque Limit (34)

    def _obey(self, names: AbstractSet[str]) -> None:
        memory = self.memory
        if "goal_position" in names and self.wakes_on_goal and "torque_enable" not in names:
            memory["torque_enable"] = 1
        if "torque_limit" in names and memory["torque_limit"] > 0:
            self.overload = False
