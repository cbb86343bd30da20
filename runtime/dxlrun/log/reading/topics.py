"""Topics: messages of controllers and the runtime in a log, decoded by the log's definitions."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun.errors import LogError
from dxlrun.messages.cdr import Codec, Value
from dxlrun.messages.definition import MessageType


class LoggedTopic(msgspec.Struct, frozen=True, eq=False):
    """One topic with its messages in sequence."""

    name: str
    """`/CONTROLLER/TOPIC`, or `/goals`."""
    type: MessageType
    """Type as in the log."""
    t_ns: NDArray[np.int64]
    """Time of publication of each message, ns of the run's clock: the wake-up of its cycle."""
    data: tuple[bytes, ...]
    """CDR, as published."""

    def messages(self) -> list[Mapping[str, Value]]:
        """Return the fields of each message, with nested messages as mappings. Raises LogError."""
        try:
            codec = Codec(self.type)
            return [codec.unpack(data) for data in self.data]
        except ValueError as error:
            raise LogError(f"a message of {self.name} cannot be read: {error}") from error

    def column(self, field: str) -> NDArray[np.generic]:
        """Return a field of all messages, one row each: `error`, `pose.pose.position.x`.

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
