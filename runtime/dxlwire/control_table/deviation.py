"""Deviations: rules for settings that another program changed in a servo, by their effect on a run.

`tables/deviations.toml` has the rule of every writable item. The data file of a model may override it."""

from __future__ import annotations

import functools
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import msgspec

Judgement = Literal["refuse", "report", "harmless"]
"""Consequence of a changed setting. `refuse`: the servo gets no torque; `report`: an event at start-up;
`harmless`: no action."""

_NUMBER = re.compile(r"_\d+$")


class Deviation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Rule for the values of one item that differ from the factory value; see `deviations.toml`."""

    judgement: Judgement
    effect: str
    """Effect of a deviating value: a verb with its object. For a harmless value the reason why it has no
    effect."""
    bits: tuple[tuple[int, str], ...] = ()  # Each bit with its effect
    refused: tuple[int, ...] = ()  # Values that are always refused, whatever the judgement of the others
    refused_effect: str = ""  # Effect of the refused values; empty: `effect`
    equivalent: tuple[int, ...] = ()  # Values with the same effect as the factory's
    planned: bool = False
    """True if the value is compared with the plan of a run instead of the factory value."""
    limited_by: str = ""
    """Name of the item that limits this one, and that supplies its value at power-up if it lacks an
    initial value."""
    remedy: str = "declare what the robot needs in `registers`, or write it by `dxlrun servo`"

    @property
    def may_refuse(self) -> bool:
        """True if some value of the item keeps a servo from getting torque."""
        return self.judgement == "refuse" or bool(self.refused)

    def judge_value(self, value: int, factory: int) -> Judgement:
        """Return the consequence of a value; `value` and `factory` are integers on the wire."""
        if value in self.refused:
            return "refuse"
        return "harmless" if value == factory or value in self.equivalent else self.judgement

    def effect_of(self, value: int) -> str:
        """Return the effect of a value in words: a verb with its object."""
        effect = self.refused_effect if value in self.refused and self.refused_effect else self.effect
        bits = " and ".join(words for bit, words in self.bits if value & bit) or "has no known meaning"
        return effect.replace("{value}", str(value)).replace("{bits}", bits)


UNDESCRIBED = Deviation("report", "is not described in its control table")
"""Rule for an item of a plug-in's model that neither its own file nor `deviations.toml` judges: report it."""


def deviation_of(name: str) -> Deviation:
    """Return the rule in `deviations.toml` for an item name, the same for all models; the number at the
    end of a name is ignored."""
    return deviations_by_name().get(_NUMBER.sub("", name), UNDESCRIBED)


@functools.cache
def deviations_by_name() -> Mapping[str, Deviation]:
    """Return the rules of `deviations.toml`, by item name without its number."""
    text = (Path(__file__).parent / "tables" / "deviations.toml").read_text("utf-8")
    return msgspec.convert(tomllib.loads(text), dict[str, Deviation])
