"""Policy `on_stale_command`: what a run does when a client stops sending its stream of commands.

`control/steering.py` detects that, because a command may come in the cycle in which its lease expires.
"""

from __future__ import annotations

from dxlrun.description.base_form import key
from dxlrun.description.robot import WrittenPolicy
from dxlrun.features.feature import PolicyKey

ON_STALE_COMMAND: PolicyKey[WrittenPolicy] = PolicyKey(
    "on_stale_command",
    WrittenPolicy,
    key(
        "Reaction to an interrupted stream of commands: its joints hold until the next command, or "
        "the run ends with these steps.",
        "hold",
        "hold",
    ),
    does="hold its joints until the next command",
    before="exit_timeout",
)
STAGES = (ON_STALE_COMMAND,)
