"""Anchoring: after a pause or regained torque, set joint goals to the measured positions.

The controllers of these joints are restarted there. Decisions depend on the cycle's record only, so a replay
makes the same ones.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.cycle import Floats, Torque
from dxlrun.control.context import ControlContext
from dxlrun.control.controllers.switching import Switching
from dxlrun.control.gate import Gate
from dxlrun.control.halt import STILL_SPEEDS
from dxlwire.joint_unit import LINEAR, ROTARY, JointUnit
from dxlwire.modes import Mode

MOVED_DISTANCES: Mapping[JointUnit, float] = {ROTARY: 0.0873, LINEAR: 0.005}
"""Distance from which a joint counts as moved in a pause: 5 deg or 5 mm. It restarts at its measured
position. A joint in effort mode coasts or sags by less. [i]"""
_HOLDING = (Mode.POSITION, Mode.EFFORT_POSITION)
"""Modes in which a servo with torque keeps its position goal while the loop is paused."""


class Anchoring:
    """Sets goals to the measured positions and restarts controllers, after joints moved without the loop."""

    def __init__(self, context: ControlContext, switching: Switching, gate: Gate) -> None:
        joints, record = context.plan.joints, context.record
        self._names = tuple(joint.name for joint in joints)
        self._moved = np.array([MOVED_DISTANCES[joint.unit] for joint in joints])
        self._hardware = context.hardware
        self._switching = switching
        self._gate = gate
        self._record = record
        self._still = np.array([STILL_SPEEDS[joint.unit] for joint in joints])
        self._paused_at: Floats = record.states.position.copy()
        """Position at which each joint came to rest in the pause, rad or m."""
        self._coasts = np.zeros(len(self._names), dtype=np.bool_)
        """Joints that were still moving in all cycles of this pause so far."""

    def anchor_given(self) -> None:
        """Anchor the joints whose torque was just enabled; the hardware sends their goals again.

        Called after each read. A joint without a valid reply waits for a later cycle, because its position is
        not known.
        """
        states = self._record.states
        given = (states.torque == Torque.GIVEN) & states.valid
        if given.any():
            self._anchor(given, "regained torque")
            self._hardware.follow_goals(np.flatnonzero(given).tolist())

    def begin_pause(self) -> None:
        """Store all joint positions at the start of a pause of the loop."""
        self._coasts.fill(True)
        self.watch_pause()
        np.copyto(self._paused_at, self._record.states.position)

    def watch_pause(self) -> None:
        """Update the stored positions of joints that still coast. Called in each cycle of a pause.

        A wheel coasts after its goal became 0, which must not count as moved by hand. A joint without a
        measured speed counts as at rest.
        """
        states = self._record.states
        self._coasts &= np.abs(states.velocity) > self._still
        np.copyto(self._paused_at, states.position, where=self._coasts)

    def end_pause(self) -> None:
        """Anchor joints that moved more than MOVED_DISTANCES in the pause and do not hold a position."""
        states = self._record.states
        moved = ~np.isin(states.mode, _HOLDING) & (np.abs(states.position - self._paused_at) > self._moved)
        if moved.any():
            self._anchor(moved, "moved in the pause")

    def _anchor(self, rows: NDArray[np.bool_], why: str) -> None:
        names = [self._names[row] for row in np.flatnonzero(rows).tolist()]
        self._gate.anchor(rows)
        self._paused_at[rows] = self._record.states.position[rows]
        self._switching.restart_controllers(names, why)
