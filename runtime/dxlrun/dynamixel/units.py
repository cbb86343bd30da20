"""Units of one servo: ticks of the wire <-> rad and rad/s of its joint; the same rules as the arrays.

q = direction * (theta - reference), theta = raw * rad_per_tick, counter-clockwise positive (thesis of M.
Amarante Araujo, 2017, JointID; e-Manual AX-12A, Goal Position (30): 300/1023 deg a tick).
"""

from __future__ import annotations

import math

from dxlrun.dynamixel.bus_plan import Field, ServoPlan


def joint_position(servo: ServoPlan, raw: int) -> float:
    """Return the joint's angle, rad, of a present or goal position in ticks."""
    return servo.direction * (raw * servo.rad_per_tick - servo.reference)


def goal_ticks(servo: ServoPlan, position: float) -> int:
    """Return the goal position in ticks of a joint angle, rad: the nearest that the joint's limits allow."""
    theta = servo.direction * position + servo.reference
    return min(max(round(theta / servo.rad_per_tick), servo.lower_tick), servo.upper_tick)


def speed_ticks(servo: ServoPlan, velocity: float) -> int:
    """Return the moving speed in ticks of a speed, rad/s.

    Its magnitude counts. NaN gives 0, which is the maximum in joint mode; 0 rad/s therefore gives 1 tick.
    """
    if math.isnan(velocity):
        return 0
    most = servo.max_speed_tick
    return min(max(round(min(abs(velocity) / servo.rad_s_per_tick, most)), 1), most)


def ticks_in(place: Field, data: bytes | memoryview) -> int:
    """Return the ticks of an unsigned or two's complement item out of a block's bytes."""
    raw = data[place.offset : place.offset + place.size]
    return int.from_bytes(raw, "little", signed=place.encoding == "twos_complement")


def goal_bytes(servo: ServoPlan, position: int, speed: int) -> bytes:
    """Return the goal block of a servo, both in ticks; without a place for a speed, of the position alone."""
    layout = servo.goal
    block = bytearray(layout.length)
    for place, ticks in ((layout.position, position), (layout.speed, speed)):
        if place is not None:
            signed = place.encoding == "twos_complement"
            block[place.offset : place.offset + place.size] = ticks.to_bytes(
                place.size, "little", signed=signed
            )
    return bytes(block)
