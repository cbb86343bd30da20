"""One servo on a tool's line: its control table, torque, ID, rate, reboot, reset and own backup.

What every run does is done by the same programs as there: registers are compared, only differences written
and read back; torque comes with a goal where the servo stands. Every change is confirmed by what is found
afterwards. Sources: e-Manual, Protocol 1.0 and 2.0: Factory Reset (0x06), Reboot (0x08), Control Table Backup
(0x20).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from dxlrun.dynamixel.findings import Findings
from dxlrun.dynamixel.servo import modes, watchdog
from dxlrun.dynamixel.servo.access import Access, reach
from dxlrun.dynamixel.servo.checks import deviations
from dxlrun.dynamixel.servo.registers import RegisterDifference, compare, settle, shown, tripped
from dxlrun.dynamixel.tools.scanning import FoundServo
from dxlrun.dynamixel.tools.tool_line import ToolLine
from dxlrun.errors import ServoFault
from dxlwire.bus_plan import BusPlan, RegisterValue, ServoPlan
from dxlwire.control_table import (
    ControlItem,
    ControlTable,
    FoundDeviation,
    control_table,
    side_by_side,
)
from dxlwire.modes import Mode
from dxlwire.plan.line import LONGEST_RETURN_DELAY_NS, listen
from dxlwire.plan.mode_plan import mode_in
from dxlwire.plan.planning import Wiring, bus_plan
from dxlwire.plan.retry import extend_timeouts, retry
from dxlwire.transaction import Outcome, Program, Reply, Result, Transaction
from dxlwire.wire import protocol1, protocol2
from dxlwire.wire.protocol2 import Reset

LONGEST_READ = 64  # Bytes of one read; neighbours are read together
BLINK_NS = 300_000_000  # How long the LED is on, and then off
BOOT_NS = 5_000_000_000  # How long a rebooting servo is awaited
_PINGED_EVERY_NS = 100_000_000
_STORED_NS = 50_000_000  # What a servo may take to write its EEPROM [i]
_TICK_MODULUS = 32_768
_TICK_SPARE_MS = 500
_LEDS = ("led", "led_red", "led_green", "led_blue")


class OneServo:
    """The servo that a tool works on; blocks, and raises ServoFault or PortError."""

    def __init__(self, tool: ToolLine, found: FoundServo) -> None:
        if not found.model or found.garbled:
            raise ServoFault(f"ID {found.servo_id} at {found.baud_rate} bit/s {'; '.join(found.remarks)}")
        self.tool = tool
        self.found = found
        self.table: ControlTable = control_table(found.model, found.protocol)
        self.move_to(found.servo_id, found.baud_rate)

    def move_to(self, servo_id: int, baud_rate: int) -> None:
        """Address it by another ID, at another rate, from now on."""
        self.servo_id, self.baud_rate = servo_id, baud_rate
        self.tool.speak(self.table.protocol, baud_rate)
        self.plan = self._plan()

    @property
    def called(self) -> str:
        """How messages call it."""
        return f"{self.table.model}, ID {self.servo_id} at {self.baud_rate} bit/s"

    @property
    def _servo(self) -> ServoPlan:
        return self.plan.servos[0]

    @property
    def _reach(self) -> Access:
        return Access(self.plan, self._servo, self.tool.line)

    def fail(self, text: str) -> ServoFault:
        """Return an error about this servo."""
        return ServoFault(f"{self.called}: {text}")

    # Registers

    def read(self, names: Sequence[str], *, refused: bool = False) -> Mapping[str, int]:
        """Return items by name: integers of the wire, signed where the item is.

        `refused`: what the servo's firmware does not have is left out; without, that is an error.
        """
        found: dict[str, int] = {}
        for block in side_by_side((self.table.items[name] for name in names), LONGEST_READ):
            found |= self.run(self._read_block(block, refused=refused))
        return {name: found[name] for name in names if name in found}

    def deviations(self, values: Mapping[str, int]) -> tuple[FoundDeviation, ...]:
        """Return which of some values are not the factory's and matter to a run."""
        return deviations(self._reach, values, mode_in(self._servo, values))

    def differences(self, desired: Sequence[RegisterValue]) -> tuple[RegisterDifference, ...]:
        """Compare registers with what they shall hold; writes nothing."""
        found = self.run(compare(self._reach, desired))
        silent = [self.table.items[one.register.name].title for one in found if one.found is None]
        if silent:
            raise self.fail(f"did not answer when {', '.join(silent)} was read")
        return found

    def writable(self, desired: Sequence[RegisterValue]) -> None:
        """Make sure that registers can be written; raises ServoFault where the EEPROM is closed."""
        stored = [self.table.items[one.name].title for one in desired if one.eeprom]
        release = f"switch the torque off first: {self.command} torque off"
        if stored and (problem := self.run(self._reach.closed_eeprom(stored[0], release=release))):
            raise self.fail(problem)

    def write(self, desired: Sequence[RegisterValue]) -> tuple[str, ...]:
        """Write the registers that differ, in order, and read each back; return what was written.

        Before goals, which a servo refuses while its Bus Watchdog is tripped, that is cleared; so is it where
        the watchdog itself is written.
        """
        self.writable(desired)
        tripping = any(one.name.startswith(("goal_", "bus_watchdog")) for one in desired)
        cleared = self.clear_watchdog(armed=False) if tripping else ()
        found = Findings()
        self.run(settle(self._reach, desired, found))
        written = [text for _, _, _, text in found.events]
        if found.problems:
            before = [f"written before that: {text}" for text in written]
            raise ServoFault("\n".join([*found.problems, *before]))
        return (*cleared, *written)

    def clear_watchdog(self, *, armed: bool) -> tuple[str, ...]:
        """Clear a Bus Watchdog that is tripped, `armed`: or would trip; return what was done, if anything.

        A run that was killed leaves it so. A servo that was stopped with torque would go on to its old goal,
        at full speed, as its profile was reset: its torque is off until it is held where it stands. Raises
        ServoFault.
        """
        item = self.table.items.get("bus_watchdog")
        if item is None:
            return ()
        raw = self.read([item.name], refused=True).get(item.name, 0)
        if not (tripped(item, raw) or (armed and raw)):
            return ()
        stopped = tripped(item, raw) and self.holds_torque()
        if stopped:
            self.torque(False)
        if problem := self.run(watchdog.disarm(reach(self.plan, self._servo))):
            raise ServoFault(problem)
        why = "it had stopped the servo, as no instruction came"
        if not tripped(item, raw):
            why = f"it would have stopped the servo after {raw * 20} ms without an instruction"
        done = f"cleared {item.title}, which was {shown(item, raw)}: {why}"
        return (done, self._hold()) if stopped else (done,)

    # Torque and LED

    def holds_torque(self) -> bool:
        """Return whether Torque Enable is on."""
        return bool(self.read(["torque_enable"])["torque_enable"])

    def torque(self, on: bool) -> tuple[str, ...]:
        """Switch the torque on where the servo stands, or off; read back. Return what was done.

        For the torque a Bus Watchdog that is tripped, or would trip, is cleared.
        """
        if not on:
            written = self.write([self.register("torque_enable", 0)])
            return ("is limp" + ("" if written else ", as before"),)
        cleared = self.clear_watchdog(armed=True)
        if not self.holds_torque():
            return (*cleared, self._hold())
        return cleared if len(cleared) > 1 else (*cleared, "holds torque, as before")

    def _hold(self) -> str:
        mode = self._mode()
        held = self.run(modes.hold(reach(self.plan, self._servo), mode))
        if held.problem:
            self.run(settle(self._reach, [self.register("torque_enable", 0)], Findings()))
            raise self.fail(f"{held.problem}; its torque is off")
        where = "" if held.goal is None else f" at tick {held.goal}, where it stood"
        return f"holds torque in {mode.name.lower().replace('_', '-')} mode{where}"

    def blink(self, times: int) -> str:
        """Let the LED blink, and leave it as it was; return what was done."""
        names = [name for name in _LEDS if name in self.table.items]
        if not names:
            raise self.fail("this model has no LED that can be switched")
        before = self.read(names)
        bright = [self.register(name, self.table.items[name].maximum) for name in names]
        dark = [self.register(name, 0) for name in names]
        try:
            for state in (bright, dark) * times:
                self.write(state)
                self.tool.wait(BLINK_NS)
        finally:
            self.write([self.register(name, value) for name, value in before.items()])
        return f"blinked {times} times"

    # Inside

    def run(self, program: Program[Result]) -> Result:
        """Run a program with longer timeouts: the servo is known to be there."""
        return self.tool.run(extend_timeouts(program))

    @property
    def command(self) -> str:
        """How a command line to it begins."""
        return f"dxlrun servo {self.tool.port.name} {self.servo_id}"

    def _mode(self) -> Mode:
        """Find out in which mode it is, and prepare that; raises ServoFault for one that is not known."""
        for continuous in (False, True):
            try:
                self.plan = self._plan(continuous)
            except ValueError:  # the model has no modes without end
                break
            mode = self.run(modes.mode_now(reach(self.plan, self._servo)))
            if mode is not Mode.UNKNOWN:
                return mode
        self.plan = self._plan()
        raise self.fail("is in a mode that dxlrun does not know, so its torque stays off")

    def register(self, name: str, value: int) -> RegisterValue:
        """Return an item with what it shall hold, the integer of the wire."""
        item = self.table.items[name]
        return RegisterValue(item.address, item.size, value, name, item.area == "EEPROM")

    def _plan(self, continuous: bool = False) -> BusPlan:
        table, name = self.table, self.tool.port.name
        end = math.inf if continuous else 0.0
        wiring = Wiring(
            joint=table.model,
            row=0,
            servo_id=self.servo_id,
            table=table,
            reference=0.0,
            direction=1,
            lower=-end or table.min_tick * table.rad_per_tick,
            upper=end or table.max_tick * table.rad_per_tick,
            continuous=continuous,
        )
        return bus_plan(
            name=name,
            port=name,
            baud_rate=self.baud_rate,
            latency_ns=self.tool.port.most_latency_ns,
            return_delay_ns=LONGEST_RETURN_DELAY_NS,
            joints=[wiring],
            protocol=table.protocol,
        )

    def _read_block(self, block: Sequence[ControlItem], *, refused: bool) -> Program[dict[str, int]]:
        start, end = block[0].address, block[-1].address + block[-1].size
        reply = yield from self._reach.read_bytes(start, end - start)
        if reply.answered:
            places = ((item, item.address - start) for item in block)
            return {item.name: item.integer(reply.parameters[at : at + item.size]) for item, at in places}
        found: dict[str, int] = {}
        for item in block:
            reply = yield from self._reach.read_bytes(item.address, item.size)
            if reply.answered:
                found[item.name] = item.integer(reply.parameters)
            elif reply.outcome is not Outcome.REFUSED:
                raise self.fail(f"did not answer when {item.title} was read")
            elif not refused:
                why = self.tool.line.dialect.describe_error(reply.error)
                raise self.fail(f"refuses to read {item.title}: {why}")
        return found


