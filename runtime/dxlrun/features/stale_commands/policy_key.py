"""Key `on_stale_command` of the policies."""

from __future__ import annotations

from dxlrun.description.form import key
from dxlrun.description.robot import WrittenPolicy
from dxlrun.features.feature import PolicyKey

STAGE: PolicyKey[WrittenPolicy] = PolicyKey(
    "on_stale_command",
    WrittenPolicy,
    key(
        "Reaction to a stream of commands that stopped: its joints hold until the next command, or "
        "the run ends by these steps.",
        "hold",
        "hold",
    ),
    before="exit_timeout",
)
