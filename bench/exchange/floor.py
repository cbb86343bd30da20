"""Floor: the bytes of an exchange without any work, which shows the share of line and responder."""

from __future__ import annotations

import os
import tty

from dxlrun.plan.robot_plan import Plan
from dxlrun_lab.late_servos import Sent
from dxlwire.wire import protocol1, protocol2
from exchange.case import Case, Registers


class Floor:
    """Writes prepared instructions, waits in read() for as many bytes as answer them, and looks at none."""

    def __init__(self, path: str, case: Case, plan: Plan) -> None:
        self._descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self._descriptor)
        registers = Registers.of(plan)
        self._reads = _reads(case, registers)
        self._writes = [_write(case, registers, tick) for tick in registers.ticks]
        self._turn = 0

    def start(self) -> None:
        """Nothing is needed."""

    def exchange(self) -> bool:
        """Write and read; the two goals take turns."""
        descriptor = self._descriptor
        for instruction, size in self._reads:
            os.write(descriptor, instruction)
            left = size
            while left > 0:
                left -= len(os.read(descriptor, left))
        self._turn = 1 - self._turn
        os.write(descriptor, self._writes[self._turn])
        return True

    def recover(self) -> None:
        """Nothing is checked, so nothing can be lost."""

    def sent(self) -> Sent:
        """Nothing is known."""
        return ()

    def close(self) -> None:
        """Close the line."""
        os.close(self._descriptor)


def _reads(case: Case, registers: Registers) -> list[tuple[bytes, int]]:
    """Return the reads that our plan has for these servos, and the length of the answer to each."""
    address, length = registers.read_address, registers.read_length
    if case.protocol == protocol2.PROTOCOL and case.servos > 1:
        together = protocol2.sync_read(address, length, case.ids, fast=True)
        return [(together, protocol2.fast_size(length * case.servos, case.servos))]
    wire = protocol1 if case.protocol == protocol1.PROTOCOL else protocol2
    size = len(wire.status_packet(1, 0, bytes(length)))
    return [(wire.read_range(each, address, length), size) for each in case.ids]


def _write(case: Case, registers: Registers, tick: int) -> bytes:
    offset, size = registers.goal
    goal = bytearray(registers.write_length)
    goal[offset : offset + size] = tick.to_bytes(size, "little")
    write = protocol1.sync_write if case.protocol == protocol1.PROTOCOL else protocol2.sync_write
    return write(registers.write_address, len(goal), dict.fromkeys(case.ids, bytes(goal)))
