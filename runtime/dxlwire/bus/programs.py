"""Programs: the single transactions of a script: find servos, read and write items, switch torque.

Programs of one servo raise `ServoFailed`. Reads and pings are repeated. A write is not: after a lost
acknowledgement the item is read back, which shows whether the servo has executed the write."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec
from msgspec.structs import replace

from dxlwire.control_table import ControlItem, ControlTable, models_by_number
from dxlwire.exceptions import FailureKind, ServoFailure
from dxlwire.plan.bus_watchdog import MOST_TICKS
from dxlwire.plan.line import MOST_SPARE, Line, listen_transaction
from dxlwire.plan.mode_plan import in_mode, mode_plans
from dxlwire.plan.retry import ATTEMPTS, retry
from dxlwire.transaction import BROADCAST_ID, Program, Reply, Transaction, TransactionOutcome

SHORT_TIMEOUT_NS = 2_000_000
"""Time (ns) that a ping which is probably not answered waits, beyond the latest arrival by the wire."""
SLOT_NS = 3_000_000
"""Time (ns) for each ID after a broadcast ping, in addition to the bytes of its answer (dynamixel-sdk,
broadcastPing)."""
STORED_NS = 50_000_000  # Longest time (ns) of an EEPROM write that no reply ends [i]
IDENTITY_LENGTH = 3
"""Bytes that identify a node, model number (2) and firmware version (1): the reply to a ping of Protocol 2.0,
bytes 0..2 of the table in 1.0."""
USE_TORQUE = "use `servos.torque = True`, which first sets the goal to the present position"
_ACKNOWLEDGES_NOTHING = 1  # Highest Status Return Level at which writes have no reply
_LIMITS = ("min_position_limit", "max_position_limit", "cw_angle_limit", "ccw_angle_limit")


class ReturnLevel(msgspec.Struct):
    """Knowledge of a servo's Status Return Level."""

    acknowledges: bool = True
    """False after the servo was found to answer reads, but no writes: level 1."""


class Addressed(msgspec.Struct, frozen=True):
    """A servo on the line: its ID, and the control table of its model and firmware."""

    servo_id: int
    table: ControlTable
    level: ReturnLevel = msgspec.field(default_factory=ReturnLevel)


class ServoFailed(Exception):
    """A program of one servo ends, because of this failure."""

    def __init__(self, failure: ServoFailure) -> None:
        super().__init__(failure.text)
        self.failure = failure


Failures = dict[int, ServoFailure]


def find_ids(line: Line, ids: Sequence[int], answered: set[int]) -> Program[list[int]]:
    """Return the IDs that answer a ping.

    Protocol 2.0 gets one broadcast ping, which each servo answers in its own slot. Protocol 1.0 is pinged ID
    by ID.

    Args:
        line: Timing of the line.
        ids: The IDs to look for.
        answered: IDs of the replies on the line; the caller adds each one that arrives.
    """
    dialect = line.dialect
    answered.clear()
    if dialect.PROTOCOL == 2.0:
        slot_ns = line.wire_ns(dialect.OVERHEAD + dialect.PING_LENGTH) + SLOT_NS
        ping = line.unanswered(dialect.ping(BROADCAST_ID))
        slots_ns = slot_ns * (max(ids, default=0) + 2) + line.latency_ns
        yield replace(ping, due_ns=ping.due_ns + slots_ns)
        return sorted(answered & set(ids))
    for servo_id in ids:
        ping = line.ping(servo_id)
        yield replace(ping, timeout_ns=ping.due_ns + line.latency_ns + SHORT_TIMEOUT_NS)
    yield listen_transaction(line.latency_ns + SHORT_TIMEOUT_NS)
    return sorted(answered & set(ids))


def identity(line: Line, servo_id: int) -> Program[tuple[Reply, Reply]]:
    """Ping a servo; return the reply to the ping, and the reply that contains model number and firmware
    version."""
    ping = yield from retry(line.ping(servo_id))
    if not ping.answered or line.dialect.PING_LENGTH >= IDENTITY_LENGTH:
        return ping, ping
    return ping, (yield from retry(line.read_range(servo_id, 0, IDENTITY_LENGTH, MOST_SPARE)))


