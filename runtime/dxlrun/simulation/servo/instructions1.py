"""How a servo of Protocol 1.0 obeys instructions; `[i]` marks what no manual says."""

from __future__ import annotations

from dxlrun.simulation.servo.body import Body
from dxlrun.simulation.wire.packets import BROADCAST, GroupRead, InstructionPacket, ReadEntry
from dxlrun.simulation.wire.protocol1 import ErrorBit, Instruction

Answer = tuple[int, bytes]
"""Error and parameters of a reply."""


class Instructions1:
    """The instructions of one servo."""

    def __init__(self, body: Body) -> None:
        self._body = body

    def answers(self, packet: InstructionPacket, own: bool) -> bool:
        """Return whether a status packet follows (Status Return Level (16)); of broadcasts only to a ping.

        A packet with a wrong checksum gets none, unless `Body.answers_damaged` asks for the manual's error.
        """
        if not packet.intact and not self._body.answers_damaged:
            return False
        if packet.intact and packet.instruction == Instruction.PING:
            return True
        level = 1 if packet.intact and packet.instruction == Instruction.READ else 2
        return own and level <= self._body.memory["status_return_level"]

    def delay_ns(self, packet: InstructionPacket, byte_ns: int) -> int:
        """Return how long the servo waits before it answers: Return Delay Time (5)."""
        return self._body.delay_ns

    def describe(self, error: int) -> str:
        """Return an error in words."""
        return repr(ErrorBit(error))

    def obey(self, packet: InstructionPacket) -> Answer:
        """Return error bits and parameters of the reply."""
        if not packet.intact:
            return ErrorBit.CHECKSUM, b""
        parameters = packet.parameters
        match packet.instruction:
            case Instruction.PING:
                answer: Answer = (0, b"")
            case Instruction.READ if len(parameters) == 2:
                answer = _read(self._body, *parameters)
            case Instruction.WRITE if len(parameters) >= 2:
                answer = self._body.write(parameters[0], parameters[1:]), b""
            case Instruction.REG_WRITE if len(parameters) >= 2:
                answer = self._body.register(parameters[0], parameters[1:]), b""
            case Instruction.ACTION if self._body.has_registered:
                answer = self._body.act(), b""
            case Instruction.FACTORY_RESET:
                self._body.memory.restore_factory_values()
                self._body.power_up()
                answer = 0, b""
            case Instruction.SYNC_WRITE if packet.servo_id == BROADCAST:
                answer = _sync_write(self._body, parameters), b""
            case _:  # also a bulk read that an AX does not know, and a wrong number of parameters [i]
                answer = ErrorBit.INSTRUCTION, b""
        return answer

    def reply_to_group_read(self, reading: GroupRead, entry: ReadEntry) -> Answer | None:
        """Return a servo's part of a bulk read; None: it says nothing.

        Only the MX know it, and only for two servos or more.
        """
        if "bulk_read" not in self._body.memory.table.capabilities or len(reading.entries) < 2:
            self._body.note(f"servo {self._body.servo_id} refuses a bulk read of {len(reading.entries)}")
            return None
        if self._body.memory["status_return_level"] < 1:
            return None
        return _read(self._body, entry.address, entry.length)


def _read(body: Body, address: int, length: int) -> Answer:
    data = body.read(address, length)
    return (ErrorBit.RANGE, b"") if data is None else (0, data)


def _sync_write(body: Body, parameters: bytes) -> int:
    if len(parameters) < 2 or parameters[1] == 0 or (len(parameters) - 2) % (parameters[1] + 1):
        return ErrorBit.INSTRUCTION
    address, length, servo_id = parameters[0], parameters[1], body.servo_id
    error = 0
    for start in range(2, len(parameters), length + 1):
        if parameters[start] == servo_id:
            error |= body.write(address, parameters[start + 1 : start + 1 + length])
    return error
