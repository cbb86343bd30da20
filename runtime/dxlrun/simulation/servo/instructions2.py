"""How a servo of Protocol 2.0 obeys instructions; `[i]` marks what no manual says."""

from __future__ import annotations

from dxlrun.simulation.servo.body import Body
from dxlrun.simulation.servo.torque_body import TorqueBody
from dxlrun.simulation.wire.packets import BROADCAST, GroupRead, InstructionPacket, ReadEntry
from dxlrun.simulation.wire.protocol2 import ErrorNumber, Instruction, ListedWrites, bulk_writes, sync_writes

Answer = tuple[int, bytes]
"""Error and parameters of a reply."""

SLOT_NS = 1_000_000
"""What a servo's slot after a broadcast ping is longer than its reply [i]."""

_PING, _SYNC_WRITE = int(Instruction.PING), int(Instruction.SYNC_WRITE)
_PING_REPLY = 14
_CLEAR_TURNS = bytes.fromhex("01 44 58 4c 22")
_CLEAR_ERROR = bytes.fromhex("02 45 52 43 4c")
_BACK_UP = bytes.fromhex("01 43 54 52 4c")
_RESTORE = bytes.fromhex("02 43 54 52 4c")
_CLEARS_SINCE = 42
"""Firmware of MX (2.0) and X from which on Clear is known, and a reset of everything is not for all."""
_KEPT_BY_RESET = {0xFF: (), 0x01: ("id",), 0x02: ("id", "baud_rate", "baud_rate_bus")}


class Instructions2:
    """The instructions of one servo."""

    def __init__(self, body: TorqueBody) -> None:
        self._body = body
        self._reads = self._reads_fast = False
        """Whether it answers reads in turn, and fast ones: it needs a firmware that knows them."""
        body.memory.watch(("status_return_level", "firmware_version"), self._look)

    def _look(self) -> None:
        memory = self._body.memory
        first = memory.table.fast_sync_read_firmware
        self._reads = memory["status_return_level"] >= 1
        self._reads_fast = first is not None and memory["firmware_version"] >= first

    def answers(self, packet: InstructionPacket, own: bool) -> bool:
        """Return whether a status packet follows (Status Return Level (68)); of broadcasts only to a ping.

        Instructions to the Secondary ID get none, and a packet with a wrong CRC none, unless
        `Body.answers_damaged` asks for the manual's error.
        """
        if not own:
            return packet.servo_id == BROADCAST and packet.intact and packet.instruction == _PING
        if not packet.intact and not self._body.answers_damaged:
            return False
        if packet.intact and packet.instruction == _PING:
            return True
        level = 1 if packet.intact and packet.instruction == Instruction.READ else 2
        return level <= self._body.memory["status_return_level"]

    def delay_ns(self, packet: InstructionPacket, byte_ns: int) -> int:
        """Return how long the servo waits: Return Delay Time, after a broadcast ping also for its slot."""
        delay = self._body.delay_ns
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
        if packet.instruction == _SYNC_WRITE and packet.servo_id == BROADCAST:  # the most frequent by far
            return self._write_listed(sync_writes(parameters)), b""
        match packet.instruction:
            case Instruction.PING:
                memory = self._body.memory
                answer: Answer = 0, memory.data("model_number") + memory.data("firmware_version")
            case Instruction.READ if len(parameters) == 4:
                answer = _read(self._body, _word(parameters, 0), _word(parameters, 2))
            case Instruction.WRITE if len(parameters) >= 3:
                answer = self._write(packet.servo_id, _word(parameters, 0), parameters[2:]), b""
            case Instruction.REG_WRITE if len(parameters) >= 3:
                answer = self._register(packet.servo_id, _word(parameters, 0), parameters[2:]), b""
            case Instruction.ACTION if self._body.has_registered:
                answer = self._body.act(), b""
            case Instruction.BULK_WRITE if packet.servo_id == BROADCAST:
                answer = self._write_listed(bulk_writes(parameters)), b""
            case _:
                answer = _manage(self._body, packet), b""
        return answer

    def reply_to_group_read(self, reading: GroupRead, entry: ReadEntry) -> Answer | None:
        """Return a servo's part of a sync or bulk read; None: it says nothing.

        The form of a fast read has no room for an error without data [i].
        """
        if not self._reads:
            return None
        answer = _read(self._body, entry.address, entry.length)
        if reading.fast and (answer[0] or not self._reads_fast):
            self._body.note(
                f"servo {self._body.servo_id} does not answer the fast read {reading.instruction:#04x}"
            )
            return None
        return answer

    def _write(self, servo_id: int, address: int, data: bytes) -> int:
        """Write what an instruction to an ID brought; through the Secondary ID it cannot reach the EEPROM."""
        if servo_id == self._body.secondary_id and self._body.memory.reaches_eeprom(address, data):
            return ErrorNumber.ACCESS
        return self._body.write(address, data)

    def _register(self, servo_id: int, address: int, data: bytes) -> int:
        if servo_id == self._body.secondary_id and self._body.memory.reaches_eeprom(address, data):
            return ErrorNumber.ACCESS
        return self._body.register(address, data)

    def _write_listed(self, writes: ListedWrites | None) -> int:
        """Do what a list says for this servo, in its order; a listed Secondary ID counts as well [i]."""
        if writes is None:
            return ErrorNumber.INSTRUCTION  # and nothing of it is done [i]
        error, secondary = 0, self._body.secondary_id
        listed = writes.get(self._body.servo_id, ())
        if secondary is not None and secondary in writes:
            listed = sorted((*listed, *writes[secondary]))
        for _, servo_id, address, data in listed:
            error = self._write(servo_id, address, data)
        return error


