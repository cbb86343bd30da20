"""Other hosts on a bus, found by their instructions or by replies that this run did not request.

A host that sends at the same time as a servo spoils the servo's reply and its own instruction. The end of the
instruction remains recognizable by its length and code: a reply has its error, or 0x55, in place of a code.
If the other host uses the same adapter, only the replies are visible, which no instruction of this run
requests.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from dxlrun.tooling.logs import PacketColumns
from dxlrun.tooling.output import counted
from dxlrun_analysis.counts import Counts
from dxlrun_analysis.finding import Finding, cause
from dxlrun_analysis.plan_excerpt import LoggedBus
from dxlrun_analysis.servos.exchanges import Exchanges, Loss
from dxlrun_analysis.servos.foreign_writes import ForeignWrites
from dxlrun_analysis.servos.logged_requests import IDS, Flags, Numbers, heads, instruction_of
from dxlwire import BROADCAST_ID, protocol1, protocol2

SPOILS, _FAILED = 1.5, 5.0
"""Shares of findings: a host that wrote goals or whose replies may be mistaken for those of this run; a host
that made a servo fail."""
_FEWEST = 3
"""Fewer instructions can be noise: one of 256 checksums of Protocol 1.0 fits by chance. A single write of
servo items is sufficient."""
_FEWEST_UNASKED = 10
"""Fewer unrequested replies can come from a servo that is late once, or from a corrupted ID."""
_MOST_NAMED = 3
_ALL = 0.9  # Share of echoed instructions from which the adapter always echoes, which is permitted
_LONGEST = 48  # Bytes after the length field; longer instructions are not searched for
_PIECES = 0.1  # Share of the stray bytes from which ends of instructions are not a coincidence
_LOST = (Loss.OWN, Loss.LINE)  # Losses that another host can have caused
_PING, _READ, _WRITE, _SYNC_WRITE, _BULK_READ = 0x01, 0x02, 0x03, 0x83, 0x92


class OtherHosts:
    """Accumulator of instructions that this run did not send, and of replies that it did not request. Its
    memory does not grow with the log."""

    def __init__(self, buses: int) -> None:
        self._sent, self._pieces, self._unasked = Counts(), Counts(), Counts()
        self._stray, self._lost, self._echoes, self._asked = np.zeros((4, buses), np.int64)
        self.writes = ForeignWrites()

    def add_exchanges(self, exchanges: Exchanges) -> None:
        """Add the foreign instructions, echoes, unrequested and missing replies in some exchanges."""
        others, due = exchanges.others, exchanges.due
        code = instruction_of(heads(others))
        self._sent.count_values(others.bus.astype(np.int64), code * IDS + others.servo_id)
        for packet in others:
            self.writes.add_write(packet.bus, exchanges.buses[packet.bus], packet)
        self._unasked.count_values(exchanges.unasked // IDS, exchanges.unasked % IDS)
        second = np.array([bus.protocol != protocol1.PROTOCOL for bus in exchanges.buses], np.bool_)
        stray = exchanges.stray
        if len(stray):
            self._pieces.count_values(*_ends(stray, second[stray.bus]))
        for counts, buses in (
            (self._stray, stray.bus),
            (self._lost, due.servo[due.missing[np.isin(due.loss[due.missing], _LOST)]] // IDS),
            (self._echoes, exchanges.echoes),
        ):
            np.add(counts, np.bincount(buses, minlength=len(counts)), out=counts)
        # The first exchange of each bus has no instruction.
        self._asked += exchanges.times.sum(axis=1) - 1

    def _of(self, index: int) -> tuple[Numbers, Numbers]:
        """Return the foreign instructions on a bus: code times 256 plus ID of each kind, and its count."""
        pieces = int(self._pieces.counts_of(index)[1].sum())
        enough = pieces >= max(_FEWEST, _PIECES * self._stray[index])
        found = [self._sent, self._pieces] if enough else [self._sent]
        values, counts = (
            np.concatenate(each) for each in zip(*(one.counts_of(index) for one in found), strict=True)
        )
        return values, counts

    def explains(self, index: int) -> bool:
        """Return whether foreign instructions or unrequested replies on the bus are so many that they
        explain its missing replies."""
        sent, unasked = int(self._of(index)[1].sum()), int(self._unasked.counts_of(index)[1].sum())
        seen = max(sent if sent >= _FEWEST else 0, unasked if unasked >= _FEWEST_UNASKED else 0)
        return seen > 0 and 2 * seen >= int(self._lost[index])

    def findings(self, index: int, bus: LoggedBus) -> Sequence[Finding]:
        """Report another host on a bus, or an adapter that echoed some of this run's instructions."""
        echoes, asked = self._echoes[index], self._asked[index]
        if _FEWEST <= echoes < _ALL * asked:
            sentence = f"The adapter of bus {bus.name} echoed {echoes} of {asked} instructions of this run."
            return (cause("another_host", bus.name, sentence, share=1.5),)
        values, counts = self._of(index)
        total = int(counts.sum())
        written, failed = self.writes.describe_writes(index)
        if total < _FEWEST and not written:
            return tuple(self._by_replies(index, bus))
        instructions = values // IDS
        codes = sorted(set(instructions.tolist()), key=lambda code: -int(counts[instructions == code].sum()))
        kinds = [
            f"{_name(bus, code)} of {_ids((values[instructions == code] % IDS).tolist())}"
            for code in codes[:_MOST_NAMED]
        ]
        if len(codes) > _MOST_NAMED:
            kinds.append("others")
        wrote = f"; it wrote {written}" if written else ""
        sentence = (
            f"Another host sends on bus {bus.name}: {counted(total, 'instruction', 'instructions')} "
            f"not from this run ({', '.join(kinds)}){wrote}."
        )
        share = _FAILED if failed else 1.0 if self.explains(index) else 0.0
        share = max(share, SPOILS if "goal_" in written else 0.0)
        return (cause("another_host", bus.name, sentence, share=share),)

    def _by_replies(self, index: int, bus: LoggedBus) -> Iterable[Finding]:
        """Report another host on a bus of which only the replies are visible."""
        ids, counts = self._unasked.counts_of(index)
        if (total := int(counts.sum())) >= _FEWEST_UNASKED:
            sentence = (
                f"Another host uses bus {bus.name}, or its adapter: {total} unrequested replies "
                f"(of {_ids(ids.tolist())})."
            )
            yield cause("another_host", bus.name, sentence, share=SPOILS)


