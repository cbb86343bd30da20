"""How a servo of Protocol 2.0 protects itself: Hardware Error Status, its latch, and the Bus Watchdog."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from enum import IntFlag, unique

from dxlrun.simulation.access import OperatingMode, TorqueRules, watchdog_expired
from dxlrun.simulation.body import Body
from dxlrun.simulation.memory import Memory
from dxlrun.simulation.protocol2 import ALERT, ErrorNumber
from dxlrun.simulation.shaft import Shaft

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


_XL320_BIT = {HardwareError.OVERLOAD: 0x01, HardwareError.OVERHEATING: 0x02, HardwareError.VOLTAGE: 0x04}
"""The XL-320 orders them otherwise (e-Manual, XL-320, Shutdown (18))."""


class TorqueBody(Body):
    """A servo of Protocol 2.0."""

    def __init__(self, memory: Memory, shaft: Shaft, note: Callable[[str], None]) -> None:
        super().__init__(memory, shaft, note)
        self._rules = TorqueRules(memory)
        self._backup: dict[str, int] = {}
        self._shut_down = False
        self._started_ns = shaft.now_ns
        self._heard_ns = shaft.now_ns

    def advance(self, now_ns: int) -> None:
        """Let time pass, and stop where the Bus Watchdog's time runs out."""
        units = self.memory.get("bus_watchdog")
        if units and self.memory.get("torque_enable") and not watchdog_expired(self.memory):
            end_ns = self._heard_ns + units * WATCHDOG_UNIT_NS
            if now_ns > end_ns:
                self.shaft.advance(end_ns)
                self.note(f"servo {self.servo_id}: bus watchdog after {units * 20} ms")
                self.poke("bus_watchdog", -1)
        super().advance(now_ns)

    def hear(self, now_ns: int) -> None:
        """Take note of an instruction: the Bus Watchdog's time begins again."""
        self.advance(now_ns)
        self._heard_ns = self.shaft.now_ns

    def refresh(self) -> None:
        """Bring all that can be read to the time."""
        super().refresh()
        elapsed_ms = (self.shaft.now_ns - self._started_ns) // 1_000_000
        self.memory.show("realtime_tick", elapsed_ms % 32768)

    def refusal(self, address: int, data: bytes) -> int:
        """Return the error number of a write, 0 when it is allowed.

        After a shutdown the torque stays off until a reboot: a result fail [i].
        """
        error = self._rules.refusal(address, data)
        if not error and self._shut_down and self.memory.would_be(address, data).get("torque_enable"):
            return ErrorNumber.RESULT_FAIL
        return error

    def state(self) -> int:
        """Return the alert bit while Hardware Error Status tells of something."""
        return ALERT if self.memory.get("hardware_error_status") else 0

    def protect(self, refused: int = 0) -> None:
        """Show what is wrong, and switch the torque off until a reboot when Shutdown lists it."""
        memory = self.memory
        wrong = self._wrong()
        latched = memory.get("hardware_error_status") if self._shut_down else 0
        memory.show("hardware_error_status", wrong | latched)
        if wrong & memory.get("shutdown") and not self._shut_down:
            self._shut_down = True
            self.note(f"servo {self.servo_id}: shutdown, torque off: hardware error status {wrong:#04x}")
            memory["torque_enable"] = 0
            self.shaft.plan(("torque_enable",))

    def reboot(self) -> None:
        """Start again; the servo is deaf until it has."""
        self.note(f"servo {self.servo_id}: reboot")
        self.power_up()
        self.deaf_until_ns = self.shaft.now_ns + self.boot_ns

    def clear_turns(self) -> int:
        """Bring Present Position back into one turn; return the error: it must not move."""
        if self.shaft.moving:
            return ErrorNumber.RESULT_FAIL
        self.shaft.rest_at(self.shaft.within_a_turn(self.shaft.angle))
        self.shaft.plan(("goal_position",))
        return 0

    def back_up(self) -> int:
        """Keep the control table; return the error: the torque must be off."""
        if self.memory.get("torque_enable"):
            return ErrorNumber.RESULT_FAIL
        self._backup = self.memory.backup()
        return 0

    def restore_backup(self) -> int:
        """Take the control table that was kept; return the error: torque must be off, one be kept."""
        if self.memory.get("torque_enable") or not self._backup:
            return ErrorNumber.RESULT_FAIL
        for name, wire in self._backup.items():
            self.memory[name] = wire
        return 0

    def _wrong(self) -> int:
        memory = self.memory
        wrong = [HardwareError.OVERLOAD] if self.overload else []
        if "max_voltage_limit" in memory:
            volts = round(self.voltage * 10)
            if not memory["min_voltage_limit"] <= volts <= memory["max_voltage_limit"]:
                wrong.append(HardwareError.VOLTAGE)
        if self.temperature > memory.get("temperature_limit", 255):
            wrong.append(HardwareError.OVERHEATING)
        by_control_mode = "control_mode" in memory
        return sum(_XL320_BIT[each] if by_control_mode else each for each in wrong)

    def _start_up(self) -> None:
        memory = self.memory
        self._shut_down = False
        self._started_ns = self._heard_ns = self.shaft.now_ns
        if "torque_limit" in memory and "max_torque" in memory:
            memory["torque_limit"] = memory["max_torque"]
        configuration = memory.get("startup_configuration")
        if configuration & RAM_FROM_BACKUP:
            for name, wire in self._backup.items():
                if memory.table.items[name].area == "RAM" and name != "torque_enable":
                    memory[name] = wire
        if configuration & TORQUE_ON_AT_START:
            memory["torque_enable"] = 1
        self.shaft.plan(("torque_enable",))

    def _obey(self, names: Iterable[str]) -> None:
        memory = self.memory
        if "operating_mode" in names:
            # e-Manual, Operating Mode (11): the goals are reset; position control knows one turn only.
            if memory["operating_mode"] == OperatingMode.POSITION:
                self.shaft.rest_at(self.shaft.within_a_turn(self.shaft.angle))
            memory["goal_position"] = self.shaft.position_tick(self.shaft.angle)
            memory.show("goal_velocity", 0)
        by_goal = memory.get("drive_mode") & TORQUE_ON_BY_GOAL
        if by_goal and not _GOALS.isdisjoint(names) and "torque_enable" not in names and not self._shut_down:
            memory["torque_enable"] = 1
