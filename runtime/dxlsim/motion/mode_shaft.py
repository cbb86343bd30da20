"""Mode shaft: shaft of servos with an operating mode: Protocol 2.0 except the XL-320."""

from __future__ import annotations

import math
from collections.abc import Mapping

from dxlsim.motion.compiled_mechanics import ShownQuantity
from dxlsim.motion.control_law import FREE, LIMP, ServoCommand
from dxlsim.motion.mechanics import Mechanics
from dxlsim.motion.motor import Motor
from dxlsim.motion.shaft import LiveItem, Shaft, critical_d
from dxlsim.registers.access import ACCESS, OperatingMode, watchdog_expired
from dxlsim.registers.memory import Memory
from dxlsim.simulation_plan import Load

REVERSE, TIME_BASED = 0x01, 0x04
"""Bits of Drive Mode (10): clockwise is positive; Profile Velocity and Acceleration are durations in ms."""

_OF_POSITION = (
    OperatingMode.POSITION,
    OperatingMode.EXTENDED_POSITION,
    OperatingMode.CURRENT_BASED_POSITION,
)

SAMPLING_S = 1e-3
"""Sampling period (s) in the e-Manual's conversions of gains, which mention it without a value (X series,
Velocity PI Gain (76, 78) and Position PID Gain (80 to 84)). Gains refer to PWM units, ticks and
velocity units [i]."""

UNKNOWN_P = 150.0
"""P gain, duty per rad, if the manual gives no initial gain: the PRO, P and Y lines, and the grippers [i].

ROBOTIS' own examples for the PRO line wait until at most 20 ticks are left (DynamixelSDK,
c++/example/protocol2.0, DXL_MOVING_STATUS_THRESHOLD); friction takes 1.3 % of the duty, and 20 ticks of
the finest model are 0.000125 rad."""

UNKNOWN_VELOCITY_P, UNKNOWN_VELOCITY_I = 4.0, 40.0
"""Gains of velocity control for the same models: duty per speed error, as a fraction of the no-load speed,
and per its integral, 1/s [i]."""


class ModeShaft(Shaft):
    """Shaft of a servo with an operating mode: follows the goal of its mode, with the profile for the way to
    the goal.

    Profile Velocity 0 disables the profile (a step); Profile Acceleration 0 makes it rectangular
    (e-Manual, X series, Profile Velocity (112)). Velocity control uses only the acceleration."""

    items = ACCESS.mode_shaft

    def __init__(self, memory: Memory, mechanics: Mechanics, motor: Motor, load: Load, angle: float) -> None:
        super().__init__(memory, mechanics, motor, load, angle)
        items = memory.table.items
        self._speed_item = memory.table.goal_speed_item
        """Name of the item with the profile's speed: on PRO Goal Velocity (600), with Goal Acceleration
        (606)."""
        of_pro = self._speed_item == "goal_velocity"
        self._ramp_item = "goal_acceleration" if of_pro else "profile_acceleration"
        item = items.get(self._ramp_item)
        self._acceleration_unit = item.scale if item is not None else 1.0
        self._pwm_unit = items["goal_pwm"].scale if "goal_pwm" in items else 1 / 885
        self._current_unit = items["present_current"].scale if "present_current" in items else 0.001
        self._torque_item = items.get("goal_torque" if of_pro else "goal_current")
        self._scale = {name: item.scale for name, item in items.items()}
        self._rad_per_tick = memory.table.rad_per_tick
        self._sign, self._offset = 1, 0
        self.take_goal_items(("goal_position", self._speed_item, self._ramp_item))
        self.state.speed_unit = memory.table.rad_s_per_tick
        self.state.acceleration_unit = self._acceleration_unit
        memory.watch_items(("drive_mode", "homing_offset", "operating_mode"), self._orient)
        memory.watch_items(("moving_threshold",), self._set_threshold)
        self.show_items()

    def within_a_turn(self, angle: float) -> float:
        """Return the angle, rad, that the servo shows after power-up: within one turn of its encoder, 0 to
        4095 ticks, or centered at 0."""
        shown = self._sign * angle
        if self.memory.table.items["min_position_limit"].minimum < 0:
            return self._sign * (shown - math.tau * round(shown / math.tau))
        # Less than half a tick below 0 still counts as 0.
        half = self.memory.table.rad_per_tick / 2
        return self._sign * (shown - math.tau * math.floor((shown + half) / math.tau))

    def live_items(self) -> Mapping[str, LiveItem]:
        """Return the items that show the motion."""
        scale = self._scale
        velocity, trajectory = scale.get("present_velocity", 1.0), scale.get("velocity_trajectory", 1.0)
        return {
            "present_position": LiveItem(ShownQuantity.POSITION),
            "present_velocity": LiveItem(ShownQuantity.VELOCITY, velocity),
            "position_trajectory": LiveItem(ShownQuantity.SETPOINT),
            "velocity_trajectory": LiveItem(ShownQuantity.SETPOINT_VELOCITY, trajectory),
            "present_load": LiveItem(ShownQuantity.DUTY, times=1000),  # Unit 0.1 %, like the output
            "present_current": LiveItem(ShownQuantity.CURRENT, self._current_unit),
            "present_pwm": LiveItem(ShownQuantity.DUTY, self._pwm_unit),
            "moving": LiveItem(ShownQuantity.MOVING),
            "moving_status": LiveItem(ShownQuantity.MOVING_STATUS),
        }

    def _orient(self) -> None:
        self._sign = -1 if self.memory.get("drive_mode") & REVERSE else 1
        self._offset = self.memory.ticks("homing_offset") if "homing_offset" in self.memory else 0
        # Position control ignores more than a quarter turn (e-Manual XM430-W350, Homing Offset (20)).
        ignored = abs(self._offset) * self._rad_per_tick > math.pi / 2 + 1e-9
        if ignored and self.memory.get("operating_mode") == OperatingMode.POSITION:
            self._offset = 0
        self.state.sign, self.state.offset = self._sign, self._offset
        self.state.time_based = bool(self.memory.get("drive_mode") & TIME_BASED)

    def _set_threshold(self) -> None:
        threshold = self.memory.get("moving_threshold", 1)
        self.state.noticed_speed = max(threshold, 0.5) * self.memory.table.rad_s_per_tick

    @property
    def _controls_position(self) -> bool:
        return self.memory["operating_mode"] in _OF_POSITION

    def _command(self) -> ServoCommand:
        memory, mode = self.memory, self.memory["operating_mode"]
        if watchdog_expired(memory):
            return LIMP
        duty = self._part("goal_pwm", "pwm_limit")
        limit = memory.get("pwm_limit", round(1 / self._pwm_unit)) * self._pwm_unit
        if mode == OperatingMode.PWM:
            return ServoCommand(bias=duty, limit=limit)
        limit = min(limit, abs(duty)) if "goal_pwm" in memory else limit
        torque = self._goal_torque()
        if mode == OperatingMode.CURRENT:
            return ServoCommand(bias=math.copysign(limit, torque), limit=limit, torque_limit=abs(torque))
        if mode == OperatingMode.VELOCITY:
            return self._turn(limit)._replace(torque_limit=self._most_torque(torque))
        if not self._controls_position:
            return LIMP  # A value that the model's manual does not list
        most = (
            abs(torque)
            if mode == OperatingMode.CURRENT_BASED_POSITION and "goal_current" in memory
            else self._most_torque(torque)
        )
        return _position_gains(memory, self.motor)._replace(limit=limit, torque_limit=most)

    def _most_torque(self, torque: float) -> float:
        """Return the torque limit of position or velocity control, Nm; FREE on models without Goal Torque.

        On PRO it is Goal Torque (604), or Torque Limit (30) if that is 0 (e-Manual, Goal Torque (604)).
        For the RH-P12-RN the use of Torque Limit is inferred [i]."""
        if self._torque_item is None or self._torque_item.name != "goal_torque":
            return FREE
        return abs(torque) or self.memory["torque_limit"] * self._torque_unit

    def _turn(self, limit: float) -> ServoCommand:
        memory = self.memory
        speed = self._sign * memory.ticks("goal_velocity") * memory.table.rad_s_per_tick
        ramp = self._profile(self._ramp_item) * self._acceleration_unit or FREE
        return _velocity_gains(memory)._replace(turning=1.0, speed=speed, acceleration=ramp, limit=limit)

    def _part(self, name: str, otherwise: str) -> float:
        memory = self.memory
        ticks = memory.ticks(name) if name in memory else memory.get(otherwise)
        return self._sign * ticks * self._pwm_unit

    def _goal_torque(self) -> float:
        memory = self.memory
        if self._torque_item is None:
            return FREE
        return self._sign * memory.ticks(self._torque_item.name) * self._torque_unit

    @property
    def _torque_unit(self) -> float:
        """Torque per tick of the goal, Nm; the goal counts current, or fractions of the stall torque
        (L42-10-S300-R)."""
        if self._torque_item is None:
            return 0.0
        parts = self._torque_item.unit == "1"
        whole = self.motor.stall_torque if parts else self.motor.torque_per_ampere
        return self._torque_item.scale * whole

    def _profile(self, name: str) -> int:
        return abs(self.memory.ticks(name)) if name in self.memory else 0


