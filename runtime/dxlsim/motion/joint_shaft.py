"""Joint shaft: shaft of servos with angle limits and a moving speed: Protocol 1.0, and the XL-320."""

from __future__ import annotations

import math
from collections.abc import Mapping

from dxlsim.motion.compiled_mechanics import Counting, ShownQuantity
from dxlsim.motion.control_law import ServoCommand
from dxlsim.motion.mechanics import Mechanics
from dxlsim.motion.motor import Motor
from dxlsim.motion.shaft import LiveItem, Shaft
from dxlsim.registers.access import ACCESS, multi_turn_mode, wheel_mode
from dxlsim.registers.memory import Memory
from dxlsim.simulation_plan import Load

SLOPE_TICK = math.radians(300) / 1023
"""Unit of Compliance Slope (28), rad: 0x40 is about 18.8 degrees (manual of the RX-28, example 17)."""

SLOPE_TIMES_P = 1024
"""Product of compliance slope and P gain of equal stiffness: P gain 32 is as stiff as slope 32, 8 as slope
128 (e-Manual, MX-28, PID Gains (26, 27, 28)); an identified P gain (`Motor.p_gain_duty`) has priority."""

_MID_OF_CURRENT = {"current": 2048, "sensed_current": 512}
"""Value of an item at zero current: MX-64, Current (68), 4.5 mA a tick; EX-106+, Sensed Current (56), 10
mA a tick."""

_OF_COUNTING = (
    "cw_angle_limit",
    "ccw_angle_limit",
    "control_mode",
    "multi_turn_offset",
    "resolution_divider",
)
"""Items that decide how Present Position counts."""

_WHEEL_P, _WHEEL_I = 4.0, 40.0
"""Gains of speed control in wheel mode: duty per speed error, as a fraction of the no-load speed, and per
its integral, 1/s. A speed is reached in 0.12 s [i]."""