def _ends(stray: PacketColumns, second: Flags) -> tuple[Numbers, Numbers]:
    """Find stray bytes that end like an instruction: return the bus of each, and its code times 256 plus
    ID. `second` is true for Protocol 2.0."""

    def from_end(count: int) -> Numbers:
        found = np.zeros(len(stray), np.int64)
        there = stray.length >= count
        found[there] = stray.data[(stray.start + stray.length)[there] - count]
        return found

    parts = []
    total = from_end(1)
    for length in range(2, _LONGEST):  # `length` counts the bytes after the length field
        total += from_end(length)
        code, servo_id = from_end(length), np.where(second, from_end(length + 3), ~(total + length) % IDS)
        known = (code == _PING) & (length == 2 + second) | (code == _READ) & (length == 4 + 3 * second)
        known |= (code == _WRITE) & (length >= 4 + 2 * second) | (code == _SYNC_WRITE) & (length >= 7)
        known |= (code == _BULK_READ) & (length >= 6)
        of_size = np.where(second, from_end(length + 2) + IDS * from_end(length + 1), from_end(length + 1))
        rows = np.flatnonzero(known & (of_size == length) & (servo_id <= BROADCAST_ID))
        parts.append((stray.bus[rows].astype(np.int64), code[rows] * IDS + servo_id[rows]))
    buses, values = (np.concatenate(part) for part in zip(*parts, strict=True))
    return buses, values


def _name(bus: LoggedBus, code: int) -> str:
    known = (
        protocol1.Protocol1Instruction
        if bus.protocol == protocol1.PROTOCOL
        else protocol2.Protocol2Instruction
    )
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
