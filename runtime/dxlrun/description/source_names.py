"""Names of commands of sources in logs, in replies and in requests.

Devices were the first sources with commands, so logs and users' programs contain their names.
"""

from __future__ import annotations

SOURCE_COMMAND = "device_command"
"""Sequence in a cycle's record: the value of each command."""
SOURCE_COMMANDS = "device_commands"
"""Key of the commands' names in metadata and plans. It is also the kind of a command: `{"values":
{"board/led": 1}}`."""
