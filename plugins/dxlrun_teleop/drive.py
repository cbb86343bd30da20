"""Drive: what a hand gives becomes set-points of a stream, or short trajectories; released, the robot holds.

It also holds when this program is gone: a set-point counts for LEASE_S, a trajectory ends after HORIZON_S.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress

from dxlrun import Refused, RemoteRobot, Stream
from dxlrun_teleop.bank import HORIZON_S, Bank, Form
from dxlrun_teleop.source import Given, Press

PERIOD_S = 0.02
LEASE_S = 0.15
"""Seven set-points; with some periods of the loop behind it joints hold within 250 ms."""
FACTORS = 0.1, 10.0
_FASTER = {Press.FASTER: 1.25, Press.SLOWER: 0.8}


class Drive:
    """A running robot that is driven; `step` is called each PERIOD_S.

    After the start and with another bank nothing moves before the dead-man's switch was seen released.
    """

    def __init__(self, robot: RemoteRobot, banks: Sequence[Bank], factor: float) -> None:
        self._robot, self._banks, self.factor = robot, banks, factor
        self._place = 0
        self._armed = False
        self._moving: _Moving | None = None

    @property
    def bank(self) -> Bank:
        """What is driven now."""
        return self._banks[self._place]

    @property
    def values(self) -> Sequence[float]:
        """What is commanded now, a number a slot; empty: nothing, the robot holds."""
        return () if self._moving is None else self._moving.values

    def step(self, given: Given, now: float) -> None:
        """Do what is given at `now`, s of a monotonic clock.

        Raises DxlrunError when the robot is gone, or refuses it: a controller is not active any more.
        """
        for press in given.presses:
            low, high = FACTORS
            self.factor = min(max(self.factor * _FASTER.get(press, 1.0), low), high)
        turned = Press.NEXT in given.presses
        stalled = self._moving is not None and now - self._moving.moved > LEASE_S  # what it did then is over
        if turned or stalled or not given.enabled:
            self.close()
        self._armed = not turned and (self._armed or not given.enabled)
        self._place = (self._place + turned) % len(self._banks)
        if given.enabled and self._armed:
            self._moving = self._moving or _Moving(self._robot, self.bank, now)
            self._moving.move(given.axes, self.factor, now)

    def close(self) -> None:
        """End a stream in order, with a standstill; a trajectory ends by itself."""
        moving, self._moving = self._moving, None
        if moving is not None:
            moving.settle(self.factor)


class _Moving:
    """A bank while the switch is held: its numbers begin where the robot is, at a standstill."""

    def __init__(self, robot: RemoteRobot, bank: Bank, now: float) -> None:
        self._robot, self._bank = robot, bank
        self.values = _present(robot, bank) if bank.form.integrates else [0.0] * len(bank.slots)
        self.moved = now
        self._sent = -math.inf
        as_stream = bank.form is not Form.TRAJECTORY
        self._stream: Stream | None = robot.stream(bank.controller, bank.kind, LEASE_S) if as_stream else None

    def move(self, axes: Sequence[float], factor: float, now: float) -> None:
        """Move by the axes since the last time, and send it."""
        bank, elapsed, self.moved = self._bank, now - self.moved, now
        for axis, index in zip(axes, bank.driven, strict=False):  # a source may have more axes
            slot = bank.slots[index]
            speed = axis * min(slot.speed * factor, slot.most)
            if not bank.form.integrates:
                self.values[index] = speed
            elif speed:  # a joint beyond its limits stays where it is until it is driven
                self.values[index] = min(max(self.values[index] + speed * elapsed, slot.lower), slot.upper)
        if self._stream is not None:
            self._stream.send(bank.command(self.values, factor))
        elif elapsed and any(axes) and now - self._sent >= HORIZON_S / 2:
            self._sent = now
            self._robot.send(bank.controller, bank.kind, bank.command(self.values, factor))

    def settle(self, factor: float) -> None:
        """End the stream by a command that stands still, and needs no other one behind it."""
        bank = self._bank
        if self._stream is not None:
            values = self.values if bank.form.integrates else [0.0] * len(self.values)
            with suppress(Refused):  # of a joint that hangs beyond its limits: there the lease ends it
                self._robot.send(bank.controller, bank.kind, bank.command(values, factor))


def _present(robot: RemoteRobot, bank: Bank) -> list[float]:
    """Return what joints are commanded, else their positions. Raises Refused where they are not known yet."""
    states, found = robot.states(), []
    references = dict(zip(states.references, states.reference.tolist(), strict=True))
    for slot in bank.slots:
        row = states.joints.index(slot.name)
        known = [references.get(f"{lower}/{slot.name}/position", math.nan) for lower in bank.into]
        known += [float(states.goal_position[row]), float(states.position[row])]
        finite = [value for value in known if math.isfinite(value)]
        if not finite:
            raise Refused(f"where {slot.name} is has not been read yet")
        found.append(finite[0])
    return found
