"""Mode switch: controllers that wait until all their joints are in the modes that they need."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from dxlrun.control.controllers.claims import claimed_modes
from dxlrun.control.controllers.managed import Managed
from dxlrun.description.modes import Mode
from dxlrun.plan.loop_plan import JointPlan

MODE_TIMEOUT_NS = 5_000_000_000
"""How long controllers wait for modes: twenty servos, one after the other in short idle times, need less than
one second, a servo that came back from a reset some more. [i]"""
_STILL = (Mode.POSITION, Mode.VELOCITY)
"""Modes in which a joint holds still by itself: it stays in them when no controller claims it."""

SetModes = Callable[[NDArray[np.uint8]], None]
"""Hardware.set_modes"""


class Group(msgspec.Struct, frozen=True):
    """Controllers that become active together."""

    entering: tuple[Managed, ...]
    until_ns: int
    """The controllers' time at which they are given up."""
    number: int | None
    """Of the command that asked for it; None: none did."""
    why: str
    """The fault of the one that they stand in for; empty: they were asked for."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the controllers."""
        return tuple(managed.plan.name for managed in self.entering)


class ModeSwitch:
    """Controllers that wait for modes, and the modes that are requested; times are the controllers'.

    A joint that is claimed, or about to be, is brought into the mode of its claim. One that is not claimed
    stays in position or velocity mode, where it holds still, and is brought from others into its rest mode.
    """

    def __init__(
        self, joints: Sequence[JointPlan], modes: NDArray[np.uint8], set_modes: SetModes | None
    ) -> None:
        """`modes` is the record's array of the modes in which the joints are, shape (joints,)."""
        self._joints = tuple(joints)
        self._rows = {joint.name: row for row, joint in enumerate(joints)}
        self._modes = modes
        self._set_modes = set_modes
        self.groups: list[Group] = []
        """Controllers that wait."""
        self.requested = True
        """False when claims have changed since modes were requested."""

    @property
    def entering(self) -> tuple[Managed, ...]:
        """The controllers that wait."""
        return tuple(managed for group in self.groups for managed in group.entering)

    def changed(self) -> None:
        """Claims have changed: request modes anew."""
        self.requested = False

    def await_modes(self, entering: Iterable[Managed], time_ns: int, number: int | None, why: str) -> None:
        """Let controllers wait, together, until all their joints are in their modes."""
        self.groups.append(Group(tuple(entering), time_ns + MODE_TIMEOUT_NS, number, why))
        self.requested = False

    def ready(self, entering: Iterable[Managed]) -> bool:
        """Return whether all joints of these controllers are in the modes that they need."""
        return not self._missing(entering)

    def due(self, time_ns: int) -> tuple[list[Group], list[Group]]:
        """Return the groups that may enter now, and those that are given up; neither waits any more.

        One is given up after the timeout, and when a joint is in another mode although another was requested:
        a joint that changes its mode is in none.
        """
        ready, late = [], []
        for group in self.groups:
            missing = self._missing(group.entering)
            refused = self.requested and any(now != Mode.UNKNOWN for _, now in missing.values())
            if not missing:
                ready.append(group)
            elif refused or time_ns >= group.until_ns:
                late.append(group)
        self.groups = [group for group in self.groups if group not in ready and group not in late]
        if late:
            self.requested = False
        return ready, late

    def problem(self, group: Group) -> str:
        """Return which joints did not come into their modes, in words."""
        missing = self._missing(group.entering)
        stays = [
            f"{joint} stays in {_shown(now)} mode instead of {_shown(mode)} mode"
            for joint, (mode, now) in missing.items()
            if now != Mode.UNKNOWN
        ]
        late = [
            f"{joint} did not come into {_shown(mode)} mode within {MODE_TIMEOUT_NS * 1e-9:g} s"
            for joint, (mode, now) in missing.items()
            if now == Mode.UNKNOWN
        ]
        return (stays or late)[0] + (f", nor did {len(missing) - 1} more" if len(missing) > 1 else "")

    def give_up(self, group: Group) -> None:
        """Let a group wait no more."""
        self.groups = [one for one in self.groups if one is not group]
        self.requested = False

    def drop(self, managed: Managed) -> int | None:
        """Let a controller wait no more; return the number of the command whose last one it was."""
        ended = None
        for index, group in enumerate(self.groups):
            if managed in group.entering:
                left = tuple(one for one in group.entering if one is not managed)
                self.groups[index] = replace(group, entering=left)
                ended = None if left else group.number
        self.groups = [group for group in self.groups if group.entering]
        self.requested = False
        return ended

    def end(self) -> list[int | None]:
        """End all waiting, and ask for no modes any more; return the numbers of the commands that waited."""
        numbers = [group.number for group in self.groups]
        self.groups = []
        self.requested = True
        return numbers

    def request(self, managed: Iterable[Managed]) -> None:
        """Request modes from the hardware, by the claims of these controllers that are active or wait."""
        self.requested = True
        active = (one for one in managed if one.active)
        claimed = claimed_modes(one.plan for one in (*active, *self.entering))
        modes = np.zeros(len(self._joints), dtype=np.uint8)
        for row, joint in enumerate(self._joints):
            now = self._modes[row]
            mode = claimed.get(joint.name)
            if mode is None:
                mode = Mode(now) if now in _STILL else joint.rest
            if mode != now:
                modes[row] = mode
        if self._set_modes is not None and modes.any():
            self._set_modes(modes)

    def _missing(self, entering: Iterable[Managed]) -> dict[str, tuple[Mode, Mode]]:
        """Return the joints that are not in their modes, with the mode that they need and theirs."""
        claimed = claimed_modes(managed.plan for managed in entering)
        now = {joint: Mode(int(self._modes[self._rows[joint]])) for joint in claimed}
        return {joint: (mode, now[joint]) for joint, mode in claimed.items() if mode != now[joint]}


def _shown(mode: Mode) -> str:
    return mode.name.lower().replace("_", " with ")
