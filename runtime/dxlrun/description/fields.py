"""Fields: which keys a model has at a place, so that a report can suggest one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import UnionType
from typing import Annotated, ClassVar, Protocol, Union, get_args, get_origin, runtime_checkable

from pydantic import BaseModel, Tag


@runtime_checkable
class Refusing(Protocol):
    """A model that knows why some keys, which a person may expect, are not possible."""

    refused: ClassVar[Mapping[str, str]]
    """Key -> how to go on without it."""


@runtime_checkable
class ReadBefore(Protocol):
    """A model of a file that has keys which were taken out before the model sees it."""

    read_before: ClassVar[tuple[str, ...]]


@dataclass(frozen=True, slots=True)
class Field:
    """What a model says about one key."""

    example: str | None
    """As it is written in the file."""


def field_at(model: type[BaseModel], location: tuple[str | int, ...]) -> Field | None:
    """Return the field at pydantic's location, or None when it is no field of a model."""
    if not location:
        return None
    owner, key = _follow(model, location[:-1]), location[-1]
    if owner is None or not isinstance(key, str):
        return None
    info = owner.model_fields.get(key)
    if info is None:
        return None
    return Field(str(info.examples[0]) if info.examples else None)


def keys_at(
    model: type[BaseModel], location: tuple[str | int, ...]
) -> tuple[tuple[str, ...], Mapping[str, str]]:
    """Return the keys that the model at a location takes, and the refused ones with a sentence each."""
    owner = _follow(model, location)
    if owner is None:
        return (), {}
    refused: Mapping[str, str] = owner.refused if isinstance(owner, Refusing) else {}
    before = owner.read_before if isinstance(owner, ReadBefore) else ()
    return (*owner.model_fields, *before), refused


def _follow(model: type[BaseModel], location: tuple[str | int, ...]) -> type[BaseModel] | None:
    """Return the model at a location; steps that name a union's member choose it."""
    at: object = model
    for step in location:
        at = _inner(at, step)
    at = _without_none(at)
    return at if isinstance(at, type) and issubclass(at, BaseModel) else None


def _inner(at: object, step: str | int) -> object:
    at = _without_none(at)
    if get_origin(at) in (Union, UnionType):
        return next((arm for arm in get_args(at) if step in _names(arm)), None)
    if isinstance(at, type) and issubclass(at, BaseModel):
        info = at.model_fields.get(str(step))
        return None if info is None else info.annotation
    arguments = get_args(at)
    if get_origin(at) is dict:
        return arguments[1]
    return arguments[0] if arguments and isinstance(step, int) else None


def _without_none(at: object) -> object:
    """Return an annotation without `Annotated` and without the None of an optional."""
    while get_origin(at) is Annotated:
        at = get_args(at)[0]
    if get_origin(at) in (Union, UnionType):
        arms = [arm for arm in get_args(at) if arm is not type(None)]
        if len(arms) == 1:
            return _without_none(arms[0])
    return at


def _names(arm: object) -> tuple[str, ...]:
    """Return by which names pydantic calls a member of a union."""
    tags = [note.tag for note in get_args(arm) if isinstance(note, Tag)]
    plain = _without_none(arm)
    return (*tags, plain.__name__) if isinstance(plain, type) else tuple(tags)
