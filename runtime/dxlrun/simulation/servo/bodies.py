"""Which body and which instructions a model has: by its protocol, and by its control items."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from dxlrun.dynamixel.control_table import ControlTable
from dxlrun.simulation.configuration import Load
from dxlrun.simulation.memory.cells import Memory
from dxlrun.simulation.motion.joint_shaft import JointShaft
from dxlrun.simulation.motion.mechanics import Mechanics
from dxlrun.simulation.motion.mode_shaft import ModeShaft
from dxlrun.simulation.motion.shaft import Shaft
from dxlrun.simulation.servo import instructions1, instructions2
from dxlrun.simulation.servo.body import Body
from dxlrun.simulation.servo.lock_body import LockBody
from dxlrun.simulation.servo.torque_body import TorqueBody
from dxlrun.simulation.wire.packets import GroupRead, InstructionPacket, ReadEntry

FIRMWARE = {1.0: 24, 2.0: 45}
"""Firmware version of a simulated servo where its table asks for nothing newer; the manual gives none."""


class Instructions(Protocol):
    """A protocol's instructions for one servo."""

    def answers(self, packet: InstructionPacket, own: bool) -> bool:
        """Return whether a status packet follows."""

    def delay_ns(self, packet: InstructionPacket, byte_ns: int) -> int:
        """Return how long the servo waits before it answers, ns; `byte_ns` is the time of a byte."""

    def describe(self, error: int) -> str:
        """Return an error in words."""

    def obey(self, packet: InstructionPacket) -> tuple[int, bytes]:
        """Return error and parameters of the reply."""

    def reply_to_group_read(self, reading: GroupRead, entry: ReadEntry) -> tuple[int, bytes] | None:
        """Return the servo's part of the answer; None: it says nothing."""


def make_body(
    table: ControlTable,
    mechanics: Mechanics,
    load: Load,
    angle: float,
    note: Callable[[str], None],
    *,
    firmware: int | None = None,
) -> tuple[Body, Instructions]:
    """Return a servo that is not switched on yet, its shaft at `angle` (rad from raw 0)."""
    if firmware is None:
        firmware = max(FIRMWARE[table.protocol], table.firmware, table.fast_sync_read_firmware or 0)
    memory = Memory(table, firmware)
    shaft: Shaft
    if "operating_mode" in table.items:
        shaft = ModeShaft(memory, mechanics, load, angle)
    else:
        shaft = JointShaft(memory, mechanics, load, angle)
    if table.protocol == 1.0:
        lock_body = LockBody(memory, shaft, note)
        return lock_body, instructions1.Instructions1(lock_body)
    torque_body = TorqueBody(memory, shaft, note)
    return torque_body, instructions2.Instructions2(torque_body)
