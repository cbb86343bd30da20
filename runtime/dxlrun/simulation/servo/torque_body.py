"""How a servo of Protocol 2.0 protects itself: Hardware Error Status, its latch, and the Bus Watchdog.

The Y series tells of errors by Error Code instead, each of which takes the torque away. Not modelled of it:
the time that switching its torque takes, its brake, and Controller State but for off, running and fault.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from collections.abc import Set as AbstractSet
from enum import IntFlag, unique

from dxlrun.dynamixel.control_table import ControlItem
from dxlrun.simulation.memory.access import OperatingMode, TorqueRules, watchdog_expired
from dxlrun.simulation.memory.cells import Memory, Run
from dxlrun.simulation.motion.shaft import Shaft
from dxlrun.simulation.servo.body import Body
from dxlrun.simulation.wire.protocol2 import ALERT, ErrorNumber

WATCHDOG_UNIT_NS = 20_000_000
TORQUE_ON_AT_START, RAM_FROM_BACKUP = 0x01, 0x02
"""Bits of Startup Configuration (60)."""
TORQUE_ON_BY_GOAL = 0x08
"""Bit of Drive Mode (10): a goal switches the torque on."""

_GOALS = frozenset(("goal_pwm", "goal_current", "goal_velocity", "goal_position"))


@unique
class HardwareError(IntFlag):
    """Hardware Error Status (70) and Shutdown (63)."""

    VOLTAGE = 0x01
    OVERHEATING = 0x04
    ENCODER = 0x08
    SHOCK = 0x10
    OVERLOAD = 0x20


_GAINS = (
    "velocity_i_gain",
    "velocity_p_gain",
    "position_d_gain",
    "position_i_gain",
    "position_p_gain",
    "feedforward_2nd_gain",
    "feedforward_1st_gain",
)
_LIMITS = frozenset(("pwm_limit", "current_limit"))
_PROFILE = ("profile_acceleration", "profile_velocity")
_SPEAKS = (2, 20, 21, 22)
"""Values of Protocol Type (13) with which a servo hears Protocol 2.0: without a remote control on the line it
falls back from S.BUS, iBUS and RC-PWM (e-Manual, X330, Protocol Type (13))."""

_XL320_BIT = {HardwareError.OVERLOAD: 0x01, HardwareError.OVERHEATING: 0x02, HardwareError.VOLTAGE: 0x04}
"""The XL-320 orders them otherwise (e-Manual, XL-320, Shutdown (18))."""

_ERROR_CODE = {HardwareError.OVERLOAD: 0x05, HardwareError.OVERHEATING: 0x04}
_OVER_VOLTAGE, _LOW_VOLTAGE = 0x01, 0x02
"""Error Code (153) of the Y series; the other codes are not modelled. Source: the maker's ROS package
dynamixel_hardware_interface, ErrorCodeTable."""
_HISTORY = 16
_INVERTER_OFF, _RUNNING, _FAULT = 2, 5, 8
"""Controller State (152) of the Y series."""


class TorqueBody(Body):
    """A servo of Protocol 2.0."""

    def __init__(self, memory: Memory, shaft: Shaft, note: Callable[[str], None]) -> None:
        super().__init__(memory, shaft, note)
        self._rules = TorqueRules(memory)
        self.has_error_code = "error_code" in memory
        """True for the Y series, which keeps its turns without power, too."""
        self._alert = 0
        memory.watch(("error_code", "hardware_error_status"), self._alarm)
        self._backup: dict[str, int] = {}
        self._shut_down = False
        self._heard_ns = shaft.now_ns
        self._guarded = self._retimed = False
        """False while Bus Watchdog is 0, and while its time is the one that is looked after."""
        memory.watch(("bus_watchdog",), self._guard)
        self._looked_after_ns: int | None = None
        """When the Bus Watchdog is looked after next; None: never."""

    def hear(self, now_ns: int) -> None:
        """Take note of an instruction to it: the Bus Watchdog's time begins again.

        Whether those to other servos count is not said [?].
        """
        shaft = self.shaft
        shaft.advance(now_ns)
        self._heard_ns = shaft.now_ns
        if self._guarded and (self._looked_after_ns is None or self._retimed):
            self._watch()

    def _guard(self) -> None:
        self._guarded = self.memory.get("bus_watchdog") != 0
        self._retimed = True

    def _watch(self) -> None:
        """See to it that the Bus Watchdog is looked after when its time runs out, or before."""
        if not (units := self._watchdog_units()):
            return
        self._retimed = False
        end_ns = self._heard_ns + units * WATCHDOG_UNIT_NS
        if self._looked_after_ns is None or end_ns < self._looked_after_ns:
            self._looked_after_ns = end_ns
            self.shaft.mechanics.call_at(end_ns, lambda: self._stop_unheard(end_ns))

    def _watchdog_units(self) -> int:
        """Return for how long the Bus Watchdog waits, in its unit; 0 while it does not."""
        memory = self.memory
        units = memory.get("bus_watchdog")
        return units if units and memory.get("torque_enable") and not watchdog_expired(memory) else 0

    def _stop_unheard(self, at_ns: int) -> None:
        """Stop where the Bus Watchdog's time has run out; else look again when it does."""
        if at_ns != self._looked_after_ns:
            return  # its time was made shorter since
        self._looked_after_ns = None
        units = self._watchdog_units()
        if not units or self.shaft.mechanics.grid_ns < self._heard_ns + units * WATCHDOG_UNIT_NS:
            self._watch()
            return
        self.note(f"servo {self.servo_id}: bus watchdog after {units * 20} ms")
        for name in _PROFILE:  # e-Manual, X series, Bus Watchdog (98), step 4 of the example
            if name in self.memory:
                self.poke(name, 0)
        self.poke("bus_watchdog", -1)

    def refusal(self, run: Run) -> int:
        """Return the error number of a write, 0 when it is allowed.

        After a shutdown the torque stays off until a reboot: a result fail [i].
        """
        error = self._rules.refusal(run)
        if not error and self._shut_down and run.after.get("torque_enable"):
            return ErrorNumber.RESULT_FAIL
        return error

    def state(self) -> int:
        """Return the alert bit while Hardware Error Status or Error Code tells of something."""
        return self._alert

    def _alarm(self) -> None:
        told = self.memory.get("error_code" if self.has_error_code else "hardware_error_status")
        self._alert = ALERT if told else 0

    def protect(self, refused: int = 0) -> None:
        """Show what is wrong, and switch the torque off until a reboot when Shutdown lists it."""
        memory = self.memory
        wrong = self._wrong()
        if self.has_error_code:
            self._tell_error_code(wrong)
        latched = memory.get("hardware_error_status") if self._shut_down else 0
        shown = sum(_XL320_BIT[each] if "control_mode" in memory else each for each in wrong)
        memory.show("hardware_error_status", shown | latched)
        listed = bool(wrong) if self.has_error_code else shown & memory.get("shutdown")
        if listed and not self._shut_down:
            self._shut_down = True
            named = f"error code {memory['error_code']:#04x}" if self.has_error_code else f"{shown:#04x}"
            self.note(f"servo {self.servo_id}: shutdown, torque off: hardware error status {named}")
            memory["torque_enable"] = 0
            self.shaft.plan(("torque_enable",))
        self._show_controller_state()

    def reboot(self) -> None:
        """Start again; the servo is deaf until it has."""
        self.note(f"servo {self.servo_id}: reboot")
        self.power_up()
        self.deaf_until_ns = self.shaft.now_ns + self.boot_ns
        self.memory.version += 1

    def power_up(self) -> None:
        """Start: RAM is as it is at power-up, and so is the angle, but for the turns of the Y series."""
        angle = self.shaft.angle
        super().power_up()
        if self.has_error_code:
            self._rest_at(angle)

    def clear_turns(self) -> int:
        """Bring Present Position back into one turn; return the error: it must not move.

        The Y series wants the torque off as well, and reboots. The goal is then the position [i].
        """
        if self.shaft.moving or (self.has_error_code and self.memory.get("torque_enable")):
            return ErrorNumber.RESULT_FAIL
        self._rest_at(self.shaft.within_a_turn(self.shaft.angle))
        if self.has_error_code:
            self.reboot()
        return 0

    def clear_error(self) -> int:
        """Forget Error Code; return the error: what it tells of must be over (e-Manual, Y series)."""
        if self._wrong():
            return ErrorNumber.RESULT_FAIL
        self.memory["error_code"] = 0
        self.memory.reset(f"error_code_history_{number}" for number in range(1, _HISTORY + 1))
        self._shut_down = False
        self._show_controller_state()
        return 0

    @property
    def keeps_backup(self) -> bool:
        """True when it knows Control Table Backup: it then has Backup Ready.

        e-Manual, Protocol 2.0, Control Table Backup (0x20), and the models' pages, Backup Ready.
        """
        return "backup_ready" in self.memory

    def back_up(self) -> int:
        """Keep EEPROM, gains, profile and indirect addresses; return the error: the torque must be off.

        P keeps no indirect addresses; so does Y [i].
        """
        memory = self.memory
        if memory.get("torque_enable"):
            return ErrorNumber.RESULT_FAIL
        self._backup = {
            name: memory[name] for name, item in memory.table.items.items() if _is_kept(name, item)
        }
        memory.show("backup_ready", 1)
        return 0

    def restore_backup(self) -> int:
        """Take back the EEPROM that was kept, and reboot; return the error: torque off, and a backup."""
        memory = self.memory
        if memory.get("torque_enable") or not self._backup:
            return ErrorNumber.RESULT_FAIL
        for name, wire in self._backup.items():
            if memory.table.items[name].area == "EEPROM":
                memory[name] = wire
        self.reboot()
        return 0

    def _rest_at(self, angle: float) -> None:
        self.shaft.rest_at(angle)
        self.memory["goal_position"] = self.shaft.position_tick(angle)
        self.shaft.plan(("goal_position",))

    def _wrong(self) -> tuple[HardwareError, ...]:
        memory = self.memory
        wrong = [HardwareError.OVERLOAD] if self.overload else []
        if "max_voltage_limit" in memory:
            volts = round(self.voltage * 10)
            if not memory["min_voltage_limit"] <= volts <= memory["max_voltage_limit"]:
                wrong.append(HardwareError.VOLTAGE)
        limit = "motor_temperature_limit" if self.has_error_code else "temperature_limit"
        if round(self.temperature) > memory.get(limit, 255):
            wrong.append(HardwareError.OVERHEATING)
        return tuple(wrong)

    def _tell_error_code(self, wrong: tuple[HardwareError, ...]) -> None:
        """Show the newest error; the same one does not count twice, and the history holds the last 16."""
        memory = self.memory
        low = round(self.voltage * 10) < memory["min_voltage_limit"]
        codes = [_ERROR_CODE.get(each, _LOW_VOLTAGE if low else _OVER_VOLTAGE) for each in wrong]
        names = [f"error_code_history_{number}" for number in range(1, _HISTORY + 1)]
        history = [memory[name] for name in names if memory[name]]
        for code in codes:
            if code not in history:
                history.append(code)
                memory["error_code"] = code
        for name, code in zip(names, history[-_HISTORY:], strict=False):
            memory[name] = code

    def _show_controller_state(self) -> None:
        memory = self.memory
        state = _RUNNING if memory.get("torque_enable") else _INVERTER_OFF
        memory.show("controller_state", _FAULT if self._shut_down else state)

    def _start_up(self) -> None:
        memory = self.memory
        self._shut_down = False
        self._started_ns = self._heard_ns = self.shaft.now_ns
        if "torque_limit" in memory and "max_torque" in memory:
            memory["torque_limit"] = memory["max_torque"]
        memory.show("backup_ready", bool(self._backup))
        self._reset_goals()
        configuration = memory.get("startup_configuration")
        if configuration & RAM_FROM_BACKUP:
            for name, wire in self._backup.items():
                if memory.table.items[name].area == "RAM":
                    memory[name] = wire
        if configuration & TORQUE_ON_AT_START:
            memory["torque_enable"] = 1
        self.shaft.plan(("torque_enable",))

    def _obey(self, names: AbstractSet[str]) -> None:
        memory = self.memory
        if "operating_mode" in names:
            self._change_mode()
        elif not _LIMITS.isdisjoint(names):
            self._reset_goals()
        if "torque_enable" in names and memory["torque_enable"]:
            self._find_turn()
        if "protocol_type" in names and memory["protocol_type"] not in _SPEAKS:
            self.note(
                f"servo {self.servo_id} hears Protocol 2.0 no more: protocol type {memory['protocol_type']}"
            )
        by_goal = memory.get("drive_mode") & TORQUE_ON_BY_GOAL
        if by_goal and not _GOALS.isdisjoint(names) and "torque_enable" not in names and not self._shut_down:
            memory["torque_enable"] = 1
        if self.has_error_code:
            self._show_controller_state()
        if self._guarded:
            self._watch()

    def _identify(self) -> None:
        super()._identify()
        self.hears_protocol = self.memory.get("protocol_type", 2) in _SPEAKS

    def _change_mode(self) -> None:
        """Begin with another operating mode as the manual says (e-Manual, X series, Operating Mode (11)).

        Gains, profile and the goals that limit are reset; position control knows one turn only.
        """
        memory = self.memory
        memory.reset((*_GAINS, *_PROFILE))
        self._find_turn()
        memory["goal_position"] = self.shaft.position_tick(self.shaft.angle)
        memory.show("goal_velocity", 0)
        self._reset_goals()

    def _find_turn(self) -> None:
        """Bring Present Position into the turn that position control knows.

        e-Manual, X series, Torque Enable (64): it is reset when mode or torque change.
        """
        shaft = self.shaft
        if self.memory.get("operating_mode") != OperatingMode.POSITION or self.has_error_code:
            return
        inside = shaft.within_a_turn(shaft.angle)
        if abs(inside - shaft.angle) > math.pi:
            shaft.rest_at(inside)

    def _reset_goals(self) -> None:
        """Set Goal PWM and Goal Current to their limits; to 0 in the mode that obeys them [i]."""
        memory = self.memory
        mode = memory.get("operating_mode")
        for goal, limit, obeyed in (
            ("goal_pwm", "pwm_limit", OperatingMode.PWM),
            ("goal_current", "current_limit", OperatingMode.CURRENT),
        ):
            if limit in memory:
                memory.show(goal, 0 if mode == obeyed else memory[limit])


def _is_kept(name: str, item: ControlItem) -> bool:
    """Return whether a backup holds an item (e-Manual, Protocol 2.0, Control Table Backup (0x20))."""
    if name.startswith("indirect_address_"):
        return item.area == "RAM"
    return item.access == "RW" and (item.area == "EEPROM" or name in _GAINS or name in _PROFILE)