def _read(body: Body, address: int, length: int) -> Answer:
    """Return data, or an access error where no item is; cells between items are 0 [i]."""
    data = body.read(address, length)
    if data is None or not body.memory.touches(address, length):
        return ErrorNumber.ACCESS, b""
    return 0, data


def _manage(body: TorqueBody, packet: InstructionPacket) -> int:
    """Obey what is not reading or writing; an instruction error for what it does not know.

    To its Secondary ID a servo does nothing of it that would change the EEPROM [i].
    """
    error: int = ErrorNumber.INSTRUCTION
    match packet.instruction, packet.parameters:
        case Instruction.REBOOT, b"":
            body.reboot()
            error = 0
        case Instruction.FACTORY_RESET, parameters if len(parameters) == 1:
            error = _reset(body, parameters[0], packet.servo_id)
        case Instruction.CLEAR, parameters if parameters == _CLEAR_TURNS and _clears(body):
            error = body.clear_turns()
        case Instruction.CLEAR, parameters if parameters == _CLEAR_ERROR and body.has_error_code:
            error = body.clear_error()
        case Instruction.CONTROL_TABLE_BACKUP, parameters if parameters == _BACK_UP and body.keeps_backup:
            error = body.back_up()
        case Instruction.CONTROL_TABLE_BACKUP, parameters if parameters == _RESTORE and body.keeps_backup:
            shadow = packet.servo_id == body.secondary_id
            error = ErrorNumber.ACCESS if shadow else body.restore_backup()
    return error


def _clears(body: TorqueBody) -> bool:
    """Return whether a servo knows Clear: MX (2.0) and X since firmware 42; P and Y [i], not the XL-320."""
    memory = body.memory
    old = memory["firmware_version"] < _CLEARS_SINCE and memory.table.items["torque_enable"].address == 64
    return "operating_mode" in memory and not old


def _reset(body: TorqueBody, option: int, servo_id: int) -> int:
    if servo_id == body.secondary_id:
        return ErrorNumber.ACCESS
    kept = _KEPT_BY_RESET.get(option)
    # e-Manual, Factory Reset: a reset of everything "will NOT be activated" for all
    if kept is None or (option == 0xFF and servo_id == BROADCAST and _clears(body)):
        return ErrorNumber.INSTRUCTION
    body.memory.restore_factory_values(keep=kept)
    body.reboot()
    return 0


def _word(data: bytes, index: int) -> int:
    return int.from_bytes(data[index : index + 2], "little")
