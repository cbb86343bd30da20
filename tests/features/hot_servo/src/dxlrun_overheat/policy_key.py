"""Key `on_overheat` of the policies."""

from __future__ import annotations

from dxlrun.tooling.features import PolicyKey, WrittenPolicy
from dxlrun.tooling.files import key

STAGE: PolicyKey[WrittenPolicy] = PolicyKey(
    "on_overheat",
    WrittenPolicy,
    key("When a servo is above 72 degC; hold: the run continues.", "[{pose: rest, speed: 60 deg/s}]", "hold"),
)
