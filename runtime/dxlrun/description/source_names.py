"""Names under which commands of sources (devices) are stored in logs, replies and requests.

Devices were the first sources with commands, so logs and users' programs contain their names.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:  # numpy is not needed to check a robot file
    import numpy as np
    from numpy.typing import NDArray

SOURCE_COMMAND = "device_command"
"""Field of a cycle's record with the values of all source commands."""
SOURCE_COMMANDS = "device_commands"
"""Key of the list of command names in metadata and plans, and kind of the command that sets them: `{"values":
{"board/led": 1}}`."""


class OlderSourceNames:
    """Older names of two attributes of `RobotStates`, which programs of users may read."""

    __slots__ = ()

    source_commands: tuple[str, ...]
    source_command: NDArray[np.float64]

    @property
    def device_commands(self) -> tuple[str, ...]:
        """Same as `source_commands`, by its older name."""
        return self.source_commands

    @property
    def device_command(self) -> NDArray[np.float64]:
        """Same as `source_command`, by its older name."""
        return self.source_command
