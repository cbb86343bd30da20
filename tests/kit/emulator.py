"""Emulated AX-12A servos on a pseudo-terminal, in a process of its own: not the product's simulation.

    python tests/kit/emulator.py JOURNAL ID...

Prints the path of the terminal, then answers until it is killed. Nothing of dxlrun is imported: packets
(ROBOTIS e-Manual, Protocol 1.0) and registers (e-Manual, AX-12A) are written here once more. The journal
has a JSON line for each instruction and for each write to torque or goal: `t_ns` (CLOCK_MONOTONIC), `what`
("instruction", "torque" or "goal"), `servo` and `value`.
"""

from __future__ import annotations

import json
import os
import pty
import select
import sys
import time
import tty
from contextlib import suppress
from dataclasses import dataclass, field

PING, READ, WRITE, REG_WRITE, ACTION, SYNC_WRITE = 1, 2, 3, 4, 5, 0x83
BROADCAST = 0xFE
TORQUE, GOAL, SPEED, POSITION = 24, 30, 32, 36
BYTE_S = 10 / 1_000_000
"""At 1 Mbit/s."""
RETURN_DELAY_S = 100e-6
SIZE = 50


def registers(servo_id: int) -> bytearray:
    """Return the registers of a fresh servo at 512 ticks."""
    table = bytearray(SIZE)
    for address, size, value in (
        (0, 2, 12),  # model number
        (2, 1, 24),  # firmware
        (3, 1, servo_id),
        (4, 1, 1),  # baud rate
        (5, 1, 50),  # return delay, 2 us
        (8, 2, 1023),  # CCW angle limit
        (11, 1, 70),  # temperature limit
        (12, 1, 60),
        (13, 1, 140),
        (14, 2, 1023),  # maximum torque
        (16, 1, 2),  # status return level
        (17, 1, 36),
        (18, 1, 36),  # shutdown
        (26, 1, 1),  # compliance
        (27, 1, 1),
        (28, 1, 32),
        (29, 1, 32),
        (GOAL, 2, 512),
        (34, 2, 1023),  # torque limit
        (POSITION, 2, 512),
        (42, 1, 120),  # voltage
        (43, 1, 30),  # temperature
        (48, 2, 32),  # punch
    ):
        table[address : address + size] = value.to_bytes(size, "little")
    return table


def checksum(content: bytes) -> int:
    """Return the checksum of a packet's bytes from ID on."""
    return ~sum(content) & 0xFF


@dataclass
class Servos:
    """Servos on one line, and a journal of what they received."""

    journal: int
    tables: dict[int, bytearray]
    delayed: dict[int, tuple[int, bytes]] = field(default_factory=dict)
    """Address and data of each REG_WRITE."""

    def note(self, what: str, servo: int, value: int) -> None:
        """Append a line to the journal."""
        line = {"t_ns": time.monotonic_ns(), "what": what, "servo": servo, "value": value}
        os.write(self.journal, json.dumps(line).encode() + b"\n")

    def write(self, servo: int, address: int, data: bytes) -> None:
        """Write registers. A goal switches torque on, as it does on an AX-12A; the shaft is there at once."""
        table = self.tables[servo]
        table[address : address + len(data)] = data
        if address <= TORQUE < address + len(data):
            self.note("torque", servo, table[TORQUE])
        if address <= GOAL < address + len(data):
            self.note("goal", servo, int.from_bytes(table[GOAL : GOAL + 2], "little"))
            if not table[TORQUE]:
                table[TORQUE] = 1
                self.note("torque", servo, 1)
        if table[TORQUE]:
            table[POSITION : POSITION + 2] = table[GOAL : GOAL + 2]

    def execute(self, servo: int, instruction: int, parameters: bytes) -> bytes:
        """Execute an instruction; return the status packet that answers it, or nothing."""
        self.note("instruction", servo, instruction)
        if instruction == SYNC_WRITE and len(parameters) >= 2:
            address, size = parameters[0], parameters[1]
            for at in range(2, len(parameters) - size, size + 1):
                if parameters[at] in self.tables:
                    self.write(parameters[at], address, parameters[at + 1 : at + 1 + size])
            return b""
        for one in self.tables if servo == BROADCAST else (servo,):
            if instruction == WRITE:
                self.write(one, parameters[0], parameters[1:])
            elif instruction == REG_WRITE:
                self.delayed[one] = (parameters[0], parameters[1:])
            elif instruction == ACTION and one in self.delayed:
                self.write(one, *self.delayed.pop(one))
        if servo == BROADCAST:
            return b""
        data = b""
        if instruction == READ:
            data = bytes(self.tables[servo][parameters[0] : parameters[0] + parameters[1]])
        content = bytes((servo, len(data) + 2, 0)) + data
        return b"\xff\xff" + content + bytes((checksum(content),))

    def take(self, pending: bytes, reply: object) -> bytes:
        """Execute each whole instruction packet; return the bytes that are not one yet."""
        while (start := pending.find(b"\xff\xff")) >= 0 and len(pending) >= start + 6:
            servo, length = pending[start + 2], pending[start + 3]
            end = start + 4 + length
            if servo == 0xFF or length < 2:
                pending = pending[start + 1 :]
                continue
            if len(pending) < end:
                return pending[start:]
            packet, pending = pending[start:end], pending[end:]
            if checksum(packet[2:-1]) != packet[-1]:
                continue
            if servo in self.tables or servo == BROADCAST:
                status = self.execute(servo, packet[4], packet[5:-1])
                if status:
                    reply(len(packet), status)  # type: ignore[operator]
        return pending


def main() -> None:
    """Serve the terminal."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    with suppress(OSError):  # a servo's electronics do not wait for the host's processor
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(60))
    journal = os.open(sys.argv[1], os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    print(os.ttyname(slave), flush=True)
    os.close(slave)  # whoever opens it later is the only one
    servos = Servos(journal, {int(one): registers(int(one)) for one in sys.argv[2:]})

    def reply(heard: int, status: bytes) -> None:
        time.sleep((heard + len(status)) * BYTE_S + RETURN_DELAY_S)
        os.write(master, status)

    pending = b""
    while True:
        select.select([master], [], [])
        try:
            pending = servos.take(pending + os.read(master, 4096), reply)
        except OSError:  # nobody has the terminal open
            pending = b""
            time.sleep(0.005)


if __name__ == "__main__":
    main()
