"""Servo of a tool: changes one servo on a port, such as torque, ID, rate, reboot, factory reset and the
backup in the servo.

The programs are those of a run: registers are compared, only differences are written, and each is read back;
torque is switched on with a goal at the present position. Every change is confirmed by a read afterwards.

Sources: e-Manual, Protocol 1.0 and 2.0: Factory Reset (0x06), Reboot (0x08), Control Table Backup (0x20).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from dxlrun.dynamixel.findings import Findings
from dxlrun.dynamixel.servo import mode_switches, watchdog
from dxlrun.dynamixel.servo.checks import deviations
from dxlrun.dynamixel.servo.item_access import Access, access_servo
from dxlrun.dynamixel.servo.registers import format_item, read_registers, tripped, write_registers
from dxlrun.dynamixel.tools.one_node import Confirm, OneNode, agree
from dxlrun.dynamixel.tools.scanning import FoundServo
from dxlrun.dynamixel.tools.tool_line import ToolLine
from dxlrun.errors import InputError, ServoFault
from dxlwire.bus_plan import BusPlan, RegisterValue, ServoPlan
from dxlwire.control_table import (
    ControlTable,
    FoundDeviation,
    find_table,
)
from dxlwire.modes import Mode
from dxlwire.plan.line import LONGEST_RETURN_DELAY_NS, listen_transaction
from dxlwire.plan.mode_plan import mode_in
from dxlwire.plan.placement import OFFSET, present_offset
from dxlwire.plan.planning import Wiring, bus_plan
from dxlwire.plan.retry import retry
from dxlwire.transaction import Program, Reply, Transaction, TransactionOutcome
from dxlwire.wire import protocol1, protocol2
from dxlwire.wire.protocol2 import Reset

BLINK_NS = 300_000_000  # time of the LED on, and then off
BOOT_NS = 5_000_000_000  # timeout for a rebooting servo
_PINGED_EVERY_NS = 100_000_000
_STORED_NS = 50_000_000  # longest time of an EEPROM write [i]
_TICK_MODULUS = 32_768
_TICK_SPARE_MS = 500
_SET_BY: Mapping[str, str] = {
    "id": "use `dxlrun servo PORT ID id NEW`",
    "baud_rate": "use `dxlrun servo PORT ID baud RATE`",
    "baud_rate_bus": "use `dxlrun servo PORT ID baud RATE`",
    "torque_enable": "use `dxlrun servo PORT ID torque on` or `off`",
    "protocol_type": "dxlrun would lose the servo; use the manufacturer's tool",
}
"""Items that `set` refuses, because a change needs more than one write, with the command that changes each.
"""
_KEPT: Mapping[Reset, str] = {
    Reset.ALL: "ID and baud rate too",
    Reset.KEEP_ID: "baud rate too; the ID stays",
    Reset.KEEP_ID_AND_BAUD_RATE: "ID and baud rate stay",
}
_TURNS_BY_CURRENT = 255  # each way, of current-based position control (e-Manual XM430-W350, Goal Position)
_LEDS = ("led", "led_red", "led_green", "led_blue")


class OneServo(OneNode):
    """The servo that a tool works on. Its methods block; they raise ServoFault for a problem of the servo,
    PortError for a lost line.
    """

    NOT_SET = MappingProxyType({name: f"{name} cannot be set here; {_SET_BY[name]}" for name in _SET_BY})
    table: ControlTable

    def __init__(self, tool: ToolLine, found: FoundServo) -> None:
        if not found.model or found.garbled:
            raise ServoFault(f"ID {found.servo_id} at {found.baud_rate} bit/s {'; '.join(found.remarks)}")
        super().__init__(tool, found, find_table(found.model, found.protocol))
        self.move_to(found.servo_id, found.baud_rate)

    def move_to(self, servo_id: int, baud_rate: int) -> None:
        """Use another ID and rate (bit/s) for the servo from now on. Nothing is sent to the servo."""
        self.servo_id, self.baud_rate = servo_id, baud_rate
        self.tool.speak(self.table.protocol, baud_rate)
        self.plan = self._plan()

    @property
    def _servo(self) -> ServoPlan:
        return self.plan.servos[0]

    @property
    def access(self) -> Access:
        """Access to the servo's items on the tool's line."""
        return Access(self.plan, self._servo, self.tool.line)

    # Registers

    def deviations(self, values: Mapping[str, int]) -> tuple[FoundDeviation, ...]:
        """Return the given register values that differ from the factory's and matter to a run."""
        return deviations(self.access, values, mode_in(self._servo, values))

    def differences(self, desired: Sequence[RegisterValue]) -> tuple[RegisterValue, ...]:
        """Read registers and return those that differ from their desired values; raise ServoFault without an
        answer.
        """
        present = self.run_program(read_registers(self.access, desired))
        if silent := [self.table.items[name].title for name, found in present.items() if found is None]:
            raise self.make_fault(f"did not answer when {', '.join(silent)} was read")
        return tuple(each for each in desired if each.value != present[each.name])

    def write_registers(self, desired: Sequence[RegisterValue]) -> tuple[str, ...]:
        """Write the registers that differ from their desired values, in the given order, and read each back;
        return a text for each write.

        A servo refuses goals while its Bus Watchdog is tripped, so a tripped watchdog is cleared before a
        goal is written, and before the watchdog itself is written.
        """
        self.writable(desired)
        tripping = any(one.name.startswith(("goal_", "bus_watchdog")) for one in desired)
        cleared = self.clear_watchdog(armed=False) if tripping else ()
        return (*cleared, *self._settle(desired))

    def clear_watchdog(self, *, armed: bool) -> tuple[str, ...]:
        """Clear a tripped Bus Watchdog; return a text for each action, none if there was nothing to clear.

        A run that was killed leaves the watchdog armed or tripped. After the clear a servo that was stopped
        with torque would move to its old goal, at full speed because its profile was reset. Its torque is
        therefore off until it is held at its present position.

        Args:
            armed: True: also clear a watchdog that is armed and has not tripped yet.

        Raises:
            ServoFault: The servo does not answer or refuses.
        """
        item = self.table.items.get("bus_watchdog")
        if item is None:
            return ()
        raw = self.read_items([item.name], refused=True).get(item.name, 0)
        if not (tripped(item, raw) or (armed and raw)):
            return ()
        stopped = tripped(item, raw) and self.holds_torque()
        if stopped:
            self.torque(False)
        if problem := self.run_program(watchdog.disarm(access_servo(self.plan, self._servo))):
            raise ServoFault(problem)
        why = "it had stopped the servo"
        if not tripped(item, raw):
            why = f"it would have stopped the servo after {raw * 20} ms without an instruction"
        done = f"cleared {item.title} = {format_item(item, raw)}: {why}"
        return (done, self._hold()) if stopped else (done,)

    # Torque and LED

    def holds_torque(self) -> bool:
        """Read Torque Enable; return True if it is on."""
        return bool(self.read_items(["torque_enable"])["torque_enable"])

    def torque(self, on: bool) -> tuple[str, ...]:
        """Switch the servo's torque on at its present position, or off, and read it back; return a text for
        each action.

        Before torque on, a Bus Watchdog that is armed or tripped is cleared.
        """
        if not on:
            written = self.write_registers([self.register("torque_enable", 0)])
            return ("is limp" + ("" if written else ", as before"),)
        cleared = self.clear_watchdog(armed=True)
        if not self.holds_torque():
            return (*cleared, self._hold())
        return cleared if len(cleared) > 1 else (*cleared, "holds torque, as before")

    def _hold(self) -> str:
        mode = self._mode()
        held = self.run_program(mode_switches.hold_servo(access_servo(self.plan, self._servo), mode))
        if held.problem:
            self.run_program(write_registers(self.access, [self.register("torque_enable", 0)], Findings()))
            offset = self.read_offset()
            shifted = f"; Homing Offset = {offset} shifts its position" if offset else ""
            raise self.make_fault(f"{held.problem}{shifted}; its torque is off")
        where = "" if held.goal is None else f" at its present tick {held.goal}"
        return f"holds torque in {mode.name.lower().replace('_', '-')} mode{where}"

    def blink(self, times: int = 5) -> str:
        """Blink the LED `times` times and restore its state; return a text about it."""
        names = [name for name in _LEDS if name in self.table.items]
        if not names:
            raise self.make_fault("this model has no switchable LED")
        before = self.read_items(names)
        bright = [self.register(name, self.table.items[name].maximum) for name in names]
        dark = [self.register(name, 0) for name in names]
        try:
            for state in (bright, dark) * times:
                self.write_registers(state)
                self.tool.wait_for_packets(BLINK_NS)
        finally:
            self.write_registers([self.register(name, value) for name, value in before.items()])
        return f"blinked {times} times"

    def read_offset(self) -> int:
        """Return the Homing Offset, ticks, that the servo's present position contains in its present mode.

        Raises:
            ServoFault: The servo does not answer.
        """
        names = [name for name in (OFFSET, "operating_mode") if name in self.table.items]
        return present_offset(self.table, self.read_items(names))

    # Mode and plan

    def _mode(self) -> Mode:
        """Return the servo's present mode and set `plan` for it; raise ServoFault if the mode is not
        known."""
        for continuous in (False, True):
            try:
                self.plan = self._plan(turns=math.inf if continuous else 0)
            except ValueError:  # the model has no continuous mode
                break
            mode = self.run_program(mode_switches.mode_now(access_servo(self.plan, self._servo)))
            if mode is Mode.EFFORT_POSITION and "operating_mode" in self.table.items:
                self.plan = self._plan(turns=_TURNS_BY_CURRENT)  # this mode counts turns as well
            if mode is not Mode.UNKNOWN:
                return mode
        self.plan = self._plan()
        raise self.make_fault("is in an unknown mode; its torque stays off")

    def _plan(self, turns: float = 0) -> BusPlan:
        table, name = self.table, self.tool.port.name
        end = turns * math.tau if turns else 0.0
        wiring = Wiring(
            joint=table.model,
            row=0,
            servo_id=self.servo_id,
            table=table,
            reference=0.0,
            direction=1,
            lower=-end or table.min_tick * table.rad_per_tick,
            upper=end or table.max_tick * table.rad_per_tick,
            continuous=math.isinf(turns),
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

    # Verbs: each returns a text about the change, empty if it was not confirmed by the user.

    def change_id(self, new: int, confirm: Confirm = agree) -> str:
        """Change the ID of the servo in its EEPROM; return a text, empty if it was not confirmed.

        Raises:
            ServoFault: The change failed, or another servo has the ID.
            InputError: The protocol does not have the ID.
        """
        if new > (highest := self.tool.line.dialect.HIGHEST_ID):
            raise InputError(f"Protocol {self.table.protocol} has no ID {new}; give one from 0 to {highest}")
        if new == self.servo_id:
            return f"has ID {new} already"
        if not confirm(f"{self.called}: its ID becomes {new} (EEPROM)"):
            return ""
        self.writable([self.register("id", new)])
        old, line = self.servo_id, self.tool.line
        # Two servos with one ID would both be unreachable.
        self._free(new)
        item = self.table.items["id"]
        self._send_change(line.write_range(old, item.address, bytes((new,))), f"{item.title} = {new}")
        if (
            self._there(old) is not TransactionOutcome.TIMEOUT
            and self._there(new) is TransactionOutcome.TIMEOUT
        ):
            raise self.make_fault(f"still answers under its old ID after {item.title} = {new} was written")
        self.move_to(new, self.baud_rate)
        self._same()
        if self._there(old) is not TransactionOutcome.TIMEOUT:
            raise self.make_fault(
                f"has its new ID, but a servo still answers under ID {old}: two servos had this ID"
            )
        return f"has ID {new} (before: {old})"

    def change_rate(self, new: int, confirm: Confirm = agree) -> str:
        """Change the baud rate of the servo in its EEPROM to `new`, bit/s; return a text, empty if it was not
        confirmed.

        Raises:
            ServoFault: The change failed, the adapter does not support the rate, or another servo there has
                the ID.
            InputError: The model does not have the rate.
        """
        value = next((value for value, rate in self.table.baud_rates.items() if rate == new), None)
        if value is None:
            known = ", ".join(map(str, sorted(self.table.baud_rates.values())))
            raise InputError(f"{self.table.model} has no baud rate of {new} bit/s; give one of {known}")
        if new == self.baud_rate:
            return f"runs at {new} bit/s already"
        if not confirm(f"{self.called}: its baud rate becomes {new} bit/s (EEPROM)"):
            return ""
        self.writable([self.register(self.rate_item(), value)])
        # Try the adapter first: at a rate that it lacks, the servo would be unreachable.
        if not self.tool.can_run_at(new):
            raise self.make_fault(
                f"the adapter at {self.tool.port.name} cannot run at {new} bit/s; nothing was changed"
            )
        old, item = self.baud_rate, self.table.items[self.rate_item()]
        self.tool.speak(self.table.protocol, new)
        try:
            self._free(self.servo_id)
        finally:
            self.tool.speak(self.table.protocol, old)
        packet = self.tool.line.write_range(self.servo_id, item.address, value.to_bytes(item.size, "little"))
        self._send_change(packet, f"{item.title} = {value}")
        self.move_to(self.servo_id, new)
        if self._there(self.servo_id) is TransactionOutcome.TIMEOUT:
            self.move_to(self.servo_id, old)
            if self._there(self.servo_id) is TransactionOutcome.TIMEOUT:
                port = self.tool.port.name
                raise self.make_fault(
                    f"answers neither at {old} nor at {new} bit/s; find it with `dxlrun scan {port}`"
                )
            raise self.make_fault(f"still answers at {old} bit/s after {item.title} = {value} was written")
        self._same()
        return f"runs at {new} bit/s (before: {old})"

    def rate_item(self) -> str:
        """Return the name of the item with the baud rate of the bus; the Y series has two rates."""
        return "baud_rate" if "baud_rate" in self.table.items else "baud_rate_bus"

    def reboot(self, confirm: Confirm = agree) -> str:
        """Reboot the servo and wait until it answers; ask for confirmation first if it holds torque."""
        if self.holds_torque() and not confirm(
            f"{self.called} holds torque: the reboot switches it off, and its load can fall"
        ):
            return ""
        if "reboot" not in self.table.capabilities:
            raise self.make_fault("this model has no reboot instruction; switch its power off and on")
        before_ns = self.tool.port.clock.now_ns()
        self._send_change(
            self.tool.line.instruct(self.servo_id, protocol2.reboot(self.servo_id)), "the reboot"
        )
        self._await()
        if "realtime_tick" in self.table.items:
            tick = self.read_items(["realtime_tick"])["realtime_tick"]
            passed_ms = (self.tool.port.clock.now_ns() - before_ns) // 1_000_000
            # After a turn of the counter the tick does not show a reboot.
            if tick > passed_ms + _TICK_SPARE_MS and passed_ms < _TICK_MODULUS:
                raise self.make_fault(
                    f"did not reboot: its Realtime Tick is {tick} ms, {passed_ms} ms after the reboot"
                )
        return f"rebooted, and {'holds torque' if self.holds_torque() else 'is limp'}"

    def factory_reset(self, keep: Reset | None = None, confirm: Confirm = agree) -> str:
        """Reset the servo's control table to the factory's values and wait for the servo.

        Protocol 2.0 keeps ID and baud rate unless `keep` says otherwise; Protocol 1.0 keeps neither. If ID or
        rate becomes that of the factory, no other servo may have them.
        """
        old = self.table.protocol == 1.0
        if old and keep not in (None, Reset.ALL):
            raise InputError(
                "a factory reset of Protocol 1.0 also resets ID and baud rate; write `--except nothing` to "
                "allow it"
            )
        if keep is None:
            keep = Reset.ALL if old else Reset.KEEP_ID_AND_BAUD_RATE
        if not confirm(f"{self.called}: its EEPROM is reset to the factory values ({_KEPT[keep]})"):
            return ""
        items, table = self.table.items, self.table
        self.writable([self.register("id", self.servo_id)])
        servo_id, baud_rate = self.servo_id, self.baud_rate
        if keep is Reset.ALL:
            servo_id = items["id"].initial or 1
        if keep is not Reset.KEEP_ID_AND_BAUD_RATE:
            baud_rate = table.baud_rates[items[self.rate_item()].initial or 0]
        if (servo_id, baud_rate) != (self.servo_id, self.baud_rate):
            if not self.tool.can_run_at(baud_rate):
                raise self.make_fault(
                    f"the adapter cannot run at the factory's {baud_rate} bit/s; nothing was changed"
                )
            self.tool.speak(table.protocol, baud_rate)
            try:
                self._free(servo_id)
            finally:
                self.tool.speak(table.protocol, self.baud_rate)
        packet = (
            protocol1.factory_reset(self.servo_id) if old else protocol2.factory_reset(self.servo_id, keep)
        )
        self._send_change(self.tool.line.instruct(self.servo_id, packet), "the factory reset")
        self.move_to(servo_id, baud_rate)
        self._await()
        self._same()
        return f"has the factory values, ID {servo_id} at {baud_rate} bit/s"

    def back_up(self, confirm: Confirm = agree) -> str:
        """Store the servo's control table in the backup memory inside the servo."""
        if not confirm(f"{self.called}: its internal backup is overwritten"):
            return ""
        self._has_backup()
        self._send_change(
            self.tool.line.instruct(self.servo_id, protocol2.back_up(self.servo_id)), "the backup"
        )
        if "backup_ready" in self.table.items and not self.read_items(["backup_ready"])["backup_ready"]:
            raise self.make_fault("acknowledged the backup, but Backup Ready is 0: nothing was stored")
        return "stored its control table in its internal backup"

    def take_back(self, confirm: Confirm = agree) -> str:
        """Restore the servo's EEPROM from the backup memory inside the servo; the servo reboots."""
        if not confirm(f"{self.called}: its EEPROM is restored from its internal backup"):
            return ""
        self._has_backup()
        self._send_change(
            self.tool.line.instruct(self.servo_id, protocol2.restore(self.servo_id)), "the restoring"
        )
        self._await()
        self._same()
        return "restored its EEPROM from its internal backup and rebooted"

    def restore(
        self, desired: Sequence[RegisterValue], path: Path, confirm: Confirm = agree
    ) -> tuple[str, ...]:
        """Write the registers of a backup file, `desired`, read from `path`; return a text for each write."""
        if not (differing := self.differences(desired)):
            return (f"has all values of {path} already",)
        self.writable(differing)
        names = ", ".join(each.name for each in differing)
        if not confirm(f"{self.called}: {names} are restored from {path}; ID and baud rate stay"):
            return ()
        written: tuple[str, ...] = ()
        # A restored mode resets other registers, which are written in a second pass.
        for _ in range(2):
            written += self.write_registers(differing)
            if not (differing := self.differences(desired)):
                return written
        names = ", ".join(each.name for each in differing)
        raise self.make_fault(f"{names} changed again during the restore; try again")

    def _has_backup(self) -> None:
        if self.table.protocol == 1.0:
            raise self.make_fault("servos of Protocol 1.0 have no internal backup; give a file")
        if self.holds_torque():
            raise self.make_fault(f"holds torque; switch it off first: {self.command} torque off")

    def _send_change(self, transaction: Transaction, what: str) -> None:
        """Send an instruction that changes the servo; raise ServoFault if it is refused. A missing
        acknowledgement is not a failure: a read afterwards decides.
        """

        def program() -> Program[Reply]:
            reply = yield transaction
            yield listen_transaction(_STORED_NS)
            return reply

        reply = self.run_program(program())
        if reply.outcome is TransactionOutcome.REFUSED:
            raise self.make_fault(f"refuses {what}: {self.tool.line.dialect.describe_error(reply.error)}")

    def _there(self, servo_id: int) -> TransactionOutcome:
        def program() -> Program[TransactionOutcome]:
            reply = yield from retry(self.tool.line.ping(servo_id))
            return reply.outcome

        return self.tool.run_program(program())

    def _free(self, servo_id: int) -> None:
        if self._there(servo_id) is not TransactionOutcome.TIMEOUT:
            raise ServoFault(
                f"{self.called}: another servo has ID {servo_id} at {self.tool.baud_rate} bit/s; nothing was "
                "changed"
            )

    def _same(self) -> None:
        number = self.read_items(["model_number"])["model_number"]
        if number != self.table.model_number:
            raise self.make_fault(f"has model number {number}, not {self.table.model_number}")

    def _await(self) -> None:
        end_ns = self.tool.port.clock.now_ns() + BOOT_NS
        while self._there(self.servo_id) is not TransactionOutcome.OK:
            if self.tool.port.clock.now_ns() > end_ns:
                port = self.tool.port.name
                raise self.make_fault(
                    f"has not answered for {BOOT_NS * 1e-9:g} s; find it with `dxlrun scan {port}`"
                )
            self.tool.wait_for_packets(_PINGED_EVERY_NS)
