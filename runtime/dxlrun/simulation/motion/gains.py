"""What the gain registers of servos with an operating mode mean, in duty per rad and rad/s.

The e-Manual's conversions (X series, Velocity PI Gain (76, 78) and Position PID Gain (80 to 84)) count in PWM
units, ticks and velocity units, "the constant in each equation include sampling time"; that time is taken as
1 ms [i].
"""

from __future__ import annotations

from dxlrun.simulation.memory.cells import Memory
from dxlrun.simulation.motion.command import Command
from dxlrun.simulation.motion.motor import Motor
from dxlrun.simulation.motion.shaft import critical_d

SAMPLING_S = 1e-3

UNKNOWN_P = 150.0
"""Duty per rad where the manual gives no initial gain: the PRO, P and Y lines, and the grippers [i].

ROBOTIS' own examples for the PRO line wait until at most 20 ticks are left (DynamixelSDK,
c++/example/protocol2.0, DXL_MOVING_STATUS_THRESHOLD); friction takes 1.3 % of the duty, and 20 ticks of the
finest model are 0.000125 rad.
"""

UNKNOWN_VELOCITY_P, UNKNOWN_VELOCITY_I = 4.0, 40.0
"""There, per part of the no-load speed that is missing, and per s of it [i]"""


def position_gains(memory: Memory, motor: Motor) -> Command:
    """Return the gains of position control: KP / 128, KI / 65536, KD / 16, KFF1 / 4 and KFF2 / 4.

    Where the P gain was identified as another one, the others go with it [i].
    """
    table = memory.table
    if table.items["position_p_gain"].initial is None or "goal_pwm" not in table.items:
        d = critical_d(UNKNOWN_P, motor)
        return Command(p_ccw=UNKNOWN_P, p_cw=UNKNOWN_P, d=d)
    unit = 128 * motor.p_gain_duty or table.items["goal_pwm"].scale / table.rad_per_tick
    p = memory["position_p_gain"] / 128 * unit
    return Command(
        p_ccw=p,
        p_cw=p,
        i=memory["position_i_gain"] / 65536 * unit / SAMPLING_S,
        d=memory["position_d_gain"] / 16 * unit * SAMPLING_S,
        feed_velocity=memory.get("feedforward_1st_gain") / 4 * unit * SAMPLING_S,
        feed_acceleration=memory.get("feedforward_2nd_gain") / 4 * unit * SAMPLING_S**2,
    )


def velocity_gains(memory: Memory) -> Command:
    """Return the gains of velocity control, KVP / 128 and KVI / 65536, on the integrated speed."""
    table = memory.table
    if "goal_pwm" not in table.items or table.items["velocity_p_gain"].initial is None:
        p, i = UNKNOWN_VELOCITY_P / table.max_speed, UNKNOWN_VELOCITY_I / table.max_speed
        return Command(p_ccw=i, p_cw=i, d=p)
    unit = table.items["goal_pwm"].scale / table.rad_s_per_tick
    i = memory["velocity_i_gain"] / 65536 * unit / SAMPLING_S
    return Command(p_ccw=i, p_cw=i, d=memory["velocity_p_gain"] / 128 * unit)
