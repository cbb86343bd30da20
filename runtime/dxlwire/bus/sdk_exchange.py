"""SDK exchange: a reader and a writer on dynamixel-sdk, for systems without the kernel."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dxlwire.bus.item_values import item_of, nearest_ticks, value_in
from dxlwire.bus.programs import Addressed
from dxlwire.bus.servo_rows import ReadRows, WrittenRows, writable_item
from dxlwire.bus.session import SdkSession
from dxlwire.control_table import ControlItem
from dxlwire.control_table.control_items import side_by_side
from dxlwire.transaction import Program
from dxlwire.wire.dialect import sync_writes


class SdkReading(ReadRows):
    """The exchange of one reader by dynamixel-sdk: one read for each block of adjacent items of a servo."""

    read_by = "read"

    def __init__(
        self, session: SdkSession, servos: Sequence[Addressed], items: Sequence[str], *, raw: bool
    ) -> None:
        super().__init__(session, servos, items)
        self._session = session
        self._raw = raw
        self._blocks = [side_by_side(item_of(servo.table, name) for name in items) for servo in servos]
        self._at_ns = [-1] * len(servos)

    def read_servos(self) -> None:
        """Read every item of every servo once. Raises PortError if the line is closed or lost."""
        self._session.run_program(self._read_all())

    def _read_all(self) -> Program[bool]:
        arrays, now_ns = self._arrays, self._session.clock.now_ns
        self._alert = self._alert.copy()
        for row, (servo_id, blocks) in enumerate(zip(self.ids, self._blocks, strict=True)):
            found: list[tuple[int, float]] = []
            first_ns, error = now_ns(), 0
            for block in blocks:
                start, end = block[0].address, block[-1].address + block[-1].size
                reply = yield self._session.line.read_range(servo_id, start, end - start)
                if not reply.answered:
                    break
                error |= reply.error
                for item in block:
                    data = reply.parameters[item.address - start :][: item.size]
                    found.append((self._items[item.name], value_in(item, data, raw=self._raw)))
            whole = len(found) == len(self._values)
            arrays.valid[row] = whole
            if whole:
                self._at_ns[row] = first_ns
                self._alert[row] = bool(error & self._alert_bits)
                for place, value in found:
                    self._values[place, row] = value
        ended_ns = now_ns()
        for row, at_ns in enumerate(self._at_ns):
            arrays.age_ns[row] = -1 if at_ns < 0 else ended_ns - at_ns
        return True


class SdkWriting(WrittenRows):
    """The sync writes of one writer, sent by dynamixel-sdk."""

    def __init__(
        self, session: SdkSession, servos: Sequence[Addressed], items: Sequence[str], *, raw: bool
    ) -> None:
        super().__init__(session, servos, items)
        self._session = session
        self._raw = raw
        self._row_of = dict(zip(items, self._rows, strict=True))
        self._ids = [servo.servo_id for servo in servos]
        self._blocks = [side_by_side(writable_item(servo, name) for name in items) for servo in servos]

    def send_goals(self) -> None:
        """Send the goals. Raises PortError if the line is closed or lost."""
        self._session.run_program(self._send_all())

    def _send_all(self) -> Program[bool]:
        writes = [
            (servo_id, block[0].address, b"".join(self._encoded(item, column) for item in block))
            for column, (servo_id, blocks) in enumerate(zip(self._ids, self._blocks, strict=True))
            if not any(np.isnan(row[column]) for row in self._rows)
            for block in blocks
        ]
        for packet in sync_writes(self._session.line.dialect, writes):
            yield self._session.line.unanswered(packet)
        return True

    def _encoded(self, item: ControlItem, column: int) -> bytes:
        goal = float(self._row_of[item.name][column])
        return item.encode(nearest_ticks(item, goal, raw=self._raw))
