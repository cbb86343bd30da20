"""Simulated servo of Protocol 2.0: its instructions, Hardware Error Status with its latch, Bus Watchdog.

The Y series reports errors in Error Code instead, and each of them switches torque off. Not modelled for
the Y series: the time to switch torque, the brake, and Controller State except off, running and fault."""

from __future__ import annotations

import math
from collections.abc import Callable

from dxlsim.motion.shaft import Shaft
from dxlsim.registers.access import ACCESS, OperatingMode, torque_error, watchdog_expired
from dxlsim.registers.memory import Memory, Run
from dxlsim.servo.node import BULK_READ, FAST_BULK_READ, FAST_SYNC_READ, SYNC_READ
from dxlsim.servo.simulated_servo import SimulatedServo
from dxlsim.wire.servo_packets import BROADCAST, Instruction, InstructionPacket
from dxlsim.wire.servo_protocol2 import StatusErrorNumber
from dxlwire.control_table import ControlItem

WATCHDOG_UNIT_NS = 20_000_000
TORQUE_ON_AT_START, RAM_FROM_BACKUP = 0x01, 0x02  # Bits of Startup Configuration (60)
TORQUE_ON_BY_GOAL = 0x08  # Bit of Drive Mode (10): a goal enables torque


_LIMITS = frozenset(("pwm_limit", "current_limit"))
_SPEAKS = (2, 20, 21, 22)
"""Values of Protocol Type (13) with which a servo executes Protocol 2.0. Without a remote control on the
line the servo falls back from S.BUS, iBUS and RC-PWM (e-Manual, X330, Protocol Type (13))."""

_HISTORY = 16
_INVERTER_OFF, _RUNNING, _FAULT = 2, 5, 8  # Values of Controller State (152) of the Y series
_CLEAR_TURNS = bytes.fromhex("01 44 58 4c 22")
_CLEAR_ERROR = bytes.fromhex("02 45 52 43 4c")
_BACK_UP = bytes.fromhex("01 43 54 52 4c")
_RESTORE = bytes.fromhex("02 43 54 52 4c")
_CLEARS_SINCE = 42
"""First firmware of MX (2.0) and X that supports Clear, and that rejects a broadcast reset of everything."""
_KEPT_BY_RESET = {0xFF: (), 0x01: ("id",), 0x02: ("id", "baud_rate", "baud_rate_bus")}


