"""Drive: converts the input of a gamepad or keyboard to commands, as a stream or as short trajectories.

The robot holds when the switch is released, and also when this program has exited: a setpoint expires after
LEASE_S, and a trajectory ends after HORIZON_S.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress

from dxlrun import Refused, RemoteRobot, Stream
from dxlrun_teleop.bank import HORIZON_S, Bank, CommandForm
from dxlrun_teleop.source import InputState, Press

PERIOD_S = 0.02
"""Period of `Drive.apply_input`, in which the device is read and a command is sent, s"""
LEASE_S = 0.15
"""Time for which a command of the stream is valid, s: seven periods. Including some periods of the loop,
joints hold within 250 ms after the last one."""
FACTORS = 0.1, 10.0
"""Smallest and largest speed factor"""
_FASTER = {Press.FASTER: 1.25, Press.SLOWER: 0.8}


class Drive:
    """Teleoperation of a running robot by one device and one active bank. Call `apply_input` every PERIOD_S.

    After the start and after a change of the bank, nothing moves until the dead-man's switch was released.
    """

    def __init__(self, robot: RemoteRobot, banks: Sequence[Bank], factor: float) -> None:
        self._robot, self._banks, self.factor = robot, banks, factor
        self._place = 0
        self._armed = False
        self._moving: _BankMotion | None = None

    @property
    def bank(self) -> Bank:
        """Bank that the axes drive at present; Press.NEXT selects the next one"""
        return self._banks[self._place]

    @property
    def values(self) -> Sequence[float]:
        """Last commanded value of each slot of the bank (SI units); empty while the robot holds"""
        return () if self._moving is None else self._moving.values

    def apply_input(self, given: InputState, now: float) -> None:
        """Apply the input of the device: change speed factor or bank, and send the next command.

        Args:
            given: Input of the device since the last call.
            now: Time of a monotonic clock, s.

        Raises:
            DxlrunError: The run has ended, or refuses a command because the controller is no longer active.
        """
        for press in given.presses:
            low, high = FACTORS
            self.factor = min(max(self.factor * _FASTER.get(press, 1.0), low), high)
        turned = Press.NEXT in given.presses
        stalled = self._moving is not None and now - self._moving.moved > LEASE_S  # its lease has expired
        if turned or stalled or not given.enabled:
            self.close()
        self._armed = not turned and (self._armed or not given.enabled)
        self._place = (self._place + turned) % len(self._banks)
        if given.enabled and self._armed:
            self._moving = self._moving or _BankMotion(self._robot, self.bank, now)
            self._moving.integrate_axes(given.axes, self.factor, now)

    def close(self) -> None:
        """Stop: end a stream with a command to stand still. A short trajectory ends without one."""
        moving, self._moving = self._moving, None
        if moving is not None:
            moving.end_stream(self.factor)


class _BankMotion:
    """Motion of a bank while the dead-man's switch is held, which starts at the joints' present goals"""

    def __init__(self, robot: RemoteRobot, bank: Bank, now: float) -> None:
        self._robot, self._bank = robot, bank
        self.values = _present(robot, bank) if bank.form.integrates else [0.0] * len(bank.slots)
        self.moved = now
        self._sent = -math.inf
        as_stream = bank.form is not CommandForm.TRAJECTORY
        self._stream: Stream | None = robot.stream(bank.controller, bank.kind, LEASE_S) if as_stream else None

    def integrate_axes(self, axes: Sequence[float], factor: float, now: float) -> None:
        """Integrate the axes' deflections since the last call to positions, and send the command. Speeds are
        sent as they are. A trajectory is sent every HORIZON_S / 2 at most."""
        bank, elapsed, self.moved = self._bank, now - self.moved, now
        for axis, index in zip(axes, bank.driven, strict=False):  # a source may have more axes
            slot = bank.slots[index]
            speed = axis * min(slot.speed * factor, slot.most)
            if not bank.form.integrates:
                self.values[index] = speed
            elif speed:  # a joint beyond its limits is only clamped once it is driven
                self.values[index] = min(max(self.values[index] + speed * elapsed, slot.lower), slot.upper)
        if self._stream is not None:
            self._stream.send(bank.build_command(self.values, factor))
        elif elapsed and any(axes) and now - self._sent >= HORIZON_S / 2:
            self._sent = now
            self._robot.send(bank.controller, bank.kind, bank.build_command(self.values, factor))

    def end_stream(self, factor: float) -> None:
        """End the stream with one command to stand still, which does not expire."""
        bank = self._bank
        if self._stream is not None:
            values = self.values if bank.form.integrates else [0.0] * len(self.values)
            # The command is refused for a joint beyond its limits. The stream then ends with its lease.
            with suppress(Refused):
                self._robot.send(bank.controller, bank.kind, bank.build_command(values, factor))


def _present(robot: RemoteRobot, bank: Bank) -> list[float]:
    """Return the goal at which each slot's joint is at present: its reference, goal or measured position.
    Raises Refused while none is known."""
    states, found = robot.states(), []
    references = dict(zip(states.references, states.reference.tolist(), strict=True))
    for slot in bank.slots:
        row = states.joints.index(slot.name)
        known = [references.get(f"{lower}/{slot.name}/position", math.nan) for lower in bank.into]
        known += [float(states.goal_position[row]), float(states.position[row])]
        finite = [value for value in known if math.isfinite(value)]
        if not finite:
            raise Refused(f"the position of {slot.name} has not been read yet")
        found.append(finite[0])
    return found
