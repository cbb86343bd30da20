"""Base of the tools for one servo or device on a port: reads and writes its items.

The programs are those of a run: registers are compared, only differences are written, and each is read back.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import ClassVar, TypeAlias

from dxlrun.dynamixel.findings import Findings
from dxlrun.dynamixel.servo.item_access import LONGEST_READ, ItemAccess
from dxlrun.dynamixel.servo.registers import format_item, write_registers
from dxlrun.dynamixel.tools.scanning import FoundServo
from dxlrun.dynamixel.tools.tool_line import ToolLine
from dxlrun.errors import ServoFault
from dxlwire.bus_plan import RegisterValue
from dxlwire.control_table import BaseControlTable, ControlItem, FoundDeviation, side_by_side
from dxlwire.control_table.device_models import device_table
from dxlwire.plan.line import Line
from dxlwire.plan.retry import extend_timeouts
from dxlwire.transaction import Program, Result, TransactionOutcome

Confirm: TypeAlias = Callable[[str], bool]
"""Asks the user the question in its argument before a change; returns True if the change may be made."""


def agree(question: str) -> bool:
    """Default of `Confirm`: return True without asking."""
    return True


class OneNode:
    """The servo or device that a tool works on. Its methods block; they raise ServoFault for a problem of the
    node, PortError for a lost line.
    """

    NOT_SET: ClassVar[Mapping[str, str]] = MappingProxyType({})
    """Items that a tool must not set as plain registers, by name, with the reason and the alternative."""

    def __init__(self, tool: ToolLine, found: FoundServo, table: BaseControlTable) -> None:
        self.tool = tool
        self.found = found
        self.table = table
        self.servo_id, self.baud_rate = found.servo_id, found.baud_rate

    @property
    def called(self) -> str:
        """Name of the node in messages: model, ID and rate."""
        return f"{self.table.model}, ID {self.servo_id} at {self.baud_rate} bit/s"

    @property
    def command(self) -> str:
        """Start of the `dxlrun servo` command line for the node, with port and ID."""
        return f"dxlrun servo {self.tool.port.name} {self.servo_id}"

    @property
    def access(self) -> ItemAccess:
        """Access to the node's items on the tool's line."""
        raise NotImplementedError

    def make_fault(self, text: str) -> ServoFault:
        """Return an error whose text starts with the node's name; the caller raises it."""
        return ServoFault(f"{self.called}: {text}")

    def run_program(self, program: Program[Result]) -> Result:
        """Run a program on the tool's line and return its result, with longer timeouts than a scan: the node
        has answered before.
        """
        return self.tool.run_program(extend_timeouts(program))

    def register(self, name: str, value: int) -> RegisterValue:
        """Return a register for `write_registers`: the item's address and size with a desired value, the
        integer on the wire.
        """
        item = self.table.items[name]
        return RegisterValue(item.address, item.size, value, name, item.area == "EEPROM")

    def read_items(self, names: Sequence[str], *, refused: bool = False) -> Mapping[str, int]:
        """Read items and return their values by name: integers on the wire, signed if the item is, 0 or 1 for
        a bit.

        Args:
            names: The items to read.
            refused: True: omit items that the firmware does not have. False: they are an error.
        """
        found: dict[str, int] = {}
        for block in side_by_side((self.table.items[name] for name in names), LONGEST_READ):
            found |= self.run_program(self._read_block(block, refused=refused))
        return {name: found[name] for name in names if name in found}

    def deviations(self, values: Mapping[str, int]) -> tuple[FoundDeviation, ...]:
        """Return the given values that differ from the factory's and matter to a run; none for a device."""
        return ()

    def writable(self, desired: Sequence[RegisterValue]) -> None:
        """Raise ServoFault, before anything is written, if one of the registers is in a closed EEPROM."""
        stored = [self.table.items[one.name].title for one in desired if one.eeprom]
        release = f"switch the torque off first: {self.command} torque off"
        if stored and (problem := self.run_program(self.access.closed_eeprom(stored[0], release=release))):
            raise self.make_fault(problem)

    def write_registers(self, desired: Sequence[RegisterValue]) -> tuple[str, ...]:
        """Write the registers that differ from their desired values, in the given order, and read each back;
        return a text for each write.
        """
        self.writable(desired)
        return self._settle(desired)

    def set_register(self, target: RegisterValue, confirm: Confirm = agree) -> tuple[str, ...]:
        """Write one item, an EEPROM item only after confirmation; return a text for each action, none if it
        was not confirmed.
        """
        item = self.table.items[target.name]
        before = self.read_items([target.name])[target.name]
        if before == target.value:
            # A servo ignores the goal that it already has while its Bus Watchdog is tripped: write it again.
            done = () if target.eeprom else self.write_registers([target])
            return (f"{item.title} is {target.value} already", *done)
        if target.eeprom:
            self.writable([target])
            change = f"{item.title} changes from {format_item(item, before)} to {target.value}"
            if not confirm(f"{self.called}: {change} (EEPROM)"):
                return ()
        return self.write_registers([target])

    def _settle(self, desired: Sequence[RegisterValue]) -> tuple[str, ...]:
        found = Findings()
        self.run_program(write_registers(self.access, desired, found))
        written = [event.text for _, event in found.events]
        if found.problems:
            before = [f"already written: {text}" for text in written]
            raise ServoFault("\n".join([*found.problems, *before]))
        return tuple(written)

    def _read_block(self, block: Sequence[ControlItem], *, refused: bool) -> Program[dict[str, int]]:
        start, end = block[0].address, block[-1].address + block[-1].size
        reply = yield from self.access.read_bytes(start, end - start)
        if reply.answered:
            places = ((item, item.address - start) for item in block)
            return {item.name: item.integer(reply.parameters[at : at + item.size]) for item, at in places}
        found: dict[str, int] = {}
        for item in block:
            reply = yield from self.access.read_bytes(item.address, item.size)
            if reply.answered:
                found[item.name] = item.integer(reply.parameters)
            elif reply.outcome is not TransactionOutcome.REFUSED:
                raise self.make_fault(f"did not answer when {item.title} was read")
            elif not refused:
                raise self.make_fault(f"rejects a read of {item.title}{self.access.reason(reply)}")
        return found


class DeviceAccess(ItemAccess):
    """Access to the items of a device that is not a servo."""

    __slots__ = ("_called", "_table")

    def __init__(self, line: Line, one: OneNode) -> None:
        super().__init__(line, one.servo_id, one.table.model)
        self._called, self._table = one.called, one.table

    def __str__(self) -> str:
        return f"{self._called}:"

    @property
    def table(self) -> BaseControlTable:
        """Control table of the device's model."""
        return self._table


class OneDevice(OneNode):
    """A device that is not a servo, such as an IMU or a power board, on a tool's line."""

    NOT_SET = MappingProxyType(
        {
            name: f"dxlrun does not set {name} of a device; use the manufacturer's tool"
            for name in ("id", "baud_rate")
        }
    )

    def __init__(self, tool: ToolLine, found: FoundServo) -> None:
        super().__init__(tool, found, device_table(found.model, found.protocol))

    @property
    def access(self) -> ItemAccess:
        """Access to the items of the device."""
        return DeviceAccess(self.tool.line, self)
