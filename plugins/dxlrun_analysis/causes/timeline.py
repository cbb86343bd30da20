"""Packets of one cycle in order of time, each with the time at which the plan expects it."""

from __future__ import annotations

from collections.abc import Iterator

from dxlrun.tooling.logs import PacketColumns
from dxlrun_analysis.cycles.worst_cycles import TimelineKind, TimelinePacket
from dxlrun_analysis.plan_excerpt import LoggedBus
from dxlwire import PacketKind

_KIND_NAMES: dict[int, TimelineKind] = {
    PacketKind.INSTRUCTION: "instruction",
    PacketKind.STATUS: "status",
    PacketKind.NOISE: "noise",
    PacketKind.LATE: "late",
    PacketKind.OTHER_HOST: "other host",
    PacketKind.ECHO: "echo",
}

_PLANNED = (PacketKind.INSTRUCTION, PacketKind.STATUS)


def timeline(
    packets: PacketColumns, buses: tuple[LoggedBus, ...], scheduled_ns: int
) -> Iterator[TimelinePacket]:
    """Yield the packets of a cycle in order of time, each with its planned time.

    Args:
        packets: The packets.
        buses: Buses of the plan, in the order of the log.
        scheduled_ns: Deadline of the cycle, from which the yielded times count.
    """
    joints = [bus.names for bus in buses]
    due: list[float | None] = [None] * len(buses)
    for packet in sorted(packets, key=lambda one: (one.first_ns, one.last_ns)):
        bus = buses[packet.bus]
        wire_ns = len(packet.data) * 10_000_000_000 / bus.baud_rate if bus.baud_rate else None
        planned_ns = before = due[packet.bus]
        if wire_ns is None or packet.kind not in _PLANNED:
            planned_ns = None
        elif packet.kind == PacketKind.INSTRUCTION:
            planned_ns = due[packet.bus] = packet.first_ns + wire_ns
        elif before is not None:
            due[packet.bus] = before + wire_ns + bus.return_delay_ns
            planned_ns = before + wire_ns + bus.return_delay_ns + bus.latency_ns
        yield TimelinePacket(
            bus.name,
            _KIND_NAMES[packet.kind],
            packet.servo_id,
            joints[packet.bus].get(packet.servo_id, ""),
            (packet.first_ns - scheduled_ns) / 1e3,
            (packet.last_ns - scheduled_ns) / 1e3,
            None if planned_ns is None else (planned_ns - scheduled_ns) / 1e3,
            len(packet.data),
        )
