"""Changing what a servo is found by, and starting it anew; each is looked after until it is seen to be so.

Sources: e-Manual, Protocol 1.0 and 2.0: Factory Reset (0x06), Reboot (0x08), Control Table Backup (0x20).
"""

from __future__ import annotations

from dxlrun.dynamixel.plan.line import listen
from dxlrun.dynamixel.servo.retry import retry
from dxlrun.dynamixel.tools.one_servo import OneServo
from dxlrun.dynamixel.wire import protocol1, protocol2
from dxlrun.dynamixel.wire.protocol2 import Reset
from dxlrun.dynamixel.wire.transaction import Outcome, Program, Reply, Transaction
from dxlrun.errors import ServoFault

BOOT_NS = 5_000_000_000
"""How long a servo that starts anew is awaited."""
_ASKED_EVERY_NS = 100_000_000
_STORED_NS = 50_000_000
"""What a servo may take to write its EEPROM [i]."""
_TICK_MODULUS = 32_768
_TICK_SPARE_MS = 500


def change_id(one: OneServo, new: int) -> str:
    """Give a servo another ID; return what was done. Raises ServoFault, also where somebody has it."""
    one.writable([one.register("id", new)])
    old, line = one.servo_id, one.tool.line
    _free(one, new)
    item = one.table.items["id"]
    _written(one, line.write(old, item.address, bytes((new,))), f"{item.title} = {new}")
    if _there(one, old) is not Outcome.TIMEOUT and _there(one, new) is Outcome.TIMEOUT:
        raise one.fail(f"was given {item.title} = {new}, but still answers under its old one")
    one.move_to(new, one.baud_rate)
    _same(one)
    if _there(one, old) is not Outcome.TIMEOUT:
        raise one.fail(f"has its new ID, but somebody still answers under ID {old}: there were two")
    return f"has ID {new}; it had {old}"


def change_rate(one: OneServo, new: int) -> str:
    """Let a servo talk at another rate, bit/s; return what was done.

    Raises ServoFault, also where the adapter cannot, or somebody there has its ID; LookupError where the
    model does not have the rate.
    """
    value = next((value for value, rate in one.table.baud_rates.items() if rate == new), None)
    if value is None:
        raise LookupError(f"{one.table.model} has no rate of {new} bit/s")
    one.writable([one.register(rate_item(one), value)])
    if not one.tool.can_run_at(new):
        raise one.fail(f"the adapter at {one.tool.port.name} cannot run at {new} bit/s; nothing was changed")
    old, item = one.baud_rate, one.table.items[rate_item(one)]
    one.tool.speak(one.table.protocol, new)
    try:
        _free(one, one.servo_id)
    finally:
        one.tool.speak(one.table.protocol, old)
    packet = one.tool.line.write(one.servo_id, item.address, value.to_bytes(item.size, "little"))
    _written(one, packet, f"{item.title} = {value}")
    one.move_to(one.servo_id, new)
    if _there(one, one.servo_id) is Outcome.TIMEOUT:
        one.move_to(one.servo_id, old)
        if _there(one, one.servo_id) is Outcome.TIMEOUT:
            port = one.tool.port.name
            raise one.fail(
                f"answers neither at {old} nor at {new} bit/s now; look for it: dxlrun scan {port}"
            )
        raise one.fail(f"was given {item.title} = {value}, but still answers at {old} bit/s")
    _same(one)
    return f"talks at {new} bit/s; it did at {old}"


def rate_item(one: OneServo) -> str:
    """Return the name of the item that holds a servo's rate; the Y series has two."""
    return "baud_rate" if "baud_rate" in one.table.items else "baud_rate_bus"


def reboot(one: OneServo) -> str:
    """Start a servo anew, and wait until it answers; return what was done."""
    if "reboot" not in one.table.capabilities:
        raise one.fail("this model knows no reboot instruction; switch its power off and on")
    before_ns = one.tool.port.clock.now_ns()
    _written(one, one.tool.line.instruct(one.servo_id, protocol2.reboot(one.servo_id)), "the reboot")
    _await(one)
    if "realtime_tick" in one.table.items:
        tick = one.read(["realtime_tick"])["realtime_tick"]
        passed_ms = (one.tool.port.clock.now_ns() - before_ns) // 1_000_000
        if tick > passed_ms + _TICK_SPARE_MS and passed_ms < _TICK_MODULUS:
            raise one.fail(
                f"did not start anew: its Realtime Tick is {tick} ms, {passed_ms} ms after the reboot"
            )
    return f"started anew, and holds {'' if one.holds_torque() else 'no '}torque"