def change_id(one: OneServo, new: int) -> str:
    """Give a servo another ID; return what was done. Raises ServoFault, also where it is taken."""
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
        raise one.fail(f"has its new ID, but a servo still answers under ID {old}: there were two")
    return f"has ID {new}; it had {old}"


def change_rate(one: OneServo, new: int) -> str:
    """Let a servo talk at another rate, bit/s; return what was done.

    Raises ServoFault, also where the adapter cannot, or another servo there has its ID; LookupError where the
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
    """Reboot a servo, and wait until it answers; return what was done."""
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
    return f"started anew, and {'holds torque' if one.holds_torque() else 'is limp'}"


def factory_reset(one: OneServo, keep: Reset) -> str:
    """Set a servo's control table to the factory's values; return what was done.

    Protocol 1.0 keeps nothing. Where it gets the ID or the rate of the factory, these must be free.
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
        raise one.fail("acknowledged the backup, but Backup Ready is 0: there is none")
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
    """Send a change; a missing acknowledgement decides nothing, what is found afterwards does."""

    def program() -> Program[Reply]:
        reply = yield transaction
        yield listen(_STORED_NS)
        return reply

    reply = one.run(program())
    if reply.outcome is Outcome.REFUSED:
        raise one.fail(f"refuses {what}: {one.tool.line.dialect.describe_error(reply.error)}")


def _there(one: OneServo, servo_id: int) -> Outcome:
    def program() -> Program[Outcome]:
        reply = yield from retry(one.tool.line.ping(servo_id))
        return reply.outcome

    return one.tool.run(program())


def _free(one: OneServo, servo_id: int) -> None:
    if _there(one, servo_id) is not Outcome.TIMEOUT:
        raise ServoFault(
            f"{one.called}: another servo has ID {servo_id} at {one.tool.baud_rate} bit/s; nothing was "
            "changed"
        )


def _same(one: OneServo) -> None:
    number = one.read(["model_number"])["model_number"]
    if number != one.table.model_number:
        raise one.fail(f"the servo there is model number {number}, not {one.table.model_number}")


def _await(one: OneServo) -> None:
    end_ns = one.tool.port.clock.now_ns() + BOOT_NS
    while _there(one, one.servo_id) is not Outcome.OK:
        if one.tool.port.clock.now_ns() > end_ns:
            port = one.tool.port.name
            raise one.fail(f"does not answer since {BOOT_NS * 1e-9:g} s; look for it: dxlrun scan {port}")
        one.tool.wait(_PINGED_EVERY_NS)
