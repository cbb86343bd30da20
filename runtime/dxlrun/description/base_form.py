"""Form: base class of the pydantic models of all sections, types of names, and errors of validators."""

import re
from collections.abc import Iterable, Iterator, Sequence
from types import EllipsisType
from typing import Annotated, Any, Protocol, Self, TypeVar, cast

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    WithJsonSchema,
    create_model,
    model_validator,
)
from pydantic_core import PydanticCustomError

from dxlrun.features.feature import type_of

T = TypeVar("T")
F = TypeVar("F", bound=BaseModel)
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*", re.ASCII)


def validation_error(what: str, fix: str) -> PydanticCustomError:
    """Return the error for a pydantic validator to raise, with problem and fix as separate texts.

    The error is also a ValueError.
    """
    return PydanticCustomError("dxlrun", "{what}; {fix}", {"what": what, "fix": fix})


def _name(value: str) -> str:
    # Names become topics of the log and interfaces `<joint>/<interface>`.
    if not _NAME.fullmatch(value):
        fix = re.sub(r"(\w+) *[:=] *(-?\d.*)", r"write `\1: \2`", value, flags=re.ASCII)  # `elbow=9 deg`
        if fix == value:
            fix = _name_fix(re.sub(r"\W+", "_", value.strip(), flags=re.ASCII))
        raise validation_error(f"{value!r} is not a valid name", fix)
    return value


def _item_name(value: str) -> str:
    if not _NAME.fullmatch(value) or value != folded(value):
        short = folded(value).removeprefix("k").removesuffix("_gain")
        meant = f"position_{short}_gain" if short in ("p", "i", "d") else folded(value)
        raise validation_error(f"{value!r} is not a valid name of an item", _name_fix(meant))
    return value


def _name_fix(name: str) -> str:
    if _NAME.fullmatch(name):
        return f"write {name}"
    return "start with a letter, and use letters, digits and _ only"


def folded(name: str) -> str:
    """Return a name in snake case: position_p_gain for `Position P Gain`."""
    parts = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name)
    return re.sub(r"[^a-z0-9]+", "_", parts.lower()).strip("_")


Name = Annotated[
    str,
    AfterValidator(_name),
    WithJsonSchema({"type": "string", "pattern": f"^{_NAME.pattern}$"}),
]
"""Name in a file: letters, digits and _, starting with a letter; anything else is refused with a fix."""
ItemName = Annotated[
    str,
    AfterValidator(_item_name),
    WithJsonSchema({"type": "string", "pattern": f"^{_NAME.pattern}$"}),
]
"""Name of a control table item in a file, in snake case, such as position_p_gain."""


class Form(BaseModel):
    """Base of the models of all sections: frozen; unknown keys, infinities and wrong types are refused.

    Modules with forms that every robot file needs have no `from __future__ import annotations`, because
    pydantic would compile the text of each annotation.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False, defer_build=True)

    @classmethod
    def of_defaults(cls) -> Self:
        """Return the section with all of its defaults, for a file that does not have it.

        It is made without validation, which would build a validator for this value alone.
        """
        return cast("Self", cls.model_construct())  # mypy takes its result for a Form


def key(
    description: str,
    example: str,
    default: T | EllipsisType = ...,
    *,
    ge: float | None = None,
    gt: float | None = None,
    le: float | None = None,
    lt: float | None = None,
    min_length: int | None = None,
) -> T:
    """Declare a key of a form: its description, example, default and bounds, as a pydantic field.

    Args:
        description: Meaning of the key.
        example: Value in the notation of a file.
        default: Value of an absent key; by default the key is required.
        ge: Lowest value.
        gt: Bound below all values.
        le: Highest value.
        lt: Bound above all values.
        min_length: Fewest characters or entries.
    """
    field: T = Field(
        cast("T", default),
        description=description,
        examples=[example],
        ge=ge,
        gt=gt,
        le=le,
        lt=lt,
        min_length=min_length,
    )
    return field


class FormKey(Protocol):
    """A key that a feature adds to a form of the core."""

    @property
    def name(self) -> str:
        """Name of the key in the file."""

    @property
    def form(self) -> object:
        """Pydantic type of the key's value, or a function that returns it."""

    @property
    def field(self) -> object:
        """Description and default of the key, as `key` returns them."""

    @property
    def before(self) -> str:
        """Key before which this one is listed; if the form lacks it, this key is the last."""


def with_keys(form: type[F], keys: Iterable[FormKey], **replaced: object) -> type[F]:
    """Return a subclass of a form that has additional keys of features.

    Args:
        form: The form without the keys.
        keys: The keys; a key that the form has already is replaced.
        replaced: New types for keys of the form.
    """
    added = [*keys]
    definitions: dict[str, Any] = {name: (kind, form.model_fields[name]) for name, kind in replaced.items()}
    for each in added:
        definitions[each.name] = (type_of(each.form), each.field)
    if not definitions:
        return form
    made = create_model(form.__name__, __base__=form, __doc__=form.__doc__, **definitions)
    order = [*form.model_fields]
    for each in added:
        if each.name not in order:
            order.insert(order.index(each.before) if each.before in order else len(order), each.name)
    # Pydantic puts the fields of a base class first, but messages and the schema list keys in this order.
    made.__pydantic_fields__ = {name: made.model_fields[name] for name in order}
    return made


class PlugInEntry(Form):
    """Base form of controllers and sensors: keys that the core does not know become `parameters`."""

    parameters: dict[str, object] = Field(
        default={}, description="Parameters of the entry's type: all other keys."
    )

    @model_validator(mode="before")
    @classmethod
    def _gather_parameters(cls, entry: object) -> object:
        if not isinstance(entry, dict):
            return entry
        own = {key: value for key, value in entry.items() if key in cls.model_fields and key != "parameters"}
        return {**own, "parameters": {key: value for key, value in entry.items() if key not in own}}


Mistake = tuple[tuple[str | int, ...], str]
"""Path of a wrong key below its model, such as `("motions", "walk", "next")`, and the text `problem; fix`."""


class Mistakes(ValueError):
    """Raised by a model for several mistakes at once, in combinations of its keys."""

    def __init__(self, found: Sequence[Mistake]) -> None:
        self.found = tuple(found)
        super().__init__("\n".join(text for _, text in found))


class ParametersModel(BaseModel):
    """Base of the parameters of a plug-in's controller or sensor: frozen, no unknown keys, no infinities."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, defer_build=True)

    def mistakes(self) -> "Iterator[Mistake]":  # As text, so that the reference has the name
        """Yield mistakes in combinations of keys: the path of a key, and the text `problem; fix`.

        All of them are reported at once, each at its place in the robot file. Override this method for checks
        of several keys, and start with `yield from super().mistakes()`.
        """
        yield from ()

    @model_validator(mode="after")
    def _refuse_mistakes(self) -> Self:
        if found := [*self.mistakes()]:
            raise Mistakes(found)
        return self
