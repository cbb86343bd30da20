"""Units of one servo: ticks of the wire -> rad of its joint; the same rules as the arrays.

q = direction * (theta - reference), theta = raw * rad_per_tick, counter-clockwise positive (thesis of M.
Amarante Araujo, 2017, JointID; e-Manual AX-12A, Goal Position (30): 300/1023 deg a tick).
"""

from __future__ import annotations

from dxlrun.dynamixel.plan.bus_plan import Field, ServoPlan


def joint_position(servo: ServoPlan, raw: int) -> float:
    """Return the joint's angle, rad, of a present or goal position in ticks."""
    return servo.direction * (raw * servo.rad_per_tick - servo.reference)


def ticks_in(place: Field, data: bytes | memoryview) -> int:
    """Return the ticks of an unsigned or two's complement item out of a block's bytes."""
    raw = data[place.offset : place.offset + place.size]
    return int.from_bytes(raw, "little", signed=place.encoding == "twos_complement")
