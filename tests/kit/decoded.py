"""Packets of a batch, as a log has them."""

from __future__ import annotations

from dxlrun.channels.logged_packets import LoggedPacket, split_packets
from dxlrun.channels.ring import Payload
from dxlwire.packets import PacketKind


def decode_packets(payload: Payload) -> list[LoggedPacket]:
    """Return the packets of one committed batch, oldest first. Raises ValueError when it is not one."""
    return [
        LoggedPacket(bus, PacketKind(kind), servo_id, first_ns, last_ns, data)
        for _, bus, kind, servo_id, first_ns, last_ns, data in split_packets(payload)
    ]
