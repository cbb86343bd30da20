"""Properties of a servo that are known before its identification: from plan, control table and manual."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import msgspec

from dxlrun import InputError, Log
from dxlrun.tooling.files import suggestion
from dxlrun.tooling.logs import UNREADABLE
from dxlrun.tooling.plans import Plan, from_json
from dxlrun_lab.guided.choice import require_own_servos
from dxlrun_lab.identify.model import Control
from dxlsim import SAMPLING_S, SLOPE_TICK, SLOPE_TIMES_P, Motor, motor_of
from dxlwire import ControlTable, find_table


class Servo(msgspec.Struct, frozen=True):
    """Servo of a joint, with the properties that its identification needs"""

    joint: str
    table: ControlTable
    reference: float
    """Angle of the servo at the joint position 0, rad"""
    direction: int
    """1 if the servo's angle rises with the joint position, else -1"""
    declared: Mapping[str, int] = msgspec.field(default_factory=dict)
    """Values of the registers that the robot file declares, by name"""

    @property
    def tick(self) -> float:
        """Resolution of the position, rad"""
        return self.table.rad_per_tick

    @property
    def measures_current(self) -> bool:
        """True if the servo's effort is a current, A; False if it is the fraction of full voltage"""
        return self.table.effort_unit == "A"

    @property
    def voltage_step(self) -> float:
        """Resolution of the reported voltage, V"""
        items = self.table.items
        item = items.get("present_input_voltage") or items.get("present_voltage")
        return 0.1 if item is None else item.scale

    @property
    def built_in(self) -> Motor:
        """Parameters with which the simulation (dxlsim) moves this servo model"""
        return motor_of(self.table)

    @property
    def p_gain_item(self) -> str | None:
        """Name of the register of the P gain; None for a servo with compliance slopes"""
        return next((name for name in ("position_p_gain", "p_gain") if name in self.table.items), None)

    @property
    def p_gain(self) -> int | None:
        """Value of the P gain register, declared or factory default; None without such register"""
        return None if self.p_gain_item is None else self.register(self.p_gain_item)

    def register(self, name: str, otherwise: int = 0) -> int:
        """Return the value of a register that the robot file declares, or else its factory default.

        `otherwise` is returned if the model lacks the register or the default is unknown.
        """
        if name in self.declared:
            return self.declared[name]
        item = self.table.items.get(name)
        return otherwise if item is None or item.initial is None else item.initial

    def manual_gain(self) -> float:
        """Return the gain of the position control by the manual, duty per rad; 0 if not documented.

        On the X series, it is Position P Gain / 128 in PWM units per tick (e-Manual, X series, 84). The P
        gain 32 of the MX is as stiff as a compliance slope of 32, which reaches full duty in 32 units of 300
        / 1023 deg (RX-28, AX-12A).
        """
        table = self.table
        if self.p_gain_item == "position_p_gain":
            if "goal_pwm" not in table.items:
                return 0.0
            return self.register("position_p_gain") / 128 * table.items["goal_pwm"].scale / table.rad_per_tick
        if self.p_gain_item == "p_gain":
            return self.register("p_gain") / (SLOPE_TIMES_P * SLOPE_TICK)
        if "ccw_compliance_slope" not in table.items:
            return 0.0
        slope = min(128, 1 << max(1, self.register("ccw_compliance_slope").bit_length() - 1))
        return (1.0 - self.control().punch) / (slope * SLOPE_TICK)

    def expected_gain(self) -> tuple[float, str]:
        """Return the expected gain of the position control, duty per rad of error, and its source as text."""
        built_in = self.built_in
        if built_in.p_gain_duty and self.p_gain:
            return built_in.p_gain_duty * self.p_gain, built_in.gain_source
        return self.manual_gain(), "the manual"

    def control(self, *, by_position: bool = True) -> Control:
        """Return the properties of the servo's control except its gain, from its registers.

        Raises InputError for an integral gain or an acceleration profile, which are not modelled.
        """
        for name in ("position_i_gain", "i_gain"):
            if self.register(name):
                raise InputError(
                    f"{self.joint} has {name} {self.register(name)}, but the model has no integral gain; "
                    f"declare `registers: {{{name}: 0}}` and measure again"
                )
        for name in ("profile_acceleration", "goal_acceleration"):
            if self.register(name):
                raise InputError(
                    f"{self.joint} has {name} {self.register(name)}, but the model has no profile; "
                    f"declare `registers: {{{name}: 0}}` and measure again"
                )
        items, p = self.table.items, self.p_gain
        full = items["goal_pwm"].scale if "goal_pwm" in items else 1 / 1023
        limit = self.register("pwm_limit" if "pwm_limit" in items else "max_torque", 1023) * full
        damping_s = 0.0
        if p and self.p_gain_item == "position_p_gain":
            damping_s = self.register("position_d_gain") / 16 * SAMPLING_S / (p / 128)
        elif p:
            damping_s = self.register("d_gain") * 4 / 1000 / (p / 8)
        punch = 0.0 if p is not None else self.register("punch") / 1023
        margin = self.register("ccw_compliance_margin") * self.tick
        return Control(
            min(1.0, limit), damping_s, max(margin, self.tick / 2 if punch else 0.0), punch, by_position
        )

    def rounded(self, goal: float) -> float:
        """Round a goal of the joint, rad, to the nearest tick of the servo."""
        if not math.isfinite(goal):
            return goal
        ticks = round((self.direction * goal + self.reference) / self.tick)
        return self.direction * (ticks * self.tick - self.reference)


def servo_of(plan: Plan, joint: str) -> Servo:
    """Return the first servo of a joint in a plan. Raises LookupError for an unknown servo model."""
    bus, servo = plan.servos_by_joint[joint][0]
    table = find_table(servo.model, bus.protocol)
    return Servo(joint, table, servo.reference, servo.direction, servo.declared)


def servos_in(log: Log, joints: Sequence[str]) -> list[Servo]:
    """Return the servos of joints, from the plan in a log.

    Raises InputError if a joint is unknown, is linear, or has several servos or a gear.
    """
    for joint in joints:
        if joint not in log.joints:
            raise InputError(f"{log.path}: no joint {joint}; {suggestion(joint, log.joints)}")
    try:
        plan = from_json(log.attachments.get("plan.json", b"{}"))
    except UNREADABLE as error:
        raise InputError(f"{log.path}: the plan in the log cannot be read: {error}") from error
    require_own_servos(plan, joints, "identify", gears=False)
    try:
        return [servo_of(plan, joint) for joint in joints]
    except LookupError as error:
        raise InputError(f"{log.path}: {error}") from error
