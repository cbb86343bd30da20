"""Excitation: goals of a joint from whose motion inertia, back-EMF, friction, gravity and delay can be told
apart.

It has four parts, in the spirit of J. Swevers et al., "Optimal robot excitation and identification" (IEEE
Trans. Robotics and Automation 13, 1997): steps, which saturate the voltage and show the motor's own dynamics;
a sum of sines and a chirp, for all frequencies that the joint can follow; and slow triangles at several
speeds, for friction.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import msgspec
import numpy as np

from dxlrun import InputError
from dxlrun_lab.identify.model import Floats

LEAST_S, LEAST_RANGE = 10.0, math.radians(5)
"""Shortest duration, s, and smallest range to each side, rad, that separate a motor from friction"""
_SHARES = {"steps": 0.3, "sines": 0.3, "chirp": 0.15, "triangles": 0.25}
_SINES = 12
_LOW_HZ, _HIGH_HZ = 0.15, 5.0
_MARGIN = 0.95
"""Fraction of range and limits that is used, because a servo overshoots"""


class Room(msgspec.Struct, frozen=True):
    """Range and limits within which the goals of a joint remain"""

    lower: float
    """Lower end of the range, rad"""
    upper: float
    velocity: float = math.inf
    """Velocity limit, rad/s"""
    acceleration: float = math.inf
    """Acceleration limit, rad/s^2; infinite if goals may jump"""

    @property
    def middle(self) -> float:
        """Middle of the range, rad"""
        return (self.lower + self.upper) / 2

    @property
    def largest_distance(self) -> float:
        """Largest distance of goals from the middle, rad"""
        return _MARGIN * (self.upper - self.lower) / 2


class ExcitationPart(NamedTuple):
    """Part of the excitation, such as the steps"""

    title: str
    goals: Floats
    """Goals, rad, one per period"""


def excitation(
    room: Room, seconds: float, period_s: float, *, start: float, seed: int = 0
) -> tuple[ExcitationPart, ...]:
    """Return the parts of a joint's excitation, which stay within range and limits, from its start on.

    Args:
        room: Range and limits of the joint.
        seconds: Duration without the way to the middle, s.
        period_s: Time between two goals, s.
        start: Present position, rad.
        seed: Seed of the random numbers.

    Raises:
        InputError: The range or the duration is too small.
    """
    if seconds < LEAST_S:
        raise InputError(
            f"{seconds:g} s are too short to identify a servo; give --duration {LEAST_S:g} or more"
        )
    if room.upper - room.lower < 2 * LEAST_RANGE:
        raise InputError(
            f"a range of {math.degrees(room.upper - room.lower):.1f} deg is too small to identify a servo; "
            f"give {math.degrees(2 * LEAST_RANGE):g} deg or more"
        )
    random = np.random.default_rng(seed)
    counts = {name: round(share * seconds / period_s) for name, share in _SHARES.items()}
    steps = _steps(room, counts["steps"], period_s, random)
    return (
        ExcitationPart("to the middle", _glide(start, room.middle, room, period_s)),
        ExcitationPart(
            "steps", np.concatenate((steps, _glide(float(steps[-1]), room.middle, room, period_s)))
        ),
        ExcitationPart("sum of sines", _sines(room, counts["sines"], period_s, random)),
        ExcitationPart("rising sine", _chirp(room, counts["chirp"], period_s)),
        ExcitationPart("slow triangles", _triangles(room, counts["triangles"], period_s)),
    )


def _glide(start: float, end: float, room: Room, period_s: float) -> Floats:
    """Return goals of a smooth motion between two positions, rad, at up to 1 rad/s and half of the limits."""
    way = abs(end - start)
    speed = min(1.0, room.velocity / 2)
    # The peaks of the first and second derivative of 10 s^3 - 15 s^4 + 6 s^5 are 1.875 and 5.774.
    duration = max(0.3, 1.875 * way / speed, math.sqrt(5.774 * way / min(20.0, room.acceleration / 2)))
    s = np.linspace(0.0, 1.0, max(2, round(duration / period_s)))
    return start + (end - start) * s**3 * (10 - 15 * s + 6 * s**2)


def _steps(room: Room, count: int, period_s: float, random: np.random.Generator) -> Floats:
    """Return `count` goals that step at random between both halves of the range. Each step is held for 0.15
    to 0.6 s. With limits of velocity or acceleration, steps are ramps."""
    goals = np.empty(0)
    side, at = 1.0, room.middle
    while len(goals) < count:
        to = room.middle + side * room.largest_distance * random.uniform(0.4, 1.0)
        way = _limited(at, to, room, period_s)
        held = np.full(round(random.uniform(0.15, 0.6) / period_s), to)
        goals, at = np.concatenate((goals, way, held)), to
        side = -side if random.uniform() < 0.8 else side
    return goals[: max(1, count)]


def _limited(start: float, end: float, room: Room, period_s: float) -> Floats:
    """Return goals from one position to another, rad: a step, or a ramp within velocity and acceleration."""
    way = abs(end - start)
    if room.acceleration == math.inf and room.velocity == math.inf:
        return np.full(1, end)
    ramp_rate = _MARGIN * min(room.acceleration, 1e6)
    top = min(_MARGIN * room.velocity, math.sqrt(way * ramp_rate))
    if way == 0.0 or top == 0.0:
        return np.full(1, end)
    duration = way / top + top / ramp_rate
    count = math.ceil(duration / period_s)
    t = (np.arange(count) + 0.5) * duration / count
    gone = np.cumsum(np.minimum(np.minimum(t, duration - t) * ramp_rate, top))
    way_there: Floats = start + (end - start) * gone / gone[-1]
    return way_there


def _fitted(shape: Floats, room: Room, period_s: float) -> Floats:
    """Scale a motion around 0 as far as range, velocity and acceleration allow; move it to the middle."""
    velocity = np.gradient(shape, period_s)
    factor = min(
        room.largest_distance / max(1e-9, float(np.abs(shape).max())),
        _MARGIN * room.velocity / max(1e-9, float(np.abs(velocity).max())),
        _MARGIN * room.acceleration / max(1e-9, float(np.abs(np.gradient(velocity, period_s)).max())),
    )
    return room.middle + factor * shape


def _window(count: int, period_s: float) -> Floats:
    """Return `count` factors that rise smoothly from 0 to 1 in 0.5 s, and fall again at the end."""
    ends = max(1, min(round(0.5 / period_s), count // 4))
    ramp = np.sin(np.linspace(0.0, math.pi / 2, ends)) ** 2
    return np.concatenate((ramp, np.ones(max(0, count - 2 * ends)), ramp[::-1]))


def _sines(room: Room, count: int, period_s: float, random: np.random.Generator) -> Floats:
    t = np.arange(count) * period_s
    rates = np.geomspace(_LOW_HZ, _HIGH_HZ, _SINES)
    phases = random.uniform(0.0, math.tau, _SINES)
    shape = np.sum(np.sin(math.tau * rates[:, None] * t + phases[:, None]) / rates[:, None] ** 0.75, axis=0)
    return _fitted(shape * _window(count, period_s), room, period_s)


def _chirp(room: Room, count: int, period_s: float) -> Floats:
    t = np.arange(count) * period_s
    rise = math.log(_HIGH_HZ / 0.4) / max(period_s, t[-1])
    phase = math.tau * 0.4 * np.expm1(rise * t) / rise
    return _fitted(np.sin(phase) * np.exp(-0.5 * rise * t) * _window(count, period_s), room, period_s)


def _triangles(room: Room, count: int, period_s: float) -> Floats:
    """Return `count` goals that go to and fro through the range with a different slow speed each way."""
    goals, at, side = [np.full(1, room.middle)], room.middle, 1.0
    speeds, total = (0.15, 0.4, 0.8, 0.25, 0.6), 1
    while total < count:
        for speed in speeds:
            to = room.middle + side * room.largest_distance
            steps = max(1, round(abs(to - at) / min(speed, _MARGIN * room.velocity) / period_s))
            goals.append(at + (to - at) * np.arange(1, steps + 1) / steps)
            at, side, total = to, -side, total + steps
            if total >= count:
                break
    way = np.concatenate(goals)[: max(1, count)]
    # A corner changes the speed by 2 x 0.8 rad/s. A moving average keeps the acceleration limit.
    rounded = round(2 * max(speeds) / (_MARGIN * min(room.acceleration, 1e6)) / period_s)
    if rounded > 1:
        ends = (np.full(rounded, way[0]), way, np.full(rounded, way[-1]))
        way = np.convolve(np.concatenate(ends), np.full(rounded, 1 / rounded), mode="valid")[: len(way)]
    return way
