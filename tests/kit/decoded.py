"""Logs as other programs read them, and packets of a batch as a log has them."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from dxlrun.channels.logged_packets import LoggedPacket, split_packets
from dxlrun.channels.ring import Payload
from dxlwire.packets import PacketKind


class Decoded(NamedTuple):
    """A message of a log as mcap and mcap-ros2-support read it."""

    topic: str
    t_ns: int
    message: Any
    schema: Any
    channel: Any


def decode_log(path: Path, *topics: str, in_order: bool = True) -> Iterator[Decoded]:
    """Yield the messages of a log, or of some topics; `in_order`: sorted by time."""
    with path.open("rb") as stream:
        reader: Any = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        found = reader.iter_decoded_messages(topics or None, log_time_order=in_order)
        for schema, channel, message, decoded in found:
            yield Decoded(channel.topic, message.log_time, decoded, schema, channel)


def decode_packets(payload: Payload) -> list[LoggedPacket]:
    """Return the packets of one committed batch, oldest first. Raises ValueError when it is not one."""
    return [
        LoggedPacket(bus, PacketKind(kind), servo_id, first_ns, last_ns, data)
        for _, bus, kind, servo_id, first_ns, last_ns, data in split_packets(payload)
    ]