class JointShaft(Shaft):
    """Shaft of a servo with angle limits: joint, wheel and multi-turn mode; torque control mode on models
    with Goal Torque.

    In joint mode the trajectory has Moving Speed, and Goal Acceleration on models with this item; 0 means
    no limit. AX and RX models convert the error into torque by compliance margin, slope and punch, MX
    models and the XL-320 by PID gains. In wheel mode Moving Speed is an open-loop duty on AX and RX models
    (unit 0.1 %), and a controlled speed on MX models."""

    items = ACCESS.joint_shaft

    def __init__(self, memory: Memory, mechanics: Mechanics, motor: Motor, load: Load, angle: float) -> None:
        super().__init__(memory, mechanics, motor, load, angle)
        items = memory.table.items
        self.take_goal_items(("goal_position", "moving_speed", "goal_acceleration"))
        self.state.speed_unit = memory.table.rad_s_per_tick
        if "goal_acceleration" in items:
            self.state.acceleration_unit = items["goal_acceleration"].scale
        self.state.highest_tick = memory.table.max_tick
        self.state.noticed_speed = memory.table.rad_s_per_tick / 2
        memory.watch_items(_OF_COUNTING, self._count)

    def within_a_turn(self, angle: float) -> float:
        """Return the angle unchanged: at power-up these servos show the same angle as before."""
        return angle

    def live_items(self) -> Mapping[str, LiveItem]:
        """Return the items that show the motion; load and speed have the direction in bit 10."""
        table, items = self.memory.table, self.memory.table.items
        unit = table.rad_s_per_tick
        if wheel_mode(self.memory) and not self._controls_speed:
            unit = table.max_speed / table.max_speed_tick
        load = items["present_load"].scale
        live = {
            "present_position": LiveItem(ShownQuantity.POSITION),
            "present_speed": LiveItem(
                ShownQuantity.VELOCITY, unit, highest=table.max_speed_tick, sign_bit=10
            ),
            "present_load": LiveItem(ShownQuantity.DUTY, load, highest=1023, sign_bit=10),
            "moving": LiveItem(ShownQuantity.MOVING),
        }
        for name in _MID_OF_CURRENT.keys() & items.keys():
            scale, lowest, highest = items[name].scale, items[name].minimum, items[name].maximum
            zero = _MID_OF_CURRENT[name]
            live[name] = LiveItem(ShownQuantity.CURRENT, scale, zero=zero, lowest=lowest, highest=highest)
        return live

    def _count(self) -> None:
        """Let Present Position count as the mode requires."""
        memory, state = self.memory, self.state
        one_turn = Counting.WHEEL if wheel_mode(memory) else Counting.JOINT
        state.counting = Counting.TURNS if multi_turn_mode(memory) else one_turn
        state.divider = memory.get("resolution_divider", 1)
        state.offset = memory.ticks("multi_turn_offset") if "multi_turn_offset" in memory else 0
        self.show_items()

    @property
    def _controls_speed(self) -> bool:
        return "resolution_divider" in self.memory

    @property
    def _controls_position(self) -> bool:
        return not wheel_mode(self.memory) and not self.memory.get("torque_ctrl_mode_enable")

    def _command(self) -> ServoCommand:
        memory, table = self.memory, self.memory.table
        limit = memory["torque_limit"] / 1023
        if memory.get("torque_ctrl_mode_enable"):
            ampere = memory.ticks("goal_torque") * table.items["goal_torque"].scale
            torque = ampere * self.motor.torque_per_ampere
            return ServoCommand(bias=math.copysign(limit, torque), limit=limit, torque_limit=abs(torque))
        if wheel_mode(memory):
            return self._wheel(limit)
        return self._pid(limit) if "p_gain" in memory else self._compliance(limit)

    def _wheel(self, limit: float) -> ServoCommand:
        table, ticks = self.memory.table, self.memory.ticks("moving_speed")
        if not self._controls_speed:
            return ServoCommand(bias=ticks / table.max_speed_tick, limit=limit)
        stiff, damped = _WHEEL_I / table.max_speed, _WHEEL_P / table.max_speed
        speed = ticks * table.rad_s_per_tick
        return ServoCommand(turning=1.0, speed=speed, p_ccw=stiff, p_cw=stiff, d=damped, limit=limit)

    def _compliance(self, limit: float) -> ServoCommand:
        memory = self.memory
        punch = memory["punch"] / 1023
        unit = memory.table.rad_per_tick
        seen = unit / 2 if punch else 0.0  # An error below half a tick is not observable
        return ServoCommand(
            p_ccw=(1.0 - punch) / (_slope(memory["ccw_compliance_slope"]) * SLOPE_TICK),
            p_cw=(1.0 - punch) / (_slope(memory["cw_compliance_slope"]) * SLOPE_TICK),
            margin_ccw=max(seen, memory["ccw_compliance_margin"] * unit),
            margin_cw=max(seen, memory["cw_compliance_margin"] * unit),
            punch=punch,
            limit=limit,
        )

    def _pid(self, limit: float) -> ServoCommand:
        """Return the command of position control with the gains of MX servos: Kp = P / 8, Ki = I * 1000 /
        2048, Kd = D * 4 / 1000 (e-Manual, MX-28, PID Gains).

        All are in one unit. No manual describes an effect of Punch together with PID gains, so it has none
        here [?]."""
        memory = self.memory
        unit = 8 * (self.motor.p_gain_duty or 1 / (SLOPE_TIMES_P * SLOPE_TICK))
        p = memory["p_gain"] / 8 * unit
        return ServoCommand(
            p_ccw=p,
            p_cw=p,
            i=memory["i_gain"] * 1000 / 2048 * unit,
            d=memory["d_gain"] * 4 / 1000 * unit,
            limit=limit,
        )


def _slope(value: int) -> int:
    """Return the compliance slope that is in effect for a register value: the largest power of two up to the
    value, 2 to 128.

    e-Manual, AX-12A, Compliance Slope (28): "7 steps"."""
    return min(128, 1 << max(1, value.bit_length() - 1))
