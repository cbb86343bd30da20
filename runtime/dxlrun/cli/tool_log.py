"""The traffic of a tool as a log: `--log FILE` of commands that talk to servos without a run."""

from __future__ import annotations

import platform
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from dxlrun.errors import InputError
from dxlrun.output.terminal import print_warning

if TYPE_CHECKING:
    from dxlrun.run.channels.packets import PacketSink

TOOL_NAME = "tool"
"""The metadata record of a log that a tool wrote: its `command`."""


@contextmanager
def tool_log(path: Path | None, command: str) -> Iterator[PacketSink | None]:
    """Give what takes the packets of a tool's line into a new log; None without a path.

    Raises InputError when the file exists or cannot be written.
    """
    if path is None:
        yield None
        return
    from dxlrun.log.export.target import check_new
    from dxlrun.log.identity import HOST, IDENTITY_NAME, code_hashes
    from dxlrun.log.log_writer import LogWriter
    from dxlrun.log.schemas import LogHeader
    from dxlrun.run.channels.packets import PacketBatch
    from dxlrun.run.channels.ring import Handover
    from dxlrun.run.run_log import epoch_offset_ns, incomplete_log

    check_new(path)
    metadata = {TOOL_NAME: {"command": command}, IDENTITY_NAME: {**code_hashes(), HOST: platform.node()}}
    header = LogHeader("tool", (), ("line",), (), 1_000_000_000, epoch_offset_ns(), metadata=metadata)
    try:
        writer = LogWriter(path, header)
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror or error}") from error
    packets = PacketBatch(Handover(writer.take))
    try:
        yield packets
    finally:
        packets.commit()
        if (error_text := writer.close().error) is not None:
            print_warning(incomplete_log(error_text))
