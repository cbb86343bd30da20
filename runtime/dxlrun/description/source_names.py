"""Names of commands of sources in logs, in replies and in requests.

Devices were the first sources with commands, so logs and users' programs contain their names.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:  # numpy is not needed to check a robot file
    import numpy as np
    from numpy.typing import NDArray

SOURCE_COMMAND = "device_command"
"""Sequence in a cycle's record: the value of each command."""
SOURCE_COMMANDS = "device_commands"
"""Key of the commands' names in metadata and plans. It is also the kind of a command: `{"values":
{"board/led": 1}}`."""


class OlderSourceNames:
    """Attributes of `RobotStates` with these names, which programs of users read."""

    __slots__ = ()

    source_commands: tuple[str, ...]
    source_command: NDArray[np.float64]

    @property
    def device_commands(self) -> tuple[str, ...]:
        """Older name of `source_commands`."""
        return self.source_commands

    @property
    def device_command(self) -> NDArray[np.float64]:
        """Older name of `source_command`."""
        return self.source_command
