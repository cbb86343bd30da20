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
        "Reaction to a lost servo of the group: its controllers hold, the group goes limp, or the run "
        "ends by on_fault (stop). The robot's policy by default.",
        "limp",
        None,
    ),
    before="on_returned_servo",
)
STAGE: PolicyKey[WrittenPolicy] = PolicyKey(
    "on_lost_servo",
    WrittenPolicy,
    key(
        "Reaction to a lost servo, after 3 missed replies in a row and 50 ms: its controllers hold "
        "until it answers, or the run ends by these steps.",
        "hold",
        "hold",
    ),
    before="on_returned_servo",
    group=OF_GROUP,
)
