"""Inspection of a servo of Protocol 1.0: AX, RX, EX, DX, and MX with old firmware."""

from __future__ import annotations

from dxlrun.dynamixel.control_table import ControlTable
from dxlrun.dynamixel.plan.bus_plan import ServoPlan
from dxlrun.dynamixel.registers.inspection import Inspector, persist
from dxlrun.dynamixel.wire.protocol1 import StatusError, describe_error
from dxlrun.dynamixel.wire.transaction import Program, Reply

FORBIDDEN = StatusError.INPUT_VOLTAGE | StatusError.OVERHEATING | StatusError.OVERLOAD
"""States of a servo in which it gets no torque; the other bits tell of one instruction."""
_BLOCKS = (
    ("model_number", "firmware_version"),
    ("return_delay_time", "ccw_angle_limit"),
    ("status_return_level", "status_return_level"),
    ("torque_enable", "torque_limit"),
)
_NEUTRAL = (
    ("multi_turn_offset", 0, "which shifts every position"),
    ("resolution_divider", 1, "which changes what a tick is"),
    ("drive_mode", 0, "so it turns the other way round or follows another servo"),
)
"""Registers that only some models (MX, EX) have."""


class Inspector1(Inspector):
    """Reads a servo's registers in a few blocks."""

    def registers(self, servo: ServoPlan) -> Program[bool]:
        """Read what must fit the plan; return False when the servo cannot be read."""
        table = self.table(servo)
        blocks: dict[str, Reply] = {}
        for first, last in _BLOCKS:
            start, end = table.items[first].address, table.items[last].address + table.items[last].size
            blocks[first] = yield from persist(self.line.read(servo.servo_id, start, end - start))
            if not blocks[first].answered:
                self.unreadable(servo, blocks[first])
                return False
        error = blocks["torque_enable"].error & FORBIDDEN
        if error:
            self.problem(servo, f"reports an error: {describe_error(error)}")
        self.identity(servo, blocks["model_number"].word(), blocks["model_number"].parameters[2])
        self._angle_limits(servo, blocks["return_delay_time"])
        delay, level = (blocks[name].parameters[0] for name in ("return_delay_time", "status_return_level"))
        self.return_delay(servo, self.after_start(servo, "return_delay_time", delay))
        self.return_level(servo, self.after_start(servo, "status_return_level", level))
        self._torque(servo, table, blocks["torque_enable"])
        return (yield from self._neutral(servo, table))

    def _neutral(self, servo: ServoPlan, table: ControlTable) -> Program[bool]:
        for name, wanted, why in _NEUTRAL:
            item = table.items.get(name)
            if item is None:
                continue
            reply = yield from persist(self.line.read(servo.servo_id, item.address, item.size))
            if not reply.answered:
                self.unreadable(servo, reply)
                return False
            raw = self.after_start(servo, name, item.decode(reply.parameters))
            self.neutral(servo, item, raw, wanted, why)
        return True

    def _angle_limits(self, servo: ServoPlan, block: Reply) -> None:
        clockwise, counter = block.word(2, 1), block.word(2, 3)
        # the torque control mode is RAM and only of some models: it is not asked for here
        found = {"cw_angle_limit": clockwise, "ccw_angle_limit": counter, "torque_ctrl_mode_enable": 0}
        self.mode(servo, found)
        if clockwise < counter and not servo.continuous:  # else the start brings it into its mode
            self.limits(servo, clockwise, counter, "angle limits")

    def _torque(self, servo: ServoPlan, table: ControlTable, block: Reply) -> None:
        self.torque(servo, block.parameters[0])
        limit = block.word(2, table.items["torque_limit"].address - table.items["torque_enable"].address)
        if limit == 0:
            self.problem(
                servo,
                "has Torque Limit (34) = 0: it shut itself down after overload or overheating; find the "
                "cause, then switch its power off and on",
            )
