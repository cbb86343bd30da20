"""A simulated servo of Protocol 1.0: its instructions, error bits, Torque Limit 0, and the EEPROM's lock.

`[i]` marks what no manual has.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Set as AbstractSet

from dxlrun.simulation.servo.access import LockRules
from dxlrun.simulation.servo.memory import Memory, Run
from dxlrun.simulation.servo.node import Answer
from dxlrun.simulation.servo.shaft import Shaft
from dxlrun.simulation.servo.simulated_servo import SimulatedServo
from dxlrun.simulation.wire.packets import BROADCAST, GroupRead, InstructionPacket, ReadEntry
from dxlrun.simulation.wire.protocol1 import ErrorBit, Instruction


class Protocol1Servo(SimulatedServo):
    """AX, DX, EX, RX, and MX with their first firmware."""

    def __init__(self, memory: Memory, shaft: Shaft, note: Callable[[str], None]) -> None:
        super().__init__(memory, shaft, note)
        self._rules = LockRules(memory)

    # Instructions

    def _replies_to(self, packet: InstructionPacket, own: bool) -> bool:
        """Return whether a status packet follows (Status Return Level (16)); of broadcasts only to a ping.

        A packet with a wrong checksum gets none, unless `answers_damaged` asks for the manual's error.
        """
        if not packet.intact and not self.answers_damaged:
            return False
        if packet.intact and packet.instruction == Instruction.PING:
            return True
        level = 1 if packet.intact and packet.instruction == Instruction.READ else 2
        return own and level <= self.registers["status_return_level"]

    def _describe(self, error: int) -> str:
        return repr(ErrorBit(error))

    def _obey(self, packet: InstructionPacket) -> Answer:
        if not packet.intact:
            return ErrorBit.CHECKSUM, b""
        parameters = packet.parameters
        match packet.instruction:
            case Instruction.PING:
                answer: Answer = (0, b"")
            case Instruction.READ if len(parameters) == 2:
                answer = self._answer_read(*parameters)
            case Instruction.WRITE if len(parameters) >= 2:
                answer = self._write(parameters[0], parameters[1:]), b""
            case Instruction.REG_WRITE if len(parameters) >= 2:
                answer = self._register(parameters[0], parameters[1:]), b""
            case Instruction.ACTION if self._registered is not None:
                answer = self._act(), b""
            case Instruction.FACTORY_RESET:
                self.registers.restore_factory_values()
                self.power_up()
                answer = 0, b""
            case Instruction.SYNC_WRITE if packet.servo_id == BROADCAST:
                answer = self._sync_write(parameters), b""
            case _:  # also a bulk read that an AX does not know, and a wrong number of parameters [i]
                answer = ErrorBit.INSTRUCTION, b""
        return answer

    def _answer_group_read(self, read: GroupRead, entry: ReadEntry) -> Answer | None:
        """Return its part of a bulk read: only the MX know it, and only for two servos or more."""
        if "bulk_read" not in self.registers.table.capabilities or len(read.entries) < 2:
            self.note(f"servo {self.servo_id} refuses a bulk read of {len(read.entries)}")
            return None
        if self.registers["status_return_level"] < 1:
            return None
        return self._answer_read(entry.address, entry.length)

    def _answer_read(self, address: int, length: int) -> Answer:
        data = self._read(address, length)
        return (ErrorBit.RANGE, b"") if data is None else (0, data)

    def _sync_write(self, parameters: bytes) -> int:
        if len(parameters) < 2 or parameters[1] == 0 or (len(parameters) - 2) % (parameters[1] + 1):
            return ErrorBit.INSTRUCTION
        address, length, servo_id = parameters[0], parameters[1], self.servo_id
        error = 0
        for start in range(2, len(parameters), length + 1):
            if parameters[start] == servo_id:
                error |= self._write(address, parameters[start + 1 : start + 1 + length])
        return error

    # Protection

    def _refusal(self, run: Run) -> int:
        return self._rules.refusal(run)

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

    def _after_write(self, names: AbstractSet[str]) -> None:
        registers = self.registers
        if "goal_position" in names and self.wakes_on_goal and "torque_enable" not in names:
            registers["torque_enable"] = 1
        if "torque_limit" in names and registers["torque_limit"] > 0:
            self._overload(False)
