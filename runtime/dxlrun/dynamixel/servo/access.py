"""Access: one servo on its line, whose control items programs read and write by name."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import NamedTuple

from dxlrun.dynamixel.control_table import ControlItem, ControlTable, control_table, decoded, side_by_side
from dxlrun.dynamixel.plan.line import MOST_SPARE, Line
from dxlrun.dynamixel.plan.planning import plan_line
from dxlrun.dynamixel.plan.retry import limit_patience, retry, setup_line
from dxlrun.plan.bus_plan import BusPlan, ServoPlan
from dxlrun.plan.transaction import Outcome, Program, Reply, Transaction


class Access(NamedTuple):
    """One servo as programs reach it; as text it is what messages call it."""

    plan: BusPlan
    servo: ServoPlan
    line: Line
    """How long its replies may take: `reach` has the plan's, `first_reach` the longest."""

    def __str__(self) -> str:
        return self.plan.label(self.servo)

    @property
    def table(self) -> ControlTable:
        """Its control table."""
        return control_table(self.servo.model, self.plan.protocol)

    @property
    def items(self) -> Mapping[str, ControlItem]:
        """Its control items, by name."""
        return self.table.items

    def reading(self, address: int, size: int) -> Transaction:
        """Return the read of some bytes."""
        spare = _spare(self.servo.model, self.plan.protocol, address + size)
        return self.line.read(self.servo.servo_id, address, size, spare)

    def writing(self, address: int, data: bytes) -> Transaction:
        """Return the write of some bytes."""
        return self.line.write(self.servo.servo_id, address, data)

    def read_bytes(self, address: int, size: int) -> Program[Reply]:
        """Read bytes, up to three times."""
        return retry(self.reading(address, size))

    def write_bytes(self, address: int, data: bytes) -> Program[Reply]:
        """Write bytes, up to three times."""
        return retry(self.writing(address, data))

    def read_one(self, name: str) -> Program[int | None]:
        """Read an item; None when it does not come, or the model has none of that name."""
        item = self.items.get(name)
        if item is None:
            return None
        reply = yield from self.read_bytes(item.address, item.size)
        return item.decode(reply.parameters) if reply.answered else None

    def read(self, names: Iterable[str]) -> Program[dict[str, int] | None]:
        """Read items, those side by side at once; None when one of them does not come."""
        found = dict[str, int]()
        for block in side_by_side(self.items[name] for name in names):
            start, end = block[0].address, block[-1].address + block[-1].size
            reply = yield from self.read_bytes(start, end - start)
            if not reply.answered:
                return None
            found |= decoded(block, start, reply.parameters)
        return found

    def write(self, name: str, value: int) -> Program[str]:
        """Write an item and read it back; return what went wrong, behind the servo's name, or nothing."""
        item = self.items[name]
        reply = yield from self.write_bytes(item.address, item.encode(value))
        if reply.outcome is Outcome.REFUSED:
            return f"refuses {item.title} = {value}{self.reason(reply)}"
        back = yield from self.read_bytes(item.address, item.size)
        if not back.answered:
            return f"did not answer when {item.title} was read back"
        found = item.decode(back.parameters)
        return "" if found == value else f"was given {item.title} = {value}, but has {found}"

    def read_torque(self) -> Program[Reply]:
        """Read torque enable."""
        return self.read_bytes(self.servo.torque_address, 1)

    def torque_off(self) -> Program[Reply]:
        """Write torque enable = 0."""
        return limit_patience(self.write_bytes(self.servo.torque_address, b"\0"))

    def reason(self, reply: Reply) -> str:
        """Return why the servo refused, behind a colon; nothing where it did not."""
        return (
            f": {self.line.dialect.describe_error(reply.error)}" if reply.outcome is Outcome.REFUSED else ""
        )


@lru_cache
def _spare(model: str, protocol: float, end: int) -> int:
    return control_table(model, protocol).spare(end, MOST_SPARE)


def reach(plan: BusPlan, servo: ServoPlan) -> Access:
    """Return the access to a servo whose return delay is as planned."""
    return Access(plan, servo, plan_line(plan))


def first_reach(plan: BusPlan, servo: ServoPlan) -> Access:
    """Return the access to a servo before its return delay is known."""
    return Access(plan, servo, setup_line(plan))
