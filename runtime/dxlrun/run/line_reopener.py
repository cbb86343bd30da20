"""Line reopener: the loop's requests to the guardian to open lost lines again."""

from __future__ import annotations

import select

from dxlrun.channels.process import LineLost, LineReturned, MessageChannel


class LineReopener:
    """Requests lost lines from the guardian, which opens them again; the `reopened` of `SerialPorts`."""

    def __init__(self, channel: MessageChannel[LineReturned]) -> None:
        self._channel = channel
        self._asked: set[int] = set()
        self._came: dict[int, int] = {}

    def __call__(self, index: int) -> int | None:
        """Return the file descriptor of a line that is open again, once; None until then. Does not block."""
        if index not in self._asked:
            self._asked.add(index)
            self._channel.send(LineLost(index))
        if not self._channel.closed and select.select([self._channel], [], [], 0)[0]:
            for message in self._channel.receive():
                self._came[message.bus] = self._channel.descriptors.pop(0)
        descriptor = self._came.pop(index, None)
        if descriptor is not None:
            self._asked.remove(index)
        return descriptor
