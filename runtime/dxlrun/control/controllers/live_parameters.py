"""Live parameters: names, values and replacement of the controller parameters that may change in a run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TypeAlias, TypeVar

from pydantic import BaseModel

from dxlrun.contract.controller import Live

LiveValues: TypeAlias = Mapping[str, bool | int | float]
"""New values of live parameters, SI units, by dotted name: `gains.p`, or `gains.p.elbow` of a mapping."""
_Model = TypeVar("_Model", bound=BaseModel)


def live_names(model: BaseModel) -> Iterator[str]:
    """Yield the dotted names of all parameters marked `Live`, also in nested models and mappings."""
    for name, field in type(model).model_fields.items():
        value = getattr(model, name)
        if any(isinstance(mark, Live) for mark in field.metadata):
            yield from (f"{name}.{key}" for key in value) if isinstance(value, Mapping) else (name,)
        elif isinstance(value, BaseModel):
            yield from (f"{name}.{inner}" for inner in live_names(value))


def value_of(model: BaseModel, name: str) -> object:
    """Return the value of a parameter by its dotted name, such as `gains.p.elbow`."""
    value: object = model
    for key in name.split("."):
        value = _inner(value, key)
    return value


def _inner(value: object, key: str) -> object:
    return value[key] if isinstance(value, Mapping) else getattr(value, key)


def with_values(model: _Model, values: LiveValues) -> _Model:
    """Return a copy of the parameters with some live parameters replaced. The values are not validated.

    Raises:
        ValueError: A name is not that of a live parameter.
    """
    known = frozenset(live_names(model))
    if unknown := [name for name in values if name not in known]:
        raise ValueError(f"{unknown[0]} is not a live parameter")
    for name, value in values.items():
        first, *rest = name.split(".")
        model = model.model_copy(update={first: _changed(getattr(model, first), rest, value)})
    return model


def _changed(inner: object, path: list[str], value: object) -> object:
    """Return a copy of a model or mapping with the value at a path of nested names replaced."""
    if not path:
        return value
    first, *rest = path
    found = _changed(_inner(inner, first), rest, value)
    if isinstance(inner, BaseModel):
        return inner.model_copy(update={first: found})
    return {**inner, first: found} if isinstance(inner, Mapping) else inner