def identify(
    line: Line, models: Mapping[int, ControlTable | None]
) -> Program[tuple[list[Addressed], Failures]]:
    """Return the servos with these IDs, and the failures of those that are absent or have another model.

    Args:
        line: Timing of the line.
        models: Table of the expected model by ID; None: any model.
    """
    found: list[Addressed] = []
    failures: Failures = {}
    for servo_id, expected in models.items():
        ping, reply = yield from identity(line, servo_id)
        if not reply.answered:
            if reply.outcome is TransactionOutcome.TIMEOUT and reply is ping:
                text = "did not answer the ping; find its ID and baud rate by `dxlrun scan PORT`"
                failures[servo_id] = ServoFailure("no_reply", text)
                continue
            asked = "the ping" if reply is ping else "the read of its model"
            failures[servo_id] = yield from _with_level(line, servo_id, failure_of(line, reply, asked))
            continue
        number, firmware = reply.word(), reply.parameters[2]
        if expected is not None and number != expected.model_number:
            others = models_by_number(number, line.dialect.PROTOCOL, firmware)
            actual = others[0].model if others else f"a model with the number {number}"
            failures[servo_id] = ServoFailure("wrong_model", f"is {actual}, not {expected.model}")
            continue
        table = expected or next(iter(models_by_number(number, line.dialect.PROTOCOL, firmware)), None)
        if table is None:
            text = f"has the unknown model number {number}; add its control table with a plug-in"
            failures[servo_id] = ServoFailure("unknown_model", text)
            continue
        known = table.with_firmware(firmware)
        fast = known.fast_sync_read_firmware
        if fast is None or firmware < fast:
            known = replace(known, capabilities=known.capabilities - {"fast_sync_read"})
        found.append(Addressed(servo_id, known))
    return found, failures


def read_item(line: Line, servo_id: int, item: ControlItem) -> Program[bytes]:
    """Read one item; return its bytes."""
    reply = yield from retry(line.read_range(servo_id, item.address, item.size))
    if not reply.answered:
        failure = failure_of(line, reply, f"the read of {item.title}")
        raise ServoFailed((yield from _with_level(line, servo_id, failure)))
    return bytes(reply.parameters)


def _with_level(line: Line, servo_id: int, failure: ServoFailure) -> Program[ServoFailure]:
    """Return the failure of a read, with a remedy if the servo answers a ping: at level 0 it answers only
    that (e-Manual, Status Return Level)."""
    if failure.kind == "no_reply" and (yield line.ping(servo_id)).answered:
        text = "but answers a ping; write 2 to `status_return_level`, which may be 0"
        return ServoFailure(failure.kind, f"{failure.text}, {text}")
    return failure


def write_item(line: Line, servo: Addressed, item: ControlItem, data: bytes) -> Program[None]:
    """Write one item. An EEPROM item is written only if it differs, and only while torque is off."""
    if item.area == "EEPROM" and (yield from _is_stored(line, servo, item, data)):
        return
    reply = yield _write(line, servo, item, data)
    if item.name == "status_return_level":
        servo.level.acknowledges = item.integer(data) > _ACKNOWLEDGES_NOTHING
    if reply.answered:
        return
    failure = failure_of(line, reply, f"the write of {item.title}")
    if reply.outcome is TransactionOutcome.REFUSED:
        watchdog = servo.table.items.get("bus_watchdog")
        if watchdog and watchdog.decode((yield from read_item(line, servo.servo_id, watchdog))) > MOST_TICKS:
            text = f"{failure.text}; its Bus Watchdog has stopped it: write 0 to `bus_watchdog`"
            failure = ServoFailure(failure.kind, text)
        raise ServoFailed(failure)
    if reply.outcome is TransactionOutcome.SENT and item.area == "EEPROM":
        yield listen_transaction(STORED_NS)
    # Whether the servo has executed the write is unknown.
    present = yield from retry(line.read_range(servo.servo_id, item.address, item.size))
    if not present.answered:
        raise ServoFailed(failure)
    if (found := bytes(present.parameters)) != data:
        text = f"has not executed the write of {item.title}: it still contains {item.decode(found)}"
        raise ServoFailed(ServoFailure("not_written", text))
    yield from _learn_level(line, servo)


def _is_stored(line: Line, servo: Addressed, item: ControlItem, data: bytes) -> Program[bool]:
    """Return True if an EEPROM item has this value; raise ServoFailed if it must not be written."""
    try:
        if (yield from read_item(line, servo.servo_id, item)) == data:
            return True
        if any((yield from read_item(line, servo.servo_id, servo.table.items["torque_enable"]))):
            text = f"has torque, so {item.title} in its EEPROM was not written; switch torque off first"
            raise ServoFailed(ServoFailure("torque_on", text))
    except ServoFailed as error:
        # At level 0 the servo answers no read, and this write ends that.
        if item.name != "status_return_level" or error.failure.kind != "no_reply":
            raise
    return False


