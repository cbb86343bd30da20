"""Key `on_lost_servo` of the policies and of their groups."""

from __future__ import annotations

from typing import Literal

from dxlrun.description.form import key
from dxlrun.description.robot import WrittenPolicy
from dxlrun.features.feature import PolicyKey

OF_GROUP: PolicyKey[Literal["hold", "limp", "stop"] | None] = PolicyKey(
    "on_lost_servo",
    Literal["hold", "limp", "stop"] | None,
    key(
        "hold: its controllers wait; limp: the group loses its torque; stop: the run ends by on_fault.",
        "limp",
        None,
    ),
    before="on_returned_servo",
)
STAGE: PolicyKey[WrittenPolicy] = PolicyKey(
    "on_lost_servo",
    WrittenPolicy,
    key("When a servo missed 3 replies in a row, and 50 ms; hold: its controllers wait.", "hold", "hold"),
    before="on_returned_servo",
    group=OF_GROUP,
)
