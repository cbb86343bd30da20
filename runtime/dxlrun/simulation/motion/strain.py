"""What load does to simulated servos: they get warm, and notice when they cannot hold what they should."""

from __future__ import annotations

import numpy as np

from dxlrun.simulation.motion.plant import Floats

AMBIENT_C = 30.0
"""degrees C of a servo at rest [i]"""

STALLED_RISE_C = 300.0
"""degrees C above ambient where a servo at stall would end: with 400 s it is at 80 after a minute [i]."""

COOLING_S = 400.0
"""Time constant of housing and winding as one body [i]"""

OVERLOAD_PART = 0.8
"""Part of the torque that the limit allows, beyond which the servo counts as overloaded [i]"""

OVERLOAD_TICKS = 10
"""Ticks of `Strain` that it may last: a second [i]"""

_STEADY_C = 1e-7
"""degrees C in a tick; a smaller change shows nowhere in years."""

SUPPLY_OHM = 0.1
"""Resistance of cable and plugs between supply and servo [i]"""


class Strain:
    """Temperature by the copper's loss (current squared, [i]: one body), and time under too much load."""

    def __init__(self, nominal_stall: Floats, dt_s: float) -> None:
        size = len(nominal_stall)
        self._nominal_stall = nominal_stall
        self._part = dt_s / COOLING_S
        self.temperature: Floats = np.full(size, AMBIENT_C)
        """degrees C"""
        self.overloaded = np.zeros(size, dtype=np.int64)
        """Ticks since the load became too much"""
        self.calm = False
        """True when the same load would change nothing any more"""

    def tick(self, torque: Floats, most: Floats) -> list[int]:
        """Let a time pass under torques, Nm; return the servos that have something new to notice.

        `most`: the torque that duty limit and supply allow at standstill, Nm.
        """
        shown = np.rint(self.temperature)
        load = torque / self._nominal_stall
        change = (AMBIENT_C + STALLED_RISE_C * load * load - self.temperature) * self._part
        self.temperature += change
        too_much = (np.abs(torque) >= OVERLOAD_PART * most) & (most > 0.0)
        self.overloaded = np.where(too_much, self.overloaded + 1, 0)
        self.calm = bool(np.abs(change).max() < _STEADY_C and not too_much.any())
        news = (np.rint(self.temperature) != shown) | (self.overloaded == OVERLOAD_TICKS)
        return np.flatnonzero(news).tolist() if news.any() else []
