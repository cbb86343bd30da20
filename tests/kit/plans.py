"""Plans of buses, and a line that says what a script has: with dxlwire alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from msgspec.structs import replace

from dxlwire.bus_plan import BusPlan
from dxlwire.clock import VirtualClock
from dxlwire.control_table import ControlTable, all_tables, find_table
from dxlwire.plan.planning import Wiring, bus_plan
from dxlwire.port.ports import OwnProcessors

MIDDLE = math.radians(150)


def distinct_tables() -> list[ControlTable]:
    """Return a control table of each layout, with its errors: several models share one."""
    tables = {}
    for table in all_tables():
        layout = tuple((item.name, item.address) for item in table.items.values())
        errors = (table.errors.item, *table.errors.values.items())
        tables[table.protocol, layout, errors] = table
    return [*tables.values()]


class ScriptedLine(OwnProcessors):
    """Port and Ports in one: after the n-th write it says what the script has, at times since that write."""

    polling = descriptors = functions = None

    def __init__(self, *script: Sequence[tuple[int, bytes]]) -> None:
        self.clock = VirtualClock(1_000)
        self.script = list(script)
        self.coming: list[tuple[int, bytes]] = []
        self.written: list[bytes] = []

    @property
    def ports(self) -> list[ScriptedLine]:
        return [self]

    def write_packet(self, data: bytes) -> None:
        self.written.append(bytes(data))
        said = self.script.pop(0) if self.script else ()
        self.coming = sorted(
            self.coming + [(self.clock.now_ns() + delay_ns, data) for delay_ns, data in said]
        )

    def read_into(self, buffer: memoryview) -> int:
        due = [data for at, data in self.coming if at <= self.clock.now_ns()]
        self.coming = self.coming[len(due) :]
        data = b"".join(due)
        buffer[: len(data)] = data
        return len(data)

    def wait_for_bytes(self, deadline_ns: int) -> list[int]:
        self.clock.wait_until(min([deadline_ns, *(at for at, _ in self.coming)]))
        return [0] if self.coming and self.coming[0][0] <= self.clock.now_ns() else []


def make_plan(
    ids: Sequence[int] = (1, 3, 5, 6, 2, 4, 20, 21),
    *,
    name: str = "main",
    first_row: int = 0,
    latency_ns: int = 0,
    return_delay_ns: int = 500_000,
    **change: Any,
) -> BusPlan:
    """Return a plan; references in the middle, directions -1, +1, -1, ...; AX-12 if nothing else is said."""
    protocol = change.get("protocol", 1.0)
    models = change.get("models") or [change.get("model", "AX-12A")] * len(ids)
    names = change.get("joints", [f"{name}_{servo_id}_joint" for servo_id in ids])
    usual: dict[str, Any] = {"reference": MIDDLE, "lower": -MIDDLE, "upper": MIDDLE}
    given = usual | {key: value for key, value in change.items() if key in Wiring.__struct_fields__}
    wiring = [
        Wiring(
            joint=names[index],
            row=first_row + index,
            servo_id=servo_id,
            table=find_table(models[index], protocol),
            **{"direction": 1 if index % 2 else -1} | given,
        )
        for index, servo_id in enumerate(ids)
    ]
    plan = bus_plan(
        name=name,
        port="sim",
        baud_rate=1_000_000,
        latency_ns=latency_ns,
        return_delay_ns=return_delay_ns,
        joints=wiring,
        protocol=protocol,
        devices=change.get("devices", ()),
    )
    return plan if change.get("fast") else replace(plan, fast=(False,) * len(plan.groups))
