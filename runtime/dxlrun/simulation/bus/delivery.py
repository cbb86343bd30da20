"""What the host is given by its adapter, each byte once, and what the ledger says of it."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from dxlrun.simulation.bus.adapter import Adapter
from dxlrun.simulation.bus.flow import Flow
from dxlrun.simulation.bus.ledger import Ledger
from dxlrun.simulation.bus.wire import Chunk


class Delivery:
    """The host's end of one line."""

    def __init__(self, adapter: Adapter, ledger: Ledger, bus: str) -> None:
        self.lateness_ns: deque[int] = deque(maxlen=1000)
        """How long after its end the host got the last answer of each hand-over, in real time."""
        self._adapter = adapter
        self._ledger = ledger
        self._bus = bus

    def take(self, now_ns: int, passing: Sequence[Chunk], handed_ns: int | None) -> bytes:
        """Return what the host gets by a time; `handed_ns`: when it really does, None: at that time."""
        if self._adapter.immediate:
            return self._take_at_once(handed_ns)
        taken = bytearray()
        while (part := self._adapter.hand_over(now_ns, passing)) is not None:
            late_ns = self._late_ns(part.planned_ns, handed_ns)
            for chunk in part.ended:
                self._ledger.add(chunk.due_ns, self._bus, "out", chunk.data, chunk.note, late_ns=late_ns)
            taken += part.data
        return bytes(taken)

    def take_flow(self, flow: Flow, handed_ns: int | None) -> bytes:
        """Return what has passed of answers that nobody disturbs."""
        passed = flow.give(self._bus, handed_ns)
        if not passed.parts:
            return b""
        self._ledger.add_passed(passed)
        if handed_ns is not None:
            self.lateness_ns.append(handed_ns - passed.begin_ns - passed.dues_ns[-1])
        return b"".join(passed.parts)

    def _take_at_once(self, handed_ns: int | None) -> bytes:
        """Return all that has passed the wire: nothing is kept back or cut."""
        arrived = self._adapter.give_all()
        for chunk in arrived:
            late_ns = 0 if handed_ns is None else handed_ns - chunk.due_ns
            self._ledger.add(chunk.due_ns, self._bus, "out", chunk.data, chunk.note, late_ns=late_ns)
        if arrived and handed_ns is not None:
            self.lateness_ns.append(handed_ns - arrived[-1].due_ns)
        return arrived[0].data if len(arrived) == 1 else b"".join([chunk.data for chunk in arrived])

    def _late_ns(self, planned_ns: int, handed_ns: int | None) -> int:
        if handed_ns is None:
            return 0
        self.lateness_ns.append(handed_ns - planned_ns)
        return handed_ns - planned_ns
