"""The key `registers` of joints and servos in a robot file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from pydantic import BeforeValidator, WithJsonSchema

from dxlrun.description.base_form import ItemName, key, validation_error
from dxlrun.features.feature import ServoKey


def _register(value: object) -> object:
    if isinstance(value, bool) or not isinstance(value, int | str):
        raise validation_error(
            "this is not a register value",
            "write the raw integer, or a quantity with its unit, such as 500 us",
        )
    return value


Register = Annotated[int | str, BeforeValidator(_register), WithJsonSchema({"type": ["integer", "string"]})]
"""Value of a register: the raw integer, or a quantity with a unit of the item's kind, such as `500 us`."""

STAGE: ServoKey[Mapping[str, Register]] = ServoKey(
    "registers",
    dict[ItemName, Register],
    field=key(
        "Values of items in the servo's control table, written at the start if they differ.",
        "{position_p_gain: 800, return_delay_time: 0 us}",
        {},
    ),
    of_one=key(
        "Values of items in the servo's control table; by default those of the joint.",
        "{position_p_gain: 800}",
        None,
    ),
    of_section=key(
        "Values of items in the servo's control table, written at the start if they differ.",
        "{position_p_gain: 800}",
        {},
    ),
    before="motor",
)
