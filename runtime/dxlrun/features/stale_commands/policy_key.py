"""Key `on_stale_command` of the policies."""

from __future__ import annotations

from dxlrun.description.form import key
from dxlrun.description.robot import WrittenPolicy
from dxlrun.features.feature import PolicyKey

STAGE: PolicyKey[WrittenPolicy] = PolicyKey(
    "on_stale_command",
    WrittenPolicy,
    key("When a stream of commands stopped; hold: its joints stay, the run goes on.", "hold", "hold"),
    before="exit_timeout",
)
