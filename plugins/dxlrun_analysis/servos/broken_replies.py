"""Bytes on a bus that belong to no intact packet: in place of the replies of one servo, or as noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dxlrun.tooling.output import counted
from dxlrun_analysis.counts import has_them_alone
from dxlrun_analysis.finding import Finding, cause
from dxlrun_analysis.plan_excerpt import LoggedBus
from dxlrun_analysis.servos.exchanges import Exchanges, Loss
from dxlrun_analysis.servos.logged_requests import IDS
from dxlrun_analysis.servos.losses import ServoLosses

_FEWEST = 5  # Fewer broken replies can be a coincidence
# Fewer exchanges, or a smaller share, can come from a plug that is moved.
_FEWEST_NOISY, _NOISY_SHARE = 10, 0.005
_BESIDE = 12  # Largest overhead of a status packet, bytes; with more, another sender is involved
_ALONE = 0.7  # Share of the exchanges of a bus with stray bytes from which a single ID causes them


class BrokenReplies:
    """Counter of exchanges with bytes that belong to no intact packet, by servo and by bus."""

    def __init__(self, buses: int) -> None:
        self._broken, self._first, self._cut = np.zeros((3, buses * IDS), np.int64)
        """Broken replies by servo: all; those as first of several without an intact reply; those at the end
        of a shared status packet."""
        self._noisy, self._disturbed, self._asked = np.zeros((3, buses), np.int64)
        """Exchanges by bus: those with stray bytes; those whose stray bytes are not cut replies; all."""

    def add_exchanges(self, exchanges: Exchanges) -> None:
        """Count the stray bytes in some exchanges."""
        due, buses = exchanges.due, len(self._noisy)
        # Count the first servo of a chain without an intact reply, if the bytes fit into its reply alone.
        longest = np.array([max(kind.sizes, default=0) + _BESIDE for kind in exchanges.requests.kinds])
        rows = due.missing[exchanges.ended[due.exchange[due.missing]]]
        noise = exchanges.noise[due.exchange[rows]]
        first = (due.loss[rows] == Loss.LINE) & (due.place[rows] == 0) & (noise > 0)
        first &= noise <= longest[exchanges.request[due.exchange[rows]]]
        self._first += np.bincount(due.servo[rows[first]], minlength=buses * IDS)
        rows = rows[due.broken[rows] | first]
        servo, request = due.servo[rows], exchanges.request[due.exchange[rows]]
        ends = due.place[rows] == exchanges.requests.servos[request] - 1
        cut = servo[ends & exchanges.requests.fast[request]]
        self._broken += np.bincount(servo, minlength=buses * IDS)
        self._cut += np.bincount(cut, minlength=buses * IDS)
        noisy = np.flatnonzero(exchanges.noise > 0)
        self._noisy += np.bincount(exchanges.bus[noisy[exchanges.ended[noisy]]], minlength=buses)
        # In an incomplete fast status packet, stray bytes are cut blocks.
        incomplete = np.isin(noisy, due.exchange[due.missing])
        disturbed = noisy[~(exchanges.requests.fast[exchanges.request[noisy]] & incomplete)]
        self._disturbed += np.bincount(exchanges.bus[disturbed], minlength=buses)
        self._asked += exchanges.times[:, 1:].sum(axis=1)

    def findings(self, index: int, bus: LoggedBus, losses: Mapping[int, ServoLosses]) -> Sequence[Finding]:
        """Report the one servo of a bus whose replies are broken, or else noise on the bus."""
        return self._broken_ones(index, bus, losses) or self._noise(index, bus)

    def _noise(self, index: int, bus: LoggedBus) -> Sequence[Finding]:
        noisy, asked = int(self._disturbed[index]), int(self._asked[index])
        if noisy < max(_FEWEST_NOISY, _NOISY_SHARE * asked):
            return ()
        after = f"{counted(noisy, 'instruction', 'instructions')} of {asked}"
        sentence = f"Noise on bus {bus.name}: stray bytes followed {after}."
        return (cause("noise", bus.name, sentence, share=noisy / max(asked, 1)),)

    def _broken_ones(
        self, index: int, bus: LoggedBus, losses: Mapping[int, ServoLosses]
    ) -> Sequence[Finding]:
        mine = self._broken[index * IDS : (index + 1) * IDS]
        total = int(self._noisy[index])
        if total < _FEWEST or len(losses) < 2:  # With a single servo, the line is as likely the cause
            return ()
        servo_id = int(np.argmax(mine))
        broken, lost = int(mine[servo_id]), losses.get(servo_id)
        if broken < _ALONE * total or lost is None:
            return ()
        # On a short chain, a faulty line also hits the first servo often.
        head = int(self._first[index * IDS + servo_id])
        behind = broken - head >= max(_FEWEST, _ALONE * (total - head))
        if not behind and not has_them_alone(broken, total - broken):
            return ()
        (name, named), asked = bus.called(servo_id), lost.asked + lost.broken_off
        times = f"{counted(broken, 'time', 'times')} of {asked}"
        end = self._cut[index * IDS + servo_id] >= _ALONE * broken
        cut = " (the last block of the shared status packet)" if end else ""
        sentence = f"The replies of {named} were broken {times}; those of other servos were intact{cut}."
        return (cause("broken_replies", name, sentence, share=broken / max(asked, 1)),)
