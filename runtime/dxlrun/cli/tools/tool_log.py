"""Tool log: log of the packets of commands that access servos without a run (`--log FILE`)."""

from __future__ import annotations

import platform
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from dxlrun.output.target import check_target, unwritable
from dxlrun.output.terminal import print_warning

if TYPE_CHECKING:
    from dxlrun.channels.ring import Payload
    from dxlwire.bus_plan import BusPlan
    from dxlwire.packets import PacketLog, PacketSink

CHUNK_NS = 1_000_000_000
"""Longest time (ns) of packets that are lost when a command or a script is killed."""
TOOL_NAME = "tool"
"""Name of the log's metadata record with the `command` that wrote it."""


@contextmanager
def tool_log(path: Path | None, command: str, buses: Sequence[str] = ("line",)) -> Iterator[PacketLog | None]:
    """Yield a log of packets as `new_log`; None without a path."""
    if path is None:
        yield None
        return
    with new_log(path, command, buses) as packets:
        yield packets


@contextmanager
def new_log(path: Path, command: str, buses: Sequence[str]) -> Iterator[PacketLog]:
    """Yield a log that writes packets to a new file, which is closed with the block.

    `buses` are the names of the lines. Raises InputError when the file exists or cannot be written.
    """
    from dxlrun.channels.logged_packets import PacketBatch
    from dxlrun.channels.ring import Handover
    from dxlrun.log.identity import HOST, IDENTITY_NAME, code_hashes
    from dxlrun.log.log_writer import LogWriter
    from dxlrun.log.schemas import LogHeader, epoch_offset_ns
    from dxlrun.run.run_log import incomplete_log

    check_target(path)
    metadata = {TOOL_NAME: {"command": command}, IDENTITY_NAME: {**code_hashes(), HOST: platform.node()}}
    header = LogHeader("tool", (), tuple(buses), (), 1_000_000_000, epoch_offset_ns(), metadata=metadata)
    try:
        writer = LogWriter(path, header)
    except OSError as error:
        raise unwritable(path, error) from error
    chunk_ns = time.monotonic_ns()

    def write_record(kind: int, payload: Payload) -> None:
        nonlocal chunk_ns
        writer.write_record(kind, payload)
        if time.monotonic_ns() - chunk_ns >= CHUNK_NS:
            writer.finish_chunk()
            chunk_ns = time.monotonic_ns()

    packets = PacketBatch(Handover(write_record))
    try:
        yield packets
    finally:
        packets.commit_packets()
        if (error_text := writer.close().error) is not None:
            print_warning(incomplete_log(error_text))


def record_line(path: Path, line: str) -> AbstractContextManager[PacketLog]:
    """Return a log of the packets of a script's line, for `dxlwire.Bus.record`; see `new_log`."""
    return new_log(path, "dxlwire.Bus", (line,))


class BusesLog:
    """Log of the packets of a robot's buses, opened when the buses are known, closed with the block."""

    def __init__(self, path: Path | None, command: str) -> None:
        self._path = path
        self._command = command
        self._open = ExitStack()
        self._sinks: Mapping[str, PacketSink] | None = None

    def __enter__(self) -> BusesLog:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def open_sinks(self, buses: Sequence[BusPlan]) -> Mapping[str, PacketSink]:
        """Return the packet sink of each bus by name, empty without a log; the first call creates the log.

        `buses`: all buses of the robot. Raises InputError when the file exists or cannot be written.
        """
        if self._sinks is None:
            from dxlrun.dynamixel.tools.tool_line import BusPacketSink

            names = [bus.name for bus in buses]
            log = self._open.enter_context(tool_log(self._path, self._command, names))
            self._sinks = {name: BusPacketSink(log, at) for at, name in enumerate(names)} if log else {}
        return self._sinks
