"""Making: builds the simulated servo of a model, with its table, motor, shaft and protocol."""

from __future__ import annotations

from collections.abc import Callable

from dxlsim.motion.joint_shaft import JointShaft
from dxlsim.motion.mechanics import Mechanics
from dxlsim.motion.mode_shaft import ModeShaft
from dxlsim.motion.motor import motor_of
from dxlsim.registers.memory import Memory
from dxlsim.servo.node import baud_item, baud_value
from dxlsim.servo.protocol2_servo import Protocol2Servo
from dxlsim.servo.simulated_servo import Protocol1Servo, SimulatedServo
from dxlsim.simulation_plan import ServoConfig
from dxlwire.control_table import ControlTable, find_table, models_by_number

FIRMWARE = {1.0: 24, 2.0: 45}
"""Firmware version of a simulated servo by protocol, unless its table requires a newer one; the manual
gives none."""


def make_servo(
    config: ServoConfig,
    baud_rate: int,
    start_ns: int,
    note: Callable[[str], None] | None = None,
    protocol: float = 1.0,
    *,
    mechanics: Mechanics | None = None,
) -> SimulatedServo:
    """Return a simulated servo that was just switched on, with a baud rate in bit/s.

    Raises:
        LookupError: The model has no control table.
        ValueError: The model does not support the baud rate.
    """
    table = _table(config, protocol)
    firmware = config.firmware
    if firmware is None:
        firmware = max(FIRMWARE[table.protocol], table.firmware, table.fast_sync_read_firmware or 0)
    memory = Memory(table, firmware)
    motor = motor_of(table, config.motor)
    shaft = (ModeShaft if "operating_mode" in table.items else JointShaft)(
        memory, mechanics or Mechanics(start_ns), motor, config.load, config.position
    )
    servo = (Protocol1Servo if table.protocol == 1.0 else Protocol2Servo)(
        memory, shaft, note or (lambda text: None)
    )
    servo.write_time_ns = config.times.write_time_ns
    memory["id"] = config.servo_id
    memory[baud_item(memory)] = baud_value(table, baud_rate)
    if config.homing_offset:
        memory["homing_offset"] = config.homing_offset
    memory["return_delay_time"] = min(254, round(config.return_delay_ns / 2000))
    servo.power_up()
    shaft.response_delay_ns = config.times.response_delay_ns
    return servo


def _table(config: ServoConfig, protocol: float) -> ControlTable:
    table = find_table(config.model, protocol)
    if config.firmware is None:
        return table
    return next(iter(models_by_number(table.model_number, protocol, config.firmware)), table)
