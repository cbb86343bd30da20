"""Live parameters: which of a model may be changed in a run, their values by dotted name, and the change."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TypeAlias, TypeVar

from pydantic import BaseModel

from dxlrun.control.controllers.controller import Live

LiveValues: TypeAlias = Mapping[str, bool | int | float]
"""Values in SI units by dotted name, such as `gains.p`."""
_Model = TypeVar("_Model", bound=BaseModel)


def live_names(model: BaseModel) -> Iterator[str]:
    """Return the dotted names of the live parameters, those of nested models too."""
    for name, field in type(model).model_fields.items():
        value = getattr(model, name)
        if any(isinstance(mark, Live) for mark in field.metadata):
            yield name
        elif isinstance(value, BaseModel):
            yield from (f"{name}.{inner}" for inner in live_names(value))


def value_of(model: BaseModel, name: str) -> object:
    """Return a parameter's value by its dotted name."""
    value: object = model
    for key in name.split("."):
        value = getattr(value, key)
    return value


def with_values(model: _Model, values: LiveValues) -> _Model:
    """Return the parameters with other values, unchecked but for their names.

    Raises ValueError for a name that is none of a live parameter.
    """
    known = frozenset(live_names(model))
    if unknown := [name for name in values if name not in known]:
        raise ValueError(f"{unknown[0]} is no live parameter")
    for name, value in values.items():
        model = _changed(model, name.split("."), value)
    return model


def _changed(model: _Model, path: list[str], value: object) -> _Model:
    first, *rest = path
    inner = getattr(model, first)
    return model.model_copy(update={first: _changed(inner, rest, value) if rest else value})


def live_mistake(model: type[BaseModel], seen: tuple[type, ...] = ()) -> str:
    """Return the parameter that is marked live and is neither a number nor a bool; empty: there is none."""
    for name, field in model.model_fields.items():
        kind = field.annotation
        if any(isinstance(mark, Live) for mark in field.metadata):
            if kind not in (bool, int, float):
                return name
            continue
        if isinstance(kind, type) and issubclass(kind, BaseModel) and kind not in seen:
            mistake = live_mistake(kind, (*seen, model))
            if mistake:
                return f"{name}.{mistake}"
    return ""
