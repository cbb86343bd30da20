"""Names of commands of sources in logs, in replies and in requests.

Devices were the first sources with commands. Logs and programs of users have the names of that time.
"""

from __future__ import annotations

SOURCE_COMMAND = "device_command"
"""Sequence of a cycle's record: the value of each command."""
SOURCE_COMMANDS = "device_commands"
"""Key of the commands' names in metadata and plans; kind of the command `{"values": {"board/led": 1}}`."""
