"""Emulated AX-12A servos on a pseudo-terminal, in a process of its own: not the product's simulation.

    python tests/kit/emulator.py JOURNAL ID...

Prints the path of the terminal, then answers until it is killed. Nothing of dxlrun is imported: packets
(ROBOTIS e-Manual, Protocol 1.0) and registers (e-Manual, AX-12A) are written here once more. The journal
has a JSON line for each instruction and for each write to torque or goal: `t_ns` (CLOCK_MONOTONIC), `what`
("instruction", "torque" or "goal"), `servo` and `value`.
"""

import json
import os
import pty
import select
import sys
import time
import tty
from contextlib import suppress
from dataclasses import dataclass, field

READ, WRITE, REG_WRITE, ACTION, SYNC_WRITE = 2, 3, 4, 5, 0x83
BROADCAST = 0xFE
TORQUE, GOAL, POSITION, SIZE = 24, 30, 36, 50
BYTE_S, RETURN_DELAY_S = 10 / 1_000_000, 100e-6
"""At 1 Mbit/s."""
FRESH = bytes.fromhex(
    "0c00 18 00 01 32 0000 ff03 00 46 3c 8c ff03 02 24 24 0000000000"  # model number to shutdown
    "00 00 01 01 20 20 0002 0000 ff03 0002 0000 0000 78 1e 0000 0000 2000"  # torque enable to punch
)
"""Registers of a servo at 512 ticks; its ID is at 3."""


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
        table, written = self.tables[servo], range(address, address + len(data))
        table[address : address + len(data)] = data
        if TORQUE in written:
            self.note("torque", servo, table[TORQUE])
        if GOAL in written:
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
        return b"\xff\xff" + content + bytes((~sum(content) & 0xFF,))

    def serve(self, pending: bytes, terminal: int) -> bytes:
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
            if ~sum(packet[2:-1]) & 0xFF != packet[-1] or servo not in {*self.tables, BROADCAST}:
                continue
            if status := self.execute(servo, packet[4], packet[5:-1]):
                time.sleep((len(packet) + len(status)) * BYTE_S + RETURN_DELAY_S)
                os.write(terminal, status)
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
    tables = {int(one): bytearray(FRESH[:3] + bytes((int(one),)) + FRESH[4:]) for one in sys.argv[2:]}
    servos, pending = Servos(journal, tables), b""
    while True:
        select.select([master], [], [])
        try:
            pending = servos.serve(pending + os.read(master, 4096), master)
        except OSError:  # nobody has the terminal open
            pending = b""
            time.sleep(0.005)


if __name__ == "__main__":
    main()
