"""Servo key `homing_offset`: its form."""

from __future__ import annotations

from dxlrun.description.base_form import key
from dxlrun.features.feature import ServoKey

_HELP = "Homing Offset that the servo must have, ticks; by default any."
STAGE: ServoKey[int | None] = ServoKey(
    "homing_offset",
    int | None,
    field=key(_HELP, "-512", None),
    of_one=key(_HELP, "-512", None),
    of_section=key(_HELP, "-512", None),
    before="motor",
)
