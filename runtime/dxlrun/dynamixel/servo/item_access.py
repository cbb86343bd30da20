"""Access: reads and writes control items of one servo or device by name."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from functools import lru_cache

from dxlwire.bus_plan import BusPlan, ServoPlan
from dxlwire.control_table import (
    BaseControlTable,
    ControlItem,
    ControlTable,
    decoded,
    find_table,
    side_by_side,
)
from dxlwire.plan.line import MOST_SPARE, Line
from dxlwire.plan.planning import plan_line
from dxlwire.plan.retry import ATTEMPTS, limit_patience, retry, setup_line
from dxlwire.transaction import Program, Reply, Transaction, TransactionOutcome

NEAR = 16
"""Gap in bytes between two items up to which one read that covers both is faster than two reads."""
LONGEST_READ = 64  # bytes; a longer reply would not fit between two cycles


class ItemAccess:
    """One servo or device on a line; its methods make transactions and programs for its items. `str` gives
    its name for messages.
    """

    __slots__ = ("line", "name", "servo_id")

    def __init__(self, line: Line, servo_id: int, name: str) -> None:
        """Store the line and the ID.

        Args:
            line: Makes the transactions and decides their timeouts.
            servo_id: ID on the line.
            name: Source of its events.
        """
        self.line = line
        self.servo_id = servo_id
        self.name = name

    @property
    def table(self) -> BaseControlTable:
        """Control table of the servo's or device's model."""
        raise NotImplementedError

    @property
    def items(self) -> Mapping[str, ControlItem]:
        """Control items of the servo or device, by name."""
        return self.table.items

    def spare(self, end: int) -> int:
        """Return the number of readable bytes from an address on, at most MOST_SPARE."""
        return self.table.spare(end, MOST_SPARE)

    def reading(self, address: int, size: int) -> Transaction:
        """Return a transaction that reads `size` bytes from an address, without sending it."""
        return self.line.read_range(self.servo_id, address, size, self.spare(address + size))

    def writing(self, address: int, data: bytes) -> Transaction:
        """Return a transaction that writes bytes at an address, without sending it."""
        return self.line.write_range(self.servo_id, address, data)

    def read_bytes(self, address: int, size: int) -> Program[Reply]:
        """Read `size` bytes from an address, with up to three attempts; return the last reply."""
        return retry(self.reading(address, size))

    def write_bytes(self, address: int, data: bytes) -> Program[Reply]:
        """Write bytes at an address, with up to three attempts; return the last reply."""
        return retry(self.writing(address, data))

    def read_one(self, name: str) -> Program[int | None]:
        """Read one item, decoded; return None without a reply, or if the model does not have the item."""
        item = self.items.get(name)
        if item is None:
            return None
        reply = yield from self.read_bytes(item.address, item.size)
        return item.decode(reply.parameters) if reply.answered else None

    def read_items(self, names: Iterable[str]) -> Program[dict[str, int] | None]:
        """Read items, adjacent ones with one read; return their values by name, or None if one reply is
        missing.
        """
        found = dict[str, int]()
        for block in side_by_side(self.items[name] for name in names):
            start, end = block[0].address, block[-1].address + block[-1].size
            reply = yield from self.read_bytes(start, end - start)
            if not reply.answered:
                return None
            found |= decoded(block, start, reply.parameters)
        return found

    def read_near(
        self, names: Iterable[str], optional: Collection[str] = ()
    ) -> Program[tuple[dict[str, int], Reply]]:
        """Read items with few reads: one read also covers the gap between items at most NEAR bytes apart.

        A read that the servo refuses is split at once, down to single items.

        Args:
            names: The items to read.
            optional: Items that the servo may refuse.

        Returns:
            The values by item, and the last reply. If that reply is not answered, the values are incomplete.
        """
        found, reply = dict[str, int](), Reply(TransactionOutcome.OK, 0, b"", 0, 0, False)
        left = _near(self.items[name] for name in names)
        while left:
            block = left.pop(0)
            start, end = block[0].address, block[-1].address + block[-1].size
            last = yield from self.read_bytes(start, end - start)
            if last.answered:
                found |= decoded(block, start, last.parameters)
            elif last.outcome is TransactionOutcome.REFUSED and len(block) > 1:
                # First without the gaps, which the servo may refuse; then item by item.
                blocks = [list(each) for each in side_by_side(block)]
                left[:0] = blocks if len(blocks) > 1 else [[item] for item in block]
                continue
            elif last.outcome is TransactionOutcome.REFUSED and block[0].name in optional:
                continue
            reply = last
            if not reply.answered:
                break
        return found, reply

    def write_item(self, name: str, value: int) -> Program[str]:
        """Write an item, as the integer on the wire, and read it back.

        The read-back decides about success and about another attempt. An acknowledgement may be lost, or
        switched off by Status Return Level, and EEPROM wears.

        Returns:
            The problem, without the servo's name at the start; empty on success.
        """
        item, problem = self.items[name], ""
        for _ in range(ATTEMPTS):
            written = yield self.writing(item.address, item.wire_bytes(value))
            if written.outcome is TransactionOutcome.REFUSED:
                problem = f"refuses {item.title} = {value}{self.reason(written)}"
                break
            back = yield from self.read_bytes(item.address, item.size)
            if not back.answered:
                problem = f"did not answer when {item.title} was read back"
                continue
            found = item.integer(back.parameters[: item.size])
            if found == value:
                return ""
            problem = f"has {item.title} = {found} after {value} was written"
        return (yield from self._explain(item, value, problem))

    def _explain(self, item: ControlItem, value: int, problem: str) -> Program[str]:
        """Find the cause of a failed write and return it as the problem: closed EEPROM, or the item that
        limits this one; otherwise return `problem`.
        """
        if item.area == "EEPROM":
            closed = yield from self.closed_eeprom(f"{item.title} = {value}", unread=problem)
            return closed or problem
        bound = yield from self.read_bound(item.name)
        if bound is None or abs(value) <= bound:
            return problem
        title = self.items[item.limited_by].title
        return f"{problem}; raise its {title} from {bound} to {abs(value)} or more"

    def read_bound(self, name: str) -> Program[int | None]:
        """Read the item that limits another item, such as PWM Limit for Goal PWM; None: no limit is known."""
        return (yield from self.read_one(self.items[name].limited_by))

    def closed_eeprom(self, names: str, *, release: str = "", unread: str = "") -> Program[str]:
        """Return why the EEPROM cannot be written now, with the remedy; an empty string if it can.

        Lock (47) closes the EEPROM of Protocol 1.0 until the power is switched off (e-Manual AX-12A, Lock
        (47)), torque that of Protocol 2.0 (e-Manual XM430-W350, Control Table of EEPROM Area).

        Args:
            names: Items to be written, for the message.
            release: Remedy if the servo holds torque.
            unread: Message for a servo that does not answer; by default a sentence about its torque.
        """
        if (yield from self.read_one("lock")):
            lock = self.items["lock"].title
            return f"has {lock} = 1, so {names} in its EEPROM was not written: switch its power off and on"
        if (enable := self.items.get("torque_enable")) is None:
            return ""
        torque = yield from self.read_bytes(enable.address, enable.size)
        if not torque.answered:
            return unread or f"did not answer when its torque was read, so {names} was not written"
        if torque.parameters[0]:
            release = release or "switch its torque off first"
            return f"holds torque, so {names} in its EEPROM was not written: {release}"
        return ""

    def reason(self, reply: Reply) -> str:
        """Return `: ` and the error of a refused reply in words; an empty string if the reply is not a
        refusal.
        """
        return (
            f": {self.line.dialect.describe_error(reply.error)}"
            if reply.outcome is TransactionOutcome.REFUSED
            else ""
        )


class Access(ItemAccess):
    """One servo of a bus; `str` is its label in the plan. Create it with `access_servo` (timeouts of the
    plan) or `first_reach` (longest timeouts).
    """

    __slots__ = ("plan", "servo")

    def __init__(self, plan: BusPlan, servo: ServoPlan, line: Line) -> None:
        super().__init__(line, servo.servo_id, servo.joint)
        self.plan = plan
        self.servo = servo

    def __str__(self) -> str:
        return self.plan.label(self.servo)

    @property
    def table(self) -> ControlTable:
        """Control table of the servo's model."""
        return find_table(self.servo.model, self.plan.protocol)

    def spare(self, end: int) -> int:
        """Return the number of readable bytes from an address on, at most MOST_SPARE."""
        return _spare(self.servo.model, self.plan.protocol, end)

    def placed(self, servo: ServoPlan) -> Access:
        """Return access to the same servo with a plan whose ticks count from another zero."""
        return Access(self.plan, servo, self.line)

    def read_torque(self) -> Program[Reply]:
        """Read Torque Enable, with up to three attempts; return the reply."""
        return self.read_bytes(self.servo.torque_address, 1)

    def torque_off(self) -> Program[Reply]:
        """Write Torque Enable = 0, with up to three attempts; return the reply. Does not read it back."""
        return limit_patience(self.write_bytes(self.servo.torque_address, b"\0"))


@lru_cache
def _spare(model: str, protocol: float, end: int) -> int:
    return find_table(model, protocol).spare(end, MOST_SPARE)


def access_servo(plan: BusPlan, servo: ServoPlan) -> Access:
    """Return access to a servo with the timeouts of the plan, for servos whose return delay is as planned."""
    return Access(plan, servo, plan_line(plan))


def first_reach(plan: BusPlan, servo: ServoPlan) -> Access:
    """Return access to a servo with the longest timeouts, for servos whose return delay is not known yet."""
    return Access(plan, servo, setup_line(plan))


def _near(items: Iterable[ControlItem]) -> list[list[ControlItem]]:
    """Group items by address so that each group takes one read, including gaps of up to NEAR bytes."""
    groups: list[list[ControlItem]] = []
    for item in sorted(items, key=lambda one: one.address):
        if groups:
            first, last = groups[-1][0], groups[-1][-1]
            gap = item.address - last.address - last.size
            if gap <= NEAR and item.address + item.size - first.address <= LONGEST_READ:
                groups[-1].append(item)
                continue
        groups.append([item])
    return groups
