"""Broken replies: whether bytes that belong to no packet come where one ID alone is due."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dxlrun.analysis.finding import Finding, Rank
from dxlrun.analysis.plan import LoggedBus
from dxlrun.analysis.servos.exchanges import Exchanges
from dxlrun.analysis.servos.losses import ServoLosses
from dxlrun.errors import counted

_IDS = 256
_FEWEST = 5
_ALONE = 0.8
"""Share of a bus' broken replies from which they are one ID's."""


class BrokenReplies:
    """Counts broken replies of each ID."""

    __slots__ = ("_broken",)

    def __init__(self) -> None:
        self._broken = np.zeros(0, np.int64)

    def take(self, exchanges: Exchanges) -> None:
        """Count those of some exchanges."""
        missing = exchanges.missing
        rows = np.flatnonzero(missing.broken & exchanges.ended[missing.exchange])
        servo = exchanges.bus[missing.exchange[rows]] * _IDS + missing.servo_id[rows]
        found = np.bincount(servo, minlength=len(exchanges.buses) * _IDS)
        self._broken = found + self._broken if len(self._broken) else found

    def findings(self, index: int, bus: LoggedBus, losses: Mapping[int, ServoLosses]) -> Sequence[Finding]:
        """Name the one ID of a bus whose replies are broken; not where that depends on the joint's angle."""
        mine = self._broken[index * _IDS : (index + 1) * _IDS]
        total = int(mine.sum())
        if total < _FEWEST or len(losses) < 2:  # of a single servo it is the line
            return ()
        servo_id = int(np.argmax(mine))
        broken, lost = int(mine[servo_id]), losses.get(servo_id)
        if broken < _ALONE * total or lost is None or lost.angles is not None:
            return ()
        name = bus.names.get(servo_id) or f"servo {servo_id}"
        return (
            Finding(
                "broken_replies",
                name,
                f"The replies of {name} (servo {servo_id} on bus {bus.name}) come broken, "
                f"{counted(broken, 'time', 'times')} of {lost.asked}, and those of the others do not: two "
                "servos have its ID, or its own driver or plug is bad.",
                f"Unplug {name} and run `dxlrun scan {bus.port or 'PORT'}`: if ID {servo_id} still answers, "
                "two servos have it; else check its plugs, and exchange it where a new cable does not help.",
                Rank.CAUSE,
                broken / max(lost.asked, 1),
            ),
        )
