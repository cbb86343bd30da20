"""Key `on_hot_servo` of the policies and of their groups."""

from __future__ import annotations

from typing import Literal

from dxlrun import Temperature
from dxlrun.tooling.features import PolicyKey
from dxlrun.tooling.files import Form, key


class HotServo(Form):
    above: Temperature = key("Temperature from which a servo is hot.", "70 degC")
    do: Literal["stop", "hold", "limp", "continue"] = key(
        "Its action; stop: the run ends by on_fault.", "limp"
    )


EXAMPLE = "{above: 70 degC, do: limp}"
GROUP = PolicyKey[HotServo | None](
    "on_hot_servo", HotServo | None, key("As the policy of that name, for this group.", EXAMPLE, None)
)
STAGE = PolicyKey[HotServo | None](
    "on_hot_servo", HotServo | None, key("When a servo is hot.", EXAMPLE, None), group=GROUP
)
