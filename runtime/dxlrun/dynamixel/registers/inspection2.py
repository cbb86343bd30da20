"""Inspection of a servo of Protocol 2.0: X, P, PRO, XL-320, and MX with new firmware.

Models differ in what they have, so each register is read by itself, where the control table names it.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from dxlrun.dynamixel.plan.bus_plan import ServoPlan
from dxlrun.dynamixel.registers.inspection import Inspector, called, persist, shown, tripped
from dxlrun.dynamixel.wire.protocol2 import describe_hardware_error
from dxlrun.dynamixel.wire.transaction import Program

ITEMS = (
    "model_number",
    "firmware_version",
    "return_delay_time",
    "drive_mode",
    "operating_mode",
    "control_mode",
    "homing_offset",
    "min_position_limit",
    "max_position_limit",
    "cw_angle_limit",
    "ccw_angle_limit",
    "startup_configuration",
    "profile_acceleration",
    "torque_enable",
    "status_return_level",
    "hardware_error_status",
    "bus_watchdog",
)
"""What is looked at, where a model has it."""
_DRIVE_BITS: Mapping[int, str] = MappingProxyType(
    {
        0x01: "turns the other way round",
        0x02: "follows another servo",
        0x04: "takes profiles for times",
        0x08: "switches torque on by every goal",
    }
)
"""e-Manual XM430-W350, XM540, Drive Mode (10)"""


class Inspector2(Inspector):
    """Reads a servo's registers one by one."""

    def registers(self, servo: ServoPlan) -> Program[bool]:
        """Read what must fit the plan; return False when the servo cannot be read."""
        items = self.table(servo).items
        found: dict[str, int] = {}
        for name in ITEMS:
            if (item := items.get(name)) is None or item.firmware > found.get(
                "firmware_version", item.firmware
            ):
                continue
            reply = yield from persist(self.line.read(servo.servo_id, item.address, item.size))
            if not reply.answered:
                self.unreadable(servo, reply)
                return False
            found[name] = self.after_start(servo, name, item.decode(reply.parameters))
        self.identity(servo, found["model_number"], found["firmware_version"])
        self._declared(servo, found["firmware_version"])
        self.return_delay(servo, found["return_delay_time"])
        self.return_level(servo, found["status_return_level"])
        self._modes(servo, found)
        self._limits(servo, found)
        self._start_up(servo, found.get("startup_configuration", 0))
        self._state(servo, found)
        self._ramp(servo, found.get("profile_acceleration", 0))
        self.torque(servo, found["torque_enable"])
        return True

    def _declared(self, servo: ServoPlan, firmware: int) -> None:
        """Refuse registers of the robot file that came with a newer firmware: the servo has no such item."""
        items = self.table(servo).items
        for item in (items[one.name] for one in servo.registers):
            if item.firmware > firmware:
                self.problem(
                    servo,
                    f"has firmware {firmware}, but {called(item)}, which the robot file declares, came with "
                    f"firmware {item.firmware}: take it out of `registers`, or update the servo",
                )

    def _modes(self, servo: ServoPlan, found: Mapping[str, int]) -> None:
        items = self.table(servo).items
        self.mode(servo, found)
        drive = found.get("drive_mode", 0)
        if drive:
            what = " and ".join(words for bit, words in _DRIVE_BITS.items() if drive & bit) or "is unknown"
            self.neutral(servo, items["drive_mode"], drive, 0, f"so it {what}")
        if "homing_offset" in found:
            offset = found["homing_offset"]
            self.neutral(servo, items["homing_offset"], offset, 0, "which shifts every position")

    def _limits(self, servo: ServoPlan, found: Mapping[str, int]) -> None:
        if servo.continuous:
            return
        for low, high, names in (
            ("min_position_limit", "max_position_limit", "position limits"),
            ("cw_angle_limit", "ccw_angle_limit", "angle limits"),
        ):
            if low in found and high in found:
                self.limits(servo, found[low], found[high], names)

    def _start_up(self, servo: ServoPlan, raw: int) -> None:
        if raw & 0x01:
            item = self.table(servo).items["startup_configuration"]
            self.problem(
                servo,
                f"has {called(item)} = {raw}, so it switches torque on by itself at power-up: clear bit 0",
            )
        if raw & 0x02:
            self.found.differences.append(
                (servo.joint, "Startup Configuration bit 1 is set: RAM comes from the backup at power-up")
            )

    def _ramp(self, servo: ServoPlan, raw: int) -> None:
        """Tell of a ramp that another program left in RAM: nothing here writes it, and goals come late."""
        item = self.table(servo).items.get("profile_acceleration")
        if item is not None and raw not in (0, item.initial):
            text = (
                f"{called(item)} is {raw}: it reaches its goals late; write 0 there, or switch it off and on"
            )
            self.found.differences.append((servo.joint, text))

    def _state(self, servo: ServoPlan, found: Mapping[str, int]) -> None:
        items = self.table(servo).items
        if error := found.get("hardware_error_status", 0):
            self.problem(
                servo,
                f"reports in {called(items['hardware_error_status'])}: {describe_hardware_error(error)}; "
                "find the cause, then reboot it",
            )
        # whatever an earlier run left is cleared at the start; it is told where the run arms none itself
        watchdog = 0 if self.plan.watchdog_ticks else found.get("bus_watchdog", 0)
        if watchdog:
            item = items["bus_watchdog"]
            what = f"it would stop after {watchdog * 20} ms without an instruction"
            if tripped(item, watchdog):
                what = "it has stopped the servo"
            self.found.differences.append(
                (servo.joint, f"{called(item)} is {shown(item, watchdog)}, {what}; it is cleared")
            )
