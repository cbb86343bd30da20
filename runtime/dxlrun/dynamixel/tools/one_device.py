"""One device on a tool's line: its items are read, and written with a look at what came of it."""

from __future__ import annotations

from collections.abc import Sequence

from dxlrun.dynamixel.tools.scanning import FoundServo
from dxlrun.dynamixel.tools.tool_line import ToolLine
from dxlrun.errors import ServoFault
from dxlwire.control_table.device_table import DeviceTable
from dxlwire.control_table.devices import device_table
from dxlwire.control_table.table import ControlItem
from dxlwire.plan.line import MOST_SPARE
from dxlwire.plan.retry import ATTEMPTS, extend_timeouts, retry
from dxlwire.transaction import Outcome, Program, Result, Transaction


class OneDevice:
    """The device that a tool works on; blocks, and raises ServoFault or PortError."""

    def __init__(self, tool: ToolLine, found: FoundServo) -> None:
        self.tool = tool
        self.found = found
        self.table: DeviceTable = device_table(found.model, found.protocol)
        self.servo_id, self.baud_rate = found.servo_id, found.baud_rate

    @property
    def called(self) -> str:
        """How messages call it."""
        return f"{self.table.model}, ID {self.servo_id} at {self.baud_rate} bit/s"

    def fail(self, text: str) -> ServoFault:
        """Return an error about this device."""
        return ServoFault(f"{self.called}: {text}")

    def read(self, names: Sequence[str], *, refused: bool = False) -> dict[str, int]:
        """Return items by name: integers of the wire, signed where the item is, 0 or 1 of a bit.

        `refused`: what its firmware does not have is left out; without, that is an error.
        """
        found: dict[str, int] = {}
        for name in names:
            found |= self._run(self._read(self.table.items[name], refused=refused))
        return found

    def write(self, item: ControlItem, value: int) -> str:
        """Write an item that can be written, and read it back; return what was done, if anything."""
        before = self.read([item.name])[item.name]
        if before == value:
            return f"{item.title} is {value} already"
        self._run(self._write(item, value))
        return f"{item.title} was {before} and is {value}"

    def _run(self, program: Program[Result]) -> Result:
        return self.tool.run(extend_timeouts(program))

    def _reading(self, item: ControlItem) -> Transaction:
        spare = self.table.spare(item.address + item.size, MOST_SPARE)
        return self.tool.line.read(self.servo_id, item.address, item.size, spare)

    def _read(self, item: ControlItem, *, refused: bool) -> Program[dict[str, int]]:
        reply = yield from retry(self._reading(item))
        if reply.answered:
            raw = item.decode(reply.parameters)
            return {item.name: raw if item.bit is None else raw >> item.bit & 1}
        if reply.outcome is not Outcome.REFUSED:
            raise self.fail(f"did not answer when {item.title} was read")
        if refused:
            return {}
        raise self.fail(f"refuses to read {item.title}: {self.tool.line.dialect.describe_error(reply.error)}")

    def _write(self, item: ControlItem, value: int) -> Program[bool]:
        found: int | None = None
        for _ in range(ATTEMPTS):
            written = yield self.tool.line.write(self.servo_id, item.address, item.encode(value))
            if written.outcome is Outcome.REFUSED:
                why = self.tool.line.dialect.describe_error(written.error)
                raise self.fail(f"refuses {item.title} = {value}: {why}")
            found = (yield from self._read(item, refused=False))[item.name]
            if found == value:
                return True
        raise self.fail(f"was given {item.title} = {value}, but has {found}")
