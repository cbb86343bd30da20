"""Broken replies: whether bytes that belong to no packet come where one ID alone is due, and nowhere else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dxlrun.errors import counted
from dxlrun_analysis.counts import has_them_alone
from dxlrun_analysis.finding import Finding, cause
from dxlrun_analysis.plan import LoggedBus
from dxlrun_analysis.servos.exchanges import Exchanges, Loss
from dxlrun_analysis.servos.losses import ServoLosses
from dxlrun_analysis.servos.requests import IDS

_FEWEST = 5
_BESIDE = 12  # Bytes of a status packet beside its data, at most; others that came belong to another sender
_ALONE = 0.7  # Share of the exchanges of a bus with such bytes from which they are one ID's


class BrokenReplies:
    """Counts broken replies of each ID."""

    def __init__(self, buses: int) -> None:
        self._broken, self._first, self._cut = np.zeros((3, buses * IDS), np.int64)
        """Of each servo; of these as the first of several, none of them intact; and at the end of a shared
        status packet."""
        self._noisy = np.zeros(buses, np.int64)  # Exchanges of each bus

    def take(self, exchanges: Exchanges) -> None:
        """Count those of some exchanges."""
        due, buses = exchanges.due, len(self._noisy)
        # of a chain of which nothing is intact although bytes came, but no more than of its first reply
        longest = np.array([max(kind.sizes, default=0) + _BESIDE for kind in exchanges.requests.kinds])
        noise = exchanges.noise[due.exchange]
        first = (due.loss == Loss.LINE) & (due.place == 0) & (noise > 0)
        first &= noise <= longest[exchanges.request[due.exchange]]
        self._first += np.bincount(due.servo[first & exchanges.ended[due.exchange]], minlength=buses * IDS)
        rows = np.flatnonzero((due.broken | first) & exchanges.ended[due.exchange])
        servo, request = due.servo[rows], exchanges.request[due.exchange[rows]]
        ends = due.place[rows] == exchanges.requests.servos[request] - 1
        cut = servo[ends & exchanges.requests.fast[request]]
        self._broken += np.bincount(servo, minlength=buses * IDS)
        self._cut += np.bincount(cut, minlength=buses * IDS)
        self._noisy += np.bincount(exchanges.bus[(exchanges.noise > 0) & exchanges.ended], minlength=buses)

    def findings(self, index: int, bus: LoggedBus, losses: Mapping[int, ServoLosses]) -> Sequence[Finding]:
        """Name the one ID of a bus whose replies are broken; not where that depends on the joint's angle."""
        mine = self._broken[index * IDS : (index + 1) * IDS]
        total = int(self._noisy[index])
        if total < _FEWEST or len(losses) < 2:  # of a single servo it is the line
            return ()
        servo_id = int(np.argmax(mine))
        broken, lost = int(mine[servo_id]), losses.get(servo_id)
        if broken < _ALONE * total or lost is None or lost.angles is not None:
            return ()
        # in a short chain the line spoils the first one often, too
        head = int(self._first[index * IDS + servo_id])
        behind = broken - head >= max(_FEWEST, _ALONE * (total - head))
        if not behind and not has_them_alone(broken, total - broken):
            return ()
        (name, named), asked = bus.called(servo_id), lost.asked + lost.broken_off
        end = self._cut[index * IDS + servo_id] >= _ALONE * broken
        cut = "; or the end of the status packet that all share, which is its part, is lost" if end else ""
        return (
            cause(
                "broken_replies",
                name,
                f"The replies of {named} come broken, "
                f"{counted(broken, 'time', 'times')} of {asked}, and those of the others do not: two "
                f"servos have its ID, or its own driver or plug is bad{cut}.",
                f"Unplug {name} and run `dxlrun scan {bus.port or 'PORT'}`: if ID {servo_id} still answers, "
                "two servos have it; else check its plugs, and exchange it where a new cable does not help.",
                broken / max(asked, 1),
            ),
        )