def _position_gains(memory: Memory, motor: Motor) -> ServoCommand:
    """Return a command with the gains of position control: KP / 128, KI / 65536, KD / 16, KFF1 / 4 and KFF2 /
    4.

    If the P gain was identified with another value, the others are scaled with it [i]."""
    table = memory.table
    if table.items["position_p_gain"].initial is None or "goal_pwm" not in table.items:
        d = critical_d(UNKNOWN_P, motor)
        return ServoCommand(p_ccw=UNKNOWN_P, p_cw=UNKNOWN_P, d=d)
    unit = 128 * motor.p_gain_duty or table.items["goal_pwm"].scale / table.rad_per_tick
    p = memory["position_p_gain"] / 128 * unit
    return ServoCommand(
        p_ccw=p,
        p_cw=p,
        i=memory["position_i_gain"] / 65536 * unit / SAMPLING_S,
        d=memory["position_d_gain"] / 16 * unit * SAMPLING_S,
        feed_velocity=memory.get("feedforward_1st_gain") / 4 * unit * SAMPLING_S,
        feed_acceleration=memory.get("feedforward_2nd_gain") / 4 * unit * SAMPLING_S**2,
    )


def _velocity_gains(memory: Memory) -> ServoCommand:
    """Return a command that controls the velocity as position control of the integrated setpoint.

    The I gain of the velocity, KVI / 65536, is then the P gain of the position. The P gain of the velocity,
    KVP / 128, is the D gain of the position."""
    table = memory.table
    if "goal_pwm" not in table.items or table.items["velocity_p_gain"].initial is None:
        p, i = UNKNOWN_VELOCITY_P / table.max_speed, UNKNOWN_VELOCITY_I / table.max_speed
        return ServoCommand(p_ccw=i, p_cw=i, d=p)
    unit = table.items["goal_pwm"].scale / table.rad_s_per_tick
    i = memory["velocity_i_gain"] / 65536 * unit / SAMPLING_S
    return ServoCommand(p_ccw=i, p_cw=i, d=memory["velocity_p_gain"] / 128 * unit)
