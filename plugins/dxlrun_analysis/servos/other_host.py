"""Another host on a bus: how many instructions it sent, which, and to which IDs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dxlrun.dynamixel.wire import protocol1, protocol2
from dxlrun.errors import counted
from dxlrun_analysis.counts import Counts
from dxlrun_analysis.finding import Finding, Rank
from dxlrun_analysis.plan import LoggedBus
from dxlrun_analysis.servos.exchanges import BROADCAST_ID, Exchanges, Loss, instruction_of

_IDS = 256
_FEWEST = 3
"""Instructions from which it is no noise that looks like one: of 256 checksums of Protocol 1.0 one fits."""
_MOST_NAMED = 3


class OtherHosts:
    """Collects the instructions of other hosts, in memory that does not grow with the log."""

    def __init__(self) -> None:
        self._sent = Counts()
        self._lost = Counts()

    def take(self, exchanges: Exchanges) -> None:
        """Take those between some exchanges, and how many replies are missing there."""
        others, missing = exchanges.others, exchanges.missing
        self._sent.take(others.bus.astype(np.int64), instruction_of(others) * _IDS + others.servo_id)
        lost = exchanges.bus[missing.exchange[(missing.loss == Loss.OWN) | (missing.loss == Loss.LINE)]]
        self._lost.take(lost, np.zeros(len(lost), np.int64))

    def explains(self, index: int) -> bool:
        """Return whether a bus has another host that may have spoilt its missing replies."""
        sent, lost = (int(counts.of(index)[1].sum()) for counts in (self._sent, self._lost))
        return sent >= _FEWEST and 2 * sent >= lost

    def findings(self, index: int, bus: LoggedBus) -> Sequence[Finding]:
        """Name the other host of a bus; none: it has none."""
        values, counts = self._sent.of(index)
        total = int(counts.sum())
        if total < _FEWEST:
            return ()
        instructions = values // _IDS
        codes = sorted(set(instructions.tolist()), key=lambda code: -int(counts[instructions == code].sum()))
        kinds = [
            f"{_name(bus, code)} of {_ids((values[instructions == code] % _IDS).tolist())}"
            for code in codes[:_MOST_NAMED]
        ]
        if len(codes) > _MOST_NAMED:
            kinds.append("others")
        where = f" (`fuser {bus.port}` shows it)" if bus.port else ""
        return (
            Finding(
                "another_host",
                bus.name,
                f"Another host sends on bus {bus.name}: {counted(total, 'instruction', 'instructions')} "
                f"that this run did not send ({', '.join(kinds)}).",
                f"Stop the other program{where}, or unplug the other adapter: its packets collide with those "
                "of the run, and its commands move the same servos.",
                Rank.CAUSE,
                1.5 if self.explains(index) else 0.0,
            ),
        )


def _name(bus: LoggedBus, code: int) -> str:
    known = protocol1.Instruction if bus.protocol == protocol1.PROTOCOL else protocol2.Instruction
    try:
        return known(code).name.lower().replace("_", " ")
    except ValueError:
        return f"instruction 0x{code:02X}"


def _ids(ids: list[int]) -> str:
    named = [str(one) for one in ids if one != BROADCAST_ID][:_MOST_NAMED]
    more = len(ids) - len(named) - (BROADCAST_ID in ids)
    parts = ["all IDs"] if BROADCAST_ID in ids else []
    if named:
        parts.append(f"ID {named[0]}" if len(named) == 1 else f"IDs {', '.join(named)}")
    return " and ".join(parts) + (f" and {more} more" if more > 0 else "")
