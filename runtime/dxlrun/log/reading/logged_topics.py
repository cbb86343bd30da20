"""Logged topics: the messages of a topic, decoded with the definition that the log contains."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun.errors import LogError
from dxlrun.messages.cdr import Codec, Value
from dxlrun.messages.definition import MessageType


class LoggedTopic(msgspec.Struct, frozen=True, eq=False):
    """One topic of a log with its encoded messages in sequence."""

    name: str
    """Name of the topic, `/CONTROLLER/TOPIC` or `/goals`."""
    type: MessageType
    """Message type, with its definition from the log."""
    t_ns: NDArray[np.int64]
    """Time of the cycle that published each message, ns of the run's clock."""
    data: tuple[bytes, ...]
    """Encoded (CDR) messages."""

    def messages(self) -> list[Mapping[str, Value]]:
        """Decode all messages into mappings from field to value; nested messages are mappings."""
        try:
            codec = Codec(self.type)
            return [codec.unpack(data) for data in self.data]
        except ValueError as error:
            raise LogError(f"a message of {self.name} cannot be read: {error}") from error

    def column(self, field: str) -> NDArray[np.generic]:
        """Return one field of all messages as an array: `error`, `pose.pose.position.x`.

        Raises LogError for an unknown field, and for an array whose length varies.
        """
        values: list[Value] = list(self.messages())
        for name in field.split("."):
            if not all(isinstance(value, Mapping) and name in value for value in values):
                raise LogError(f"messages of {self.name} have no field {field}")
            values = [value[name] for value in values if isinstance(value, Mapping)]
        try:
            return np.array(values)
        except ValueError:
            raise LogError(f"{field} of {self.name} is not always of the same length") from None
