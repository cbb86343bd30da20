"""How a servo of Protocol 2.0 obeys instructions; `[i]` marks what no manual says."""

from __future__ import annotations

from dxlrun.simulation.body import Body
from dxlrun.simulation.packets import BROADCAST, InstructionPacket, ReadEntry, ReadInTurn
from dxlrun.simulation.protocol2 import ErrorNumber, Instruction
from dxlrun.simulation.torque_body import TorqueBody

Answer = tuple[int, bytes]
"""Error and parameters of a reply."""

SLOT_NS = 1_000_000
"""What a servo's slot after a broadcast ping is longer than its reply [i]."""

_PING_REPLY = 14
_CLEAR_TURNS = bytes.fromhex("01 44 58 4c 22")
_BACK_UP = bytes.fromhex("01 43 54 52 4c")
_RESTORE = bytes.fromhex("02 43 54 52 4c")
_KEPT_BY_RESET = {0xFF: (), 0x01: ("id",), 0x02: ("id", "baud_rate", "baud_rate_bus")}


class Instructions2:
    """The instructions of one servo."""

    def __init__(self, body: TorqueBody) -> None:
        self._body = body

    def answers(self, packet: InstructionPacket, own: bool) -> bool:
        """Return whether a status packet follows (Status Return Level (68)); of broadcasts only to a ping."""
        if packet.intact and packet.instruction == Instruction.PING:
            return True
        level = 1 if packet.intact and packet.instruction == Instruction.READ else 2
        return own and level <= self._body.memory["status_return_level"]

    def delay_ns(self, packet: InstructionPacket, byte_ns: int) -> int:
        """Return how long the servo waits: Return Delay Time, after a broadcast ping also for its slot."""
        delay = self._body.memory["return_delay_time"] * 2000
        if packet.servo_id == BROADCAST and packet.instruction == Instruction.PING:
            delay += self._body.servo_id * (_PING_REPLY * byte_ns + SLOT_NS)
        return delay

    def describe(self, error: int) -> str:
        """Return an error in words."""
        return repr(ErrorNumber(error))

    def obey(self, packet: InstructionPacket) -> Answer:
        """Return error number and parameters of the reply."""
        if not packet.intact:
            return ErrorNumber.CRC, b""
        parameters = packet.parameters
        match packet.instruction:
            case Instruction.PING:
                memory = self._body.memory
                answer: Answer = 0, memory.data("model_number") + memory.data("firmware_version")
            case Instruction.READ if len(parameters) == 4:
                answer = _read(self._body, _word(parameters, 0), _word(parameters, 2))
            case Instruction.WRITE if len(parameters) >= 3:
                answer = self._body.write(_word(parameters, 0), parameters[2:]), b""
            case Instruction.REG_WRITE if len(parameters) >= 3:
                answer = self._body.register(_word(parameters, 0), parameters[2:]), b""
            case Instruction.ACTION if self._body.has_registered:
                answer = self._body.act(), b""
            case Instruction.SYNC_WRITE if packet.servo_id == BROADCAST:
                answer = _sync_write(self._body, parameters), b""
            case Instruction.BULK_WRITE if packet.servo_id == BROADCAST:
                answer = _bulk_write(self._body, parameters), b""
            case _:
                answer = _manage(self._body, packet), b""
        return answer

    def answer_in_turn(self, reading: ReadInTurn, entry: ReadEntry) -> Answer | None:
        """Return a servo's part of a sync or bulk read; None: it says nothing.

        A fast read needs a firmware that knows it, and its form has no room for an error without data [i].
        """
        if self._body.memory["status_return_level"] < 1:
            return None
        answer = _read(self._body, entry.address, entry.length)
        if reading.fast:
            first = self._body.memory.table.fast_sync_read_firmware
            if first is None or self._body.memory["firmware_version"] < first or answer[0]:
                self._body.note(
                    f"servo {self._body.servo_id} does not answer the fast read {reading.instruction:#04x}"
                )
                return None
        return answer


def _read(body: Body, address: int, length: int) -> Answer:
    """Return data, or an access error where no item is; cells between items are 0 [i]."""
    data = body.read(address, length)
    if data is None or not body.memory.touches(address, length):
        return ErrorNumber.ACCESS, b""
    return 0, data


def _sync_write(body: Body, parameters: bytes) -> int:
    address, length = _word(parameters, 0), _word(parameters, 2)
    if length == 0 or len(parameters) < 5 + length or (len(parameters) - 4) % (length + 1):
        return ErrorNumber.INSTRUCTION
    error, servo_id = 0, body.servo_id
    for start in range(4, len(parameters), length + 1):
        if parameters[start] == servo_id:
            error = body.write(address, parameters[start + 1 : start + 1 + length])
    return error


def _bulk_write(body: Body, parameters: bytes) -> int:
    writes, start = [], 0
    while start < len(parameters):
        length = _word(parameters, start + 3)
        data = parameters[start + 5 : start + 5 + length]
        if length == 0 or len(data) < length:
            return ErrorNumber.INSTRUCTION  # and nothing of it is done [i]
        writes.append((parameters[start], _word(parameters, start + 1), data))
        start += 5 + length
    error, own = 0, body.servo_id
    for servo_id, address, data in writes:
        if servo_id == own:
            error = body.write(address, data)
    return error


def _manage(body: TorqueBody, packet: InstructionPacket) -> int:
    """Obey what is not reading or writing; an instruction error for what it does not know."""
    match packet.instruction, packet.parameters:
        case Instruction.REBOOT, b"":
            body.reboot()
            return 0
        case Instruction.FACTORY_RESET, parameters if len(parameters) == 1:
            return _reset(body, parameters[0], packet.servo_id == BROADCAST)
        case Instruction.CLEAR, parameters if parameters == _CLEAR_TURNS:
            return body.clear_turns()
        case Instruction.CONTROL_TABLE_BACKUP, parameters if parameters == _BACK_UP:
            return body.back_up()
        case Instruction.CONTROL_TABLE_BACKUP, parameters if parameters == _RESTORE:
            return body.restore_backup()
    return ErrorNumber.INSTRUCTION


def _reset(body: TorqueBody, option: int, to_all: bool) -> int:
    kept = _KEPT_BY_RESET.get(option)
    if kept is None or (option == 0xFF and to_all):  # e-Manual, Factory Reset: "will NOT be activated"
        return ErrorNumber.INSTRUCTION
    body.memory.restore_factory_values(keep=kept)
    body.reboot()
    return 0


def _word(data: bytes, index: int) -> int:
    return int.from_bytes(data[index : index + 2], "little")
