"""Deviations: settings that another program left in a servo, judged by what they do.

`tables/deviations.toml` has the judgement of every item that can be written; the file of a model may have
another one.
"""

from __future__ import annotations

import functools
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import msgspec

Judgement = Literal["refuse", "report", "harmless"]
"""`refuse`: the servo gets no torque; `report`: an event at the start; `harmless`: nothing."""

_NUMBER = re.compile(r"_\d+$")


class Deviation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Judgement of the values of an item that are not the factory's; see `deviations.toml`."""

    judgement: Judgement
    effect: str
    """What such a value does: a verb with its object; of a harmless one, why it does nothing."""
    bits: tuple[tuple[int, str], ...] = ()  # Each bit and what it does
    refused: tuple[int, ...] = ()  # Values that are refused, whatever the judgement of the others
    refused_effect: str = ""  # What these do; empty: `effect`
    equivalent: tuple[int, ...] = ()  # Values that do the same as the factory's
    planned: bool = False
    """True where the value is compared with the plan of a run instead of with the factory's."""
    limited_by: str = ""
    """Item that bounds this one, and with whose value it begins where it has no initial value."""
    remedy: str = "declare what the robot needs in `registers`, or write it by `dxlrun servo`"

    @property
    def may_refuse(self) -> bool:
        """True where there is a value with which a servo gets no torque."""
        return self.judgement == "refuse" or bool(self.refused)

    def judge(self, value: int, factory: int) -> Judgement:
        """Return what a value means, both as integers on the wire."""
        if value in self.refused:
            return "refuse"
        return "harmless" if value == factory or value in self.equivalent else self.judgement

    def effect_of(self, value: int) -> str:
        """Return what a value does: a verb with its object."""
        effect = self.refused_effect if value in self.refused and self.refused_effect else self.effect
        bits = " and ".join(words for bit, words in self.bits if value & bit) or "has no known meaning"
        return effect.replace("{value}", str(value)).replace("{bits}", bits)


UNDESCRIBED = Deviation("report", "has an effect that its control table does not describe")
"""Judgement of an item of a plug-in's model, where neither its own file nor `deviations.toml` has one."""


def deviation_of(name: str) -> Deviation:
    """Return the judgement that items of a name have in all models."""
    return deviations_by_name().get(_NUMBER.sub("", name), UNDESCRIBED)


@functools.cache
def deviations_by_name() -> Mapping[str, Deviation]:
    """Return the judgements of `deviations.toml`, by the name of an item without its number."""
    text = (Path(__file__).parent / "tables" / "deviations.toml").read_text("utf-8")
    return msgspec.convert(tomllib.loads(text), dict[str, Deviation])
