"""Live messages: converts messages streamed by a gateway into the messages that the log would have."""

from __future__ import annotations

from collections.abc import Callable, Collection

import msgspec
import numpy as np

from dxlrun.channels.event_records import Event, EventCode
from dxlrun.log import schemas
from dxlrun.log.run_messages import RunMessages
from dxlrun.log.schemas import LogHeader
from dxlrun.messages.cdr import ENCAPSULATION
from dxlrun.messages.definition import MessageType
from dxlrun.remote.live.listening import TopicMessage
from dxlrun.remote.requests.replies import TopicState

_OF_EACH_CYCLE = "dxlrun_msgs/msg/SourceStates"
"""Type of the topics of sources, which only the gateway has; the log has their values in /cycle."""


class LiveMessages(RunMessages):
    """Converter from a gateway's messages to those of the run's log, for viewers."""

    def __init__(self, header: LogHeader) -> None:
        super().__init__(header)
        self._opened: dict[tuple[str, MessageType], int] = {}
        """Channel of each topic and type: a controller that is loaded again may publish another type."""
        self.on_changed: Callable[[str], object] = lambda controller: None
        """Called with a controller's name after its live parameters were changed."""

    @staticmethod
    def heard(topics: Collection[TopicState]) -> set[str]:
        """Return the names of the topics to stream: all but the states of sources and /joint_states."""
        return {one.name for one in topics if one.type != _OF_EACH_CYCLE} - {schemas.LogTopic.JOINT_STATES}

    def read_cycle(self, message: TopicMessage) -> np.void:
        """Return the content of a message of /cycle: a structured scalar whose fields have one row for each
        joint.
        """
        record: np.void = np.frombuffer(message.data[len(ENCAPSULATION) :], dtype=self._layout.dtype)[0]
        return record

    def handle_message(self, message: TopicMessage) -> None:
        """Convert a message of one of the topics that `heard` returns, and add it to the output."""
        if message.topic == schemas.LogTopic.CYCLE:
            self.cycle(message.data[len(ENCAPSULATION) :])
        elif message.topic == schemas.LogTopic.EVENT:
            fields = message.message
            numbers = [fields[name] for name in ("t_ns", "code", "severity")]
            t_ns, code, severity = msgspec.convert(numbers, tuple[int, int, int])
            source, text, data = (str(fields[name]) for name in ("source", "text", "data"))
            self.event(Event(t_ns, code, severity, source, text, data.encode()))
            if code == EventCode.PARAMETERS:
                self.on_changed(source)
        else:
            key = message.topic, MessageType(message.type, message.definition)
            if key not in self._opened:
                self._opened[key] = self._channel(*key)
            self._add(self._opened[key], message.time_ns, message.data)