class Protocol2Servo(SimulatedServo):
    """Simulated servo of Protocol 2.0: X, P, PRO and Y, the XL-320, grippers, and MX with firmware for
    Protocol 2.0."""

    def __init__(self, memory: Memory, shaft: Shaft, note: Callable[[str], None]) -> None:
        self._errors = memory.table.errors
        self._has_error_code = self._errors.has_codes
        """True for the Y series, which reports errors in Error Code and keeps its turn count without
        power."""
        self._backup: dict[str, int] = {}
        self._shut_down = False
        self._check_ns: int | None = None  # Time of the next Bus Watchdog check; None: no check
        super().__init__(memory, torque_error, shaft, note)
        # Addresses between items can be read, as 0, but not cells without any item
        self.line.has_gaps = 0
        if self._errors.item in memory:
            item = memory.table.items[self._errors.item]
            self.line.error_at, self.line.error_size = item.address, item.size
        memory.watch_items(("firmware_version",), self._support_group_reads)
        memory.watch_items(("bus_watchdog", "torque_enable"), self._plan_watchdog)

    def _identify(self) -> None:
        super()._identify()
        self.line.speaks = self.registers.get("protocol_type", 2) in _SPEAKS

    # Instructions

    def _support_group_reads(self) -> None:
        first = self.registers.table.fast_sync_read_firmware
        fast = first is not None and self.registers["firmware_version"] >= first
        self.line.group_reads = SYNC_READ | BULK_READ | (fast and FAST_SYNC_READ | FAST_BULK_READ)

    def decline_group_read(self, packet: InstructionPacket, entries: int, *, failed: bool) -> None:
        """Note that the servo does not reply to a fast read."""
        self._stay_out(packet)

    def _manage(self, packet: InstructionPacket) -> int:
        """Execute an instruction other than reads and writes; return an instruction error for an unknown one.

        An instruction to the Secondary ID must not change the EEPROM [i]."""
        error: int | None = None
        match packet.instruction, packet.parameters:
            case Instruction.REBOOT, b"":
                self.reboot()
                error = 0
            case Instruction.FACTORY_RESET, parameters if len(parameters) == 1:
                error = self._reset(parameters[0], packet.servo_id)
            case Instruction.CLEAR, parameters if parameters == _CLEAR_TURNS and self._clears:
                error = self.clear_turns()
            case Instruction.CLEAR, parameters if parameters == _CLEAR_ERROR and self._has_error_code:
                error = self.clear_error()
            case Instruction.CONTROL_TABLE_BACKUP, parameters if parameters == _BACK_UP and self.keeps_backup:
                error = self.back_up()
            case Instruction.CONTROL_TABLE_BACKUP, parameters if parameters == _RESTORE and self.keeps_backup:
                shadow = packet.servo_id == self.secondary_id
                error = StatusErrorNumber.ACCESS if shadow else self.restore_backup()
        return super()._manage(packet) if error is None else error

    @property
    def _clears(self) -> bool:
        """True if the servo supports Clear: MX (2.0) and X since firmware 42; P and Y [i], not the XL-320."""
        registers = self.registers
        of_x = registers.table.items["torque_enable"].address == 64
        old = of_x and registers["firmware_version"] < _CLEARS_SINCE
        return "operating_mode" in registers and not old

    def _reset(self, option: int, servo_id: int) -> int:
        if servo_id == self.secondary_id:
            return StatusErrorNumber.ACCESS
        kept = _KEPT_BY_RESET.get(option)
        # e-Manual, Factory Reset: a broadcast reset of everything "will NOT be activated".
        if kept is None or (option == 0xFF and servo_id == BROADCAST and self._clears):
            return StatusErrorNumber.INSTRUCTION
        self.registers.restore_factory_values(keep=kept)
        self.reboot()
        return 0

    # Bus Watchdog: its time restarts with each instruction to the servo. The manual does not mention whether
    # instructions to other servos restart it as well [?].

    def _plan_watchdog(self) -> None:
        units = self._watchdog_units()
        end_ns = self.line.received_ns + units * WATCHDOG_UNIT_NS
        if units and (self._check_ns is None or end_ns < self._check_ns):
            self._check_ns = end_ns
            self.shaft.mechanics.call_at(end_ns, lambda: self._check_watchdog(end_ns))

    def _watchdog_units(self) -> int:
        """Return the timeout of the Bus Watchdog in units of WATCHDOG_UNIT_NS; 0 while the watchdog is not
        running."""
        registers = self.registers
        units = registers.get("bus_watchdog")
        return units if units and registers.get("torque_enable") and not watchdog_expired(registers) else 0

    def _check_watchdog(self, at_ns: int) -> None:
        """Stop the servo if its Bus Watchdog has expired; otherwise schedule the next check."""
        if at_ns != self._check_ns:
            return  # A shorter timeout was set in the meantime
        self._check_ns = None
        units = self._watchdog_units()
        if not units or self.shaft.mechanics.grid_ns < self.line.received_ns + units * WATCHDOG_UNIT_NS:
            self._plan_watchdog()
            return
        self.note(f"servo {self.servo_id}: bus watchdog after {units * 20} ms")
        for name in ACCESS.profile:  # e-Manual, X series, Bus Watchdog (98), step 4 of the example.
            if name in self.registers:
                self._set(name, 0)
        self._set("bus_watchdog", -1)

    # Protection

    def _refusal(self, run: Run) -> int:
        """Return the error number with which the servo rejects a write, 0 if it accepts the write.

        After a shutdown torque stays off until a reboot: a result fail [i]."""
        torque = self._shut_down and run.after.get("torque_enable")
        return super()._refusal(run) or (StatusErrorNumber.RESULT_FAIL if torque else 0)

    def apply_protection(self, refused: int = 0) -> None:
        """Show active errors in the registers, and switch torque off until a reboot if Shutdown lists one
        of them."""
        registers = self.registers
        wrong = self._wrong()
        if self._has_error_code:
            self._show_error_code(wrong)
        latched = registers.get("hardware_error_status") if self._shut_down else 0
        shown = 0 if self._has_error_code else sum(wrong)
        registers.show_value("hardware_error_status", shown | latched)
        listed = bool(wrong) if self._has_error_code else shown & registers.get("shutdown")
        if listed and not self._shut_down:
            self._shut_down = True
            named = f"error code {registers['error_code']:#04x}" if self._has_error_code else f"{shown:#04x}"
            self.note(f"servo {self.servo_id}: shutdown, torque off: hardware error status {named}")
            registers["torque_enable"] = 0
            self.shaft.plan(("torque_enable",))
        self._show_controller_state()

    def reboot(self) -> None:
        """Restart the servo, which receives nothing until the restart is complete."""
        self.note(f"servo {self.servo_id}: reboot")
        self.power_up()
        self._receive_nothing_until(self.shaft.now_ns + self.boot_ns)

    def power_up(self) -> None:
        """Set RAM and angle as at power-up; only the Y series keeps its turn count."""
        angle = self.shaft.angle
        super().power_up()
        if self._has_error_code:
            self._recount(angle)

    def clear_turns(self) -> int:
        """Count Present Position within one turn (instruction Clear); return an error while the servo moves,
        0 on success.

        On the Y series torque must be off as well, and the servo reboots. The position becomes the goal
        [i]."""
        if self.shaft.moving or (self._has_error_code and self.registers.get("torque_enable")):
            return StatusErrorNumber.RESULT_FAIL
        self._recount(self.shaft.within_a_turn(self.shaft.angle))
        if self._has_error_code:
            self.reboot()
        return 0

    def clear_error(self) -> int:
        """Clear Error Code (instruction Clear); return an error while a cause is active (e-Manual, Y
        series), 0 on success."""
        if self._wrong():
            return StatusErrorNumber.RESULT_FAIL
        self.registers["error_code"] = 0
        self.registers.reset(f"error_code_history_{number}" for number in range(1, _HISTORY + 1))
        self._shut_down = False
        self._show_controller_state()
        return 0

    @property
    def keeps_backup(self) -> bool:
        """True if the servo supports Control Table Backup; it then has the item Backup Ready.

        e-Manual, Protocol 2.0, Control Table Backup (0x20), and the models' pages, Backup Ready."""
        return "backup_ready" in self.registers

    def back_up(self) -> int:
        """Store EEPROM, gains, profile and indirect addresses in the servo's backup; return an error while
        torque is on, 0 on success.

        P does not store indirect addresses; neither does Y [i]."""
        registers = self.registers
        if registers.get("torque_enable"):
            return StatusErrorNumber.RESULT_FAIL
        self._backup = {
            name: registers[name] for name, item in registers.table.items.items() if _is_kept(name, item)
        }
        registers.show_value("backup_ready", 1)
        return 0

    def restore_backup(self) -> int:
        """Restore the EEPROM from the servo's backup, and reboot; return an error while torque is on, or
        without a backup."""
        registers = self.registers
        if registers.get("torque_enable") or not self._backup:
            return StatusErrorNumber.RESULT_FAIL
        for name, wire in self._backup.items():
            if registers.table.items[name].area == "EEPROM":
                registers[name] = wire
        self.reboot()
        return 0

    def _recount(self, angle: float) -> None:
        self.shaft.recount_turns(angle)
        self.registers["goal_position"] = self.shaft.position_tick(angle)
        self.shaft.plan(("goal_position",))

    def _wrong(self) -> tuple[int, ...]:
        """Return the bits or codes of the hardware errors whose cause is active now."""
        registers, errors = self.registers, self._errors
        wrong = [errors.value_of("overload")] if self.overload else []
        if "max_voltage_limit" in registers:
            volts = round(self.voltage * 10)
            if volts < registers["min_voltage_limit"]:
                wrong.append(errors.value_of("low_voltage", "input_voltage"))
            elif volts > registers["max_voltage_limit"]:
                wrong.append(errors.value_of("over_voltage", "input_voltage"))
        limit = "motor_temperature_limit" if self._has_error_code else "temperature_limit"
        if round(self.temperature) > registers.get(limit, 255):
            wrong.append(errors.value_of("motor_overheating", "overheating"))
        return tuple(wrong)

    def _show_error_code(self, codes: tuple[int, ...]) -> None:
        """Show active errors in Error Code and its history. The same error does not count twice, and the
        history holds the last 16."""
        registers = self.registers
        names = [f"error_code_history_{number}" for number in range(1, _HISTORY + 1)]
        history = [registers[name] for name in names if registers[name]]
        for code in codes:
            if code not in history:
                history.append(code)
                registers["error_code"] = code
        for name, code in zip(names, history[-_HISTORY:], strict=False):
            registers[name] = code

    def _show_controller_state(self) -> None:
        registers = self.registers
        state = _RUNNING if registers.get("torque_enable") else _INVERTER_OFF
        registers.show_value("controller_state", _FAULT if self._shut_down else state)

    def _start_up(self) -> None:
        registers = self.registers
        self._shut_down = False
        self.shaft.state.started_ns = self.line.received_ns = self.shaft.now_ns
        if "torque_limit" in registers and "max_torque" in registers:
            registers["torque_limit"] = registers["max_torque"]
        registers.show_value("backup_ready", bool(self._backup))
        self._reset_goals()
        configuration = registers.get("startup_configuration")
        if configuration & RAM_FROM_BACKUP:
            for name, wire in self._backup.items():
                if registers.table.items[name].area == "RAM":
                    registers[name] = wire
        if configuration & TORQUE_ON_AT_START:
            registers["torque_enable"] = 1
        self.shaft.plan(("torque_enable",))

    def _written(self, names: frozenset[str]) -> None:
        registers = self.registers
        if "operating_mode" in names:
            self._change_mode()
        elif not _LIMITS.isdisjoint(names):
            self._reset_goals()
        if "torque_enable" in names and registers["torque_enable"]:
            self._find_turn()
        if "protocol_type" in names and registers["protocol_type"] not in _SPEAKS:
            self.note(f"servo {self.servo_id} left Protocol 2.0: protocol type {registers['protocol_type']}")
        by_goal = registers.get("drive_mode") & TORQUE_ON_BY_GOAL
        if (
            by_goal
            and not ACCESS.goals.isdisjoint(names)
            and "torque_enable" not in names
            and not self._shut_down
        ):
            registers["torque_enable"] = 1
        if self._has_error_code:
            self._show_controller_state()
        super()._written(names)

    def _change_mode(self) -> None:
        """Apply the effects of a new operating mode (e-Manual, X series, Operating Mode (11)).

        Gains, profile and the limiting goals are reset; position control has only one turn."""
        registers = self.registers
        registers.reset((*ACCESS.gains, *ACCESS.profile))
        self._find_turn()
        registers["goal_position"] = self.shaft.position_tick(self.shaft.angle)
        registers.show_value("goal_velocity", 0)
        self._reset_goals()

    def _find_turn(self) -> None:
        """Count Present Position within the one turn of position control, if the servo is in that mode.

        e-Manual, X series, Torque Enable (64): it is reset after a change of mode or torque."""
        shaft = self.shaft
        if self.registers.get("operating_mode") != OperatingMode.POSITION or self._has_error_code:
            return
        inside = shaft.within_a_turn(shaft.angle)
        if abs(inside - shaft.angle) > math.pi:
            shaft.recount_turns(inside)

    def _reset_goals(self) -> None:
        """Set Goal PWM and Goal Current to their limits, or to 0 in the mode that follows them [i]."""
        registers = self.registers
        mode = registers.get("operating_mode")
        for goal, limit, obeyed in (
            ("goal_pwm", "pwm_limit", OperatingMode.PWM),
            ("goal_current", "current_limit", OperatingMode.CURRENT),
        ):
            if limit in registers:
                registers.show_value(goal, 0 if mode == obeyed else registers[limit])


def _is_kept(name: str, item: ControlItem) -> bool:
    """Return True if the servo's backup includes an item (e-Manual, Protocol 2.0, Control Table Backup
    (0x20))."""
    if name.startswith("indirect_address_"):
        return item.area == "RAM"
    return item.access == "RW" and (item.area == "EEPROM" or name in (*ACCESS.gains, *ACCESS.profile))