def factory_reset(one: OneServo, keep: Reset) -> str:
    """Set a servo's control table to the factory's values; return what was done.

    Protocol 1.0 keeps nothing. Where it gets the ID or the rate of the factory, nobody there may have it.
    """
    items, table = one.table.items, one.table
    one.writable([one.register("id", one.servo_id)])
    servo_id, baud_rate = one.servo_id, one.baud_rate
    if table.protocol == 1.0 or keep is Reset.ALL:
        servo_id = items["id"].initial or 1
    if table.protocol == 1.0 or keep is not Reset.KEEP_ID_AND_BAUD_RATE:
        baud_rate = table.baud_rates[items[rate_item(one)].initial or 0]
    if (servo_id, baud_rate) != (one.servo_id, one.baud_rate):
        if not one.tool.can_run_at(baud_rate):
            raise one.fail(f"the adapter cannot run at the factory's {baud_rate} bit/s; nothing was changed")
        one.tool.speak(table.protocol, baud_rate)
        try:
            _free(one, servo_id)
        finally:
            one.tool.speak(table.protocol, one.baud_rate)
    packet = (
        protocol1.factory_reset(one.servo_id)
        if table.protocol == 1.0
        else protocol2.factory_reset(one.servo_id, keep)
    )
    _written(one, one.tool.line.instruct(one.servo_id, packet), "the factory reset")
    one.move_to(servo_id, baud_rate)
    _await(one)
    _same(one)
    return f"has the factory's values, ID {servo_id} at {baud_rate} bit/s"


def back_up(one: OneServo) -> str:
    """Let a servo store its control table in its own backup; return what was done."""
    _has_backup(one)
    _written(one, one.tool.line.instruct(one.servo_id, protocol2.back_up(one.servo_id)), "the backup")
    if "backup_ready" in one.table.items and not one.read(["backup_ready"])["backup_ready"]:
        raise one.fail("acknowledged the backup, but Backup Ready says that there is none")
    return "stored its control table in its own backup"


def take_back(one: OneServo) -> str:
    """Let a servo take its EEPROM back from its own backup and start anew; return what was done."""
    _has_backup(one)
    _written(one, one.tool.line.instruct(one.servo_id, protocol2.restore(one.servo_id)), "the restoring")
    _await(one)
    _same(one)
    return "took its EEPROM back from its own backup, and started anew"


def _has_backup(one: OneServo) -> None:
    if one.table.protocol == 1.0:
        raise one.fail("servos of Protocol 1.0 have no backup of their own; give a file")
    if one.holds_torque():
        raise one.fail(f"holds torque; switch it off first: {one.command} torque off")


def _written(one: OneServo, transaction: Transaction, what: str) -> None:
    """Send what changes a servo; that no acknowledgement comes decides nothing, what is found then does."""

    def program() -> Program[Reply]:
        reply = yield transaction
        yield listen(_STORED_NS)
        return reply

    reply = one.run(program())
    if reply.outcome is Outcome.REFUSED:
        raise one.fail(f"refuses {what}: {one.tool.line.dialect.describe_error(reply.error)}")


def _there(one: OneServo, servo_id: int) -> Outcome:
    """Ping an ID at the rate that is spoken now."""

    def program() -> Program[Outcome]:
        reply = yield from retry(one.tool.line.ping(servo_id))
        return reply.outcome

    return one.tool.run(program())


def _free(one: OneServo, servo_id: int) -> None:
    if _there(one, servo_id) is not Outcome.TIMEOUT:
        raise ServoFault(
            f"{one.called}: somebody else has ID {servo_id} at {one.tool.baud_rate} bit/s; nothing was "
            "changed"
        )


def _same(one: OneServo) -> None:
    """Make sure that who answers now is a servo of this model."""
    number = one.read(["model_number"])["model_number"]
    if number != one.table.model_number:
        raise one.fail(f"who answers there is model number {number}, not {one.table.model_number}")


def _await(one: OneServo) -> None:
    """Wait until it answers."""
    end_ns = one.tool.port.clock.now_ns() + BOOT_NS
    while _there(one, one.servo_id) is not Outcome.OK:
        if one.tool.port.clock.now_ns() > end_ns:
            port = one.tool.port.name
            raise one.fail(f"does not answer since {BOOT_NS * 1e-9:g} s; look for it: dxlrun scan {port}")
        one.tool.wait(_ASKED_EVERY_NS)