def _write(line: Line, servo: Addressed, item: ControlItem, data: bytes) -> Transaction:
    """Return the write of an item, without an acknowledgement if the servo sends none."""
    write = line.write_range(servo.servo_id, item.address, data)
    if servo.level.acknowledges:
        return write
    return replace(line.unanswered(write.packet), servo_id=servo.servo_id)


def _learn_level(line: Line, servo: Addressed) -> Program[None]:
    """Read whether a servo acknowledges writes, after one that it executed without a reply.

    A reply that was lost delays the next write until it can no longer arrive; one that the servo does not
    send must not."""
    level = servo.table.items.get("status_return_level")
    if level is not None and servo.level.acknowledges:
        found = yield from read_item(line, servo.servo_id, level)
        servo.level.acknowledges = level.integer(found) > _ACKNOWLEDGES_NOTHING


def switch_torque(line: Line, servo: Addressed, on: bool) -> Program[None]:
    """Switch the torque of a servo on or off.

    Before torque is switched on, the goal becomes the present position, or zero in a mode without a position
    goal. An old goal would otherwise move the servo at once."""
    enable = servo.table.items["torque_enable"]
    if on:
        if any((yield from read_item(line, servo.servo_id, enable))):
            return
        yield from _reset_goal(line, servo)
    for attempt in range(ATTEMPTS):
        try:
            yield from write_item(line, servo, enable, bytes((on,)))
            return
        except ServoFailed as error:
            # Torque off is the one write that is better executed twice than not at all.
            if on or error.failure.kind != "not_written" or attempt == ATTEMPTS - 1:
                raise


def _reset_goal(line: Line, servo: Addressed) -> Program[None]:
    items = servo.table.items
    goal = yield from _leading_goal(line, servo)
    if goal.name != "goal_position":
        yield from write_item(line, servo, goal, bytes(goal.size))
        return
    position = yield from read_item(line, servo.servo_id, items["present_position"])
    try:
        # This write switches torque on in Protocol 1.0.
        yield from write_item(line, servo, goal, position)
    except ServoFailed as error:
        raise ServoFailed((yield from _with_limits(line, servo, position, error.failure))) from None


def _leading_goal(line: Line, servo: Addressed) -> Program[ControlItem]:
    """Return the goal that a servo follows in its present mode. It is the goal position in extended position
    control, which needs no plan."""
    items = servo.table.items
    modes = mode_plans(servo.table, servo.table.min_tick, servo.table.max_tick, continuous=False)
    found: dict[str, int] = {}
    for name in dict.fromkeys(register.name for mode in modes for register in mode.operating):
        found[name] = items[name].integer((yield from read_item(line, servo.servo_id, items[name])))
    for mode in modes:
        if in_mode(mode, found):
            layout = mode.goals[-1]
            address = layout.address + layout.leading.offset
            return next(item for item in items.values() if item.address == address)
    return items["goal_position"]


def _with_limits(
    line: Line, servo: Addressed, position: bytes, failure: ServoFailure
) -> Program[ServoFailure]:
    """Return the failure of a goal at the present position; it has a remedy if that is beyond the limits."""
    items = servo.table.items
    ends = [items[name] for name in _LIMITS if name in items]
    if failure.kind != "refused":
        return failure
    limits = []
    for item in ends:
        limits.append(item.value((yield from read_item(line, servo.servo_id, item))))
    present = items["present_position"].value(position)
    if not limits or min(limits) <= present <= max(limits):
        return failure
    text = f"is at {present:.3f} rad, outside its limits {min(limits):.3f} to {max(limits):.3f} rad"
    names = " and ".join(item.title for item in ends)
    return ServoFailure(failure.kind, f"{text}, so torque stays off; turn it by hand, or change {names}")


def failure_of(line: Line, reply: Reply, request: str) -> ServoFailure:
    """Return the failure that an unsuccessful reply stands for; `request` names what was sent."""
    if reply.outcome is TransactionOutcome.REFUSED:
        return ServoFailure("refused", f"refused {request}: {line.dialect.describe_error(reply.error)}")
    kind: FailureKind = "no_reply"
    if reply.outcome is TransactionOutcome.GARBLED:
        return ServoFailure(kind, f"answered {request} with garbled bytes; look for two servos with one ID")
    return ServoFailure(kind, f"did not answer {request}")
