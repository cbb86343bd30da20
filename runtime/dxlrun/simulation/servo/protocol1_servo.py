"""A simulated servo of Protocol 1.0: its instructions, error bits, Torque Limit 0, and the EEPROM's lock.

`[i]` marks what no manual has.
"""

from __future__ import annotations

from collections.abc import Callable

from dxlrun.simulation.servo.access import lock_rules
from dxlrun.simulation.servo.memory import Memory
from dxlrun.simulation.servo.shaft import Shaft
from dxlrun.simulation.servo.simulated_servo import SimulatedServo
from dxlrun.simulation.wire.packets import GroupRead, Instruction, InstructionPacket
from dxlrun.simulation.wire.protocol1 import ErrorBit


class Protocol1Servo(SimulatedServo):
    """AX, DX, EX, RX, and MX with their first firmware."""

    def __init__(self, memory: Memory, shaft: Shaft, note: Callable[[str], None]) -> None:
        super().__init__(memory, lock_rules, shaft, note)

    def _manage(self, packet: InstructionPacket) -> int:
        """Return an instruction error also of a bulk read that an AX does not know [i]."""
        if packet.instruction != Instruction.FACTORY_RESET:
            return super()._manage(packet)
        self.registers.restore_factory_values()
        self.power_up()
        return 0

    def _takes_part(self, read: GroupRead) -> bool:
        """Return whether it knows a bulk read: only the MX do, and only for two servos or more."""
        known = "bulk_read" in self.registers.table.capabilities and len(read.entries) >= 2
        if not known:
            self.note(f"servo {self.servo_id} refuses a bulk read of {len(read.entries)}")
        return known

    # Protection

    def _state(self) -> int:
        """Return the error bits that last as long as their cause."""
        registers = self.registers
        error = int(ErrorBit.OVERLOAD) if self.overload else 0
        if not registers["min_voltage_limit"] <= round(self.voltage * 10) <= registers["max_voltage_limit"]:
            error |= ErrorBit.VOLTAGE
        if round(self.temperature) > registers["temperature_limit"]:
            error |= ErrorBit.OVERHEATING
        return error

    def protect(self, refused: int = 0) -> None:
        """Set Torque Limit to 0 when Shutdown (18) lists an error; Torque Enable (24) stays as it is."""
        error = self._state() | refused
        if error & self.registers["shutdown"] and self.registers["torque_limit"]:
            self.note(f"servo {self.servo_id}: shutdown, torque limit 0: {ErrorBit(error)!r}")
            self._set("torque_limit", 0)

    def _start_up(self) -> None:
        self._started_ns = self.shaft.now_ns
        self.registers["torque_limit"] = self.registers["max_torque"]  # e-Manual, Torque Limit (34)

    def _written(self, names: frozenset[str]) -> None:
        registers = self.registers
        if "goal_position" in names and self.wakes_on_goal and "torque_enable" not in names:
            registers["torque_enable"] = 1
        if "torque_limit" in names and registers["torque_limit"] > 0:
            self.overload = False
        super()._written(names)
