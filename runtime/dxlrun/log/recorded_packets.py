"""Recorded packets: the packets of one bus of a log, for a simulated bus that answers from them."""

from __future__ import annotations

from pathlib import Path

from dxlrun.errors import LogError
from dxlrun.log.columns import PacketColumns
from dxlrun.log.log_reader import open_log
from dxlsim.bus.recording import RecordedPackets
from dxlwire.packets import PacketKind


def read_recorded_packets(path: Path, bus: str) -> RecordedPackets:
    """Read all packets of a bus from a log. Raises LogError if the log has no such bus or no requests."""
    pieces = []
    for piece in open_log(path).slices():
        if bus not in piece.buses:
            raise LogError(f"{path}: the log has no bus {bus}")
        pieces.append(piece.packets.select_rows(piece.packets.bus == piece.buses.index(bus)).compact())
    packets = PacketColumns.joined(pieces)
    asked = packets.kind == PacketKind.INSTRUCTION
    if not asked.any():
        raise LogError(f"{path}: the log has no instruction for bus {bus}, so it cannot be simulated")
    data = packets.data.tobytes()
    return RecordedPackets(asked, packets.first_ns, packets.last_ns, packets.start, packets.length, data)
