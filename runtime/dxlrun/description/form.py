"""Form: the base of all parts of the files, what a name may be, and errors of validators."""

from __future__ import annotations

import re
from collections.abc import Collection
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, WithJsonSchema
from pydantic_core import PydanticCustomError

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*", re.ASCII)


def refuse(what: str, fix: str) -> PydanticCustomError:
    """Return the error of a validator: what is wrong and, apart from it, how to fix it.

    It is a ValueError too.
    """
    return PydanticCustomError("dxlrun", "{what}; {fix}", {"what": what, "fix": fix})


def _name(value: str) -> str:
    # names become topics of the log and interfaces `<joint>/<interface>`
    if not _NAME.fullmatch(value):
        raise refuse(f"{value!r} is no name", "start with a letter, and use letters, digits and _ only")
    return value


Name = Annotated[
    str,
    AfterValidator(_name),
    WithJsonSchema({"type": "string", "pattern": f"^{_NAME.pattern}$"}),
]
"""Letters, digits and _, first a letter."""


class Form(BaseModel):
    """Base of all parts: frozen, unknown keys refused, finite numbers only, no number made from text."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False, defer_build=True)


def with_parameters(entry: object, common: Collection[str]) -> object:
    """Return an entry of a plug-in's type with all but the keys that each type has under `parameters`."""
    if not isinstance(entry, dict):
        return entry
    own = {key: value for key, value in entry.items() if key in common}
    return {**own, "parameters": {key: value for key, value in entry.items() if key not in own}}


class ParametersModel(BaseModel):
    """Base of a controller's or a sensor's parameters: frozen, unknown keys refused, finite numbers only."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, defer_build=True)
