"""One servo or device on a tool's line: its items are read, and written with a look at what came of it.

What every run does is done by the same programs as there: registers are compared, only differences written
and read back.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import ClassVar, TypeAlias

from dxlrun.dynamixel.findings import Findings
from dxlrun.dynamixel.servo.access import LONGEST_READ, ItemAccess
from dxlrun.dynamixel.servo.registers import settle, shown
from dxlrun.dynamixel.tools.scanning import FoundServo
from dxlrun.dynamixel.tools.tool_line import ToolLine
from dxlrun.errors import ServoFault
from dxlwire.bus_plan import RegisterValue
from dxlwire.control_table import ControlItem, FoundDeviation, Table, side_by_side
from dxlwire.control_table.devices import device_table
from dxlwire.plan.line import Line
from dxlwire.plan.retry import extend_timeouts
from dxlwire.transaction import Outcome, Program, Result

Confirm: TypeAlias = Callable[[str], bool]
"""Asks whether a change is wanted, before it is made."""


def agree(question: str) -> bool:
    """Answer yes."""
    return True


class OneNode:
    """The servo or device that a tool works on; blocks, and raises ServoFault or PortError."""

    NOT_SET: ClassVar[Mapping[str, str]] = MappingProxyType({})
    """Why an item is not set like others, and what to do instead, by its name."""

    def __init__(self, tool: ToolLine, found: FoundServo, table: Table) -> None:
        self.tool = tool
        self.found = found
        self.table = table
        self.servo_id, self.baud_rate = found.servo_id, found.baud_rate

    @property
    def called(self) -> str:
        """How messages call it."""
        return f"{self.table.model}, ID {self.servo_id} at {self.baud_rate} bit/s"

    @property
    def command(self) -> str:
        """How a command line to it begins."""
        return f"dxlrun servo {self.tool.port.name} {self.servo_id}"

    @property
    def access(self) -> ItemAccess:
        """Its items, as programs reach them."""
        raise NotImplementedError

    def fail(self, text: str) -> ServoFault:
        """Return an error about it."""
        return ServoFault(f"{self.called}: {text}")

    def run(self, program: Program[Result]) -> Result:
        """Run a program with longer timeouts: it has answered before."""
        return self.tool.run(extend_timeouts(program))

    def register(self, name: str, value: int) -> RegisterValue:
        """Return an item with what it shall hold, the integer of the wire."""
        item = self.table.items[name]
        return RegisterValue(item.address, item.size, value, name, item.area == "EEPROM")

    def read(self, names: Sequence[str], *, refused: bool = False) -> Mapping[str, int]:
        """Return items by name: integers of the wire, signed where the item is, 0 or 1 of a bit.

        `refused`: what its firmware does not have is left out; without, that is an error.
        """
        found: dict[str, int] = {}
        for block in side_by_side((self.table.items[name] for name in names), LONGEST_READ):
            found |= self.run(self._read_block(block, refused=refused))
        return {name: found[name] for name in names if name in found}

    def deviations(self, values: Mapping[str, int]) -> tuple[FoundDeviation, ...]:
        """Return which of some values are not the factory's and matter to a run."""
        return ()

    def writable(self, desired: Sequence[RegisterValue]) -> None:
        """Make sure that registers can be written; raises ServoFault where the EEPROM is closed."""
        stored = [self.table.items[one.name].title for one in desired if one.eeprom]
        release = f"switch the torque off first: {self.command} torque off"
        if stored and (problem := self.run(self.access.closed_eeprom(stored[0], release=release))):
            raise self.fail(problem)

    def write(self, desired: Sequence[RegisterValue]) -> tuple[str, ...]:
        """Write the registers that differ, in order, and read each back; return what was written."""
        self.writable(desired)
        return self._settle(desired)

    def set_register(self, target: RegisterValue, confirm: Confirm = agree) -> tuple[str, ...]:
        """Write one item, into the EEPROM if that is confirmed; return what was done."""
        item = self.table.items[target.name]
        before = self.read([target.name])[target.name]
        if before == target.value:
            # a goal that is there already is not pursued while its Bus Watchdog is tripped
            done = () if target.eeprom else self.write([target])
            return (f"{item.title} is {target.value} already", *done)
        if target.eeprom:
            self.writable([target])
            change = f"{item.title} is {shown(item, before)} and becomes {target.value}"
            if not confirm(f"{self.called}: {change} (EEPROM)"):
                return ()
        return self.write([target])

    def _settle(self, desired: Sequence[RegisterValue]) -> tuple[str, ...]:
        found = Findings()
        self.run(settle(self.access, desired, found))
        written = [text for _, _, _, text in found.events]
        if found.problems:
            before = [f"written before that: {text}" for text in written]
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
            elif reply.outcome is not Outcome.REFUSED:
                raise self.fail(f"did not answer when {item.title} was read")
            elif not refused:
                raise self.fail(f"refuses to read {item.title}{self.access.reason(reply)}")
        return found


class DeviceAccess(ItemAccess):
    """A device as programs reach it."""

    __slots__ = ("_called", "_table")

    def __init__(self, line: Line, one: OneNode) -> None:
        super().__init__(line, one.servo_id, one.table.model)
        self._called, self._table = one.called, one.table

    def __str__(self) -> str:
        return f"{self._called}:"

    @property
    def table(self) -> Table:
        """Its control table."""
        return self._table


class OneDevice(OneNode):
    """A device that is not a servo, such as an IMU or a power board."""

    NOT_SET = MappingProxyType(
        {
            name: f"{name} of a device is not set by dxlrun; use the maker's tool"
            for name in ("id", "baud_rate")
        }
    )

    def __init__(self, tool: ToolLine, found: FoundServo) -> None:
        super().__init__(tool, found, device_table(found.model, found.protocol))

    @property
    def access(self) -> ItemAccess:
        """Its items, as programs reach them."""
        return DeviceAccess(self.tool.line, self)
