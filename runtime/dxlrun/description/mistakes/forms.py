"""Forms: finds keys, their places and their types in the pydantic model of a file."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from types import UnionType
from typing import Annotated, Union, cast, get_args, get_origin

from pydantic import BaseModel, Tag, TypeAdapter

from dxlrun.description.base_form import PlugInEntry
from dxlrun.errors import near

Place = tuple[str, ...]
"""Path of a key below a model, such as `("limits", "position")`; NAME stands for an entry's name."""
NAME = "NAME"


def example_at(form: type[BaseModel], place: tuple[str | int, ...]) -> str:
    """Return the example of a key at a path below a model, as written in a file; empty if it has none."""
    owner = form_at(form, place[:-1]) if place else None
    info = None if owner is None else owner.model_fields.get(str(place[-1]))
    return str(info.examples[0]) if info is not None and info.examples else ""


def may_be_value(form: type[BaseModel], place: Place, value: object) -> bool:
    """Return True if the key at a path below a model accepts a value, or if its type is not known."""
    annotation = annotation_at(form, place)
    return annotation is None or _takes(annotation, value)


def places_of(root: type[BaseModel], key: str, value: object) -> list[Place]:
    """Return all paths of a file's model where this key exists and accepts the value."""
    return [
        place for place, annotation in _all_places(root) if place[-1] == key and _takes(annotation, value)
    ]


def keys_for(form: type[BaseModel], value: object) -> list[str]:
    """Return the keys of a model that accept a value."""
    return [name for name in form.model_fields if _takes(_annotation(form, name), value)]


def keys_of(root: type[BaseModel]) -> set[str]:
    """Return the names of all keys of a file's model, on every level."""
    return {place[-1] for place, _ in _all_places(root)}


def section_of(root: type[BaseModel], value: object) -> str:
    """Guess the section whose entries have the keys of a mapping; empty if none fits well."""
    best, most = "", 1
    if not isinstance(value, dict):
        return best
    for name in root.model_fields:
        for form in _forms(entries_of(root, name)):
            fields = form.model_fields.keys() - {"parameters"}
            own = [key for key in value if key in fields or len(near(key, fields)) == 1]
            free = issubclass(form, PlugInEntry)  # it accepts any other key, and has a type
            score = len(own) + 2 * ("type" in own) if free else 2 * len(own) - len(value)
            if score > most:
                best, most = name, score
    return best


def entries_of(form: type[BaseModel], key: str) -> object:
    """Return the type of the entries of a section such as `joints`; None if it is not a mapping by name."""
    return _entries(_annotation(form, key))


def may_be_entry(root: type[BaseModel], section: str, value: object) -> bool:
    """Return True if a value can be an entry of a section, by its keys; also if that cannot be decided."""
    forms = list(_forms(entries_of(root, section)))
    if not forms or not isinstance(value, dict):
        return True
    for form in forms:
        needed = {name for name, info in form.model_fields.items() if info.is_required()}
        known = value.keys() <= form.model_fields.keys() or issubclass(form, PlugInEntry)
        if known and (not needed or needed & value.keys()):
            return True
    return False


def _annotation(form: type[BaseModel], key: str) -> object:
    info = form.model_fields.get(key)
    if info is None:
        return None
    return Annotated[info.annotation, *info.metadata] if info.metadata else info.annotation


def _entries(annotation: object) -> object:
    annotation = without_none(annotation)
    return get_args(annotation)[1] if get_origin(annotation) is dict else None


def _forms(annotation: object) -> Iterator[type[BaseModel]]:
    """Yield the models that a type allows for a value, through unions, but not those of list items."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    elif get_origin(annotation) is Annotated:
        yield from _forms(get_args(annotation)[0])
    elif get_origin(annotation) in (Union, UnionType):
        for arm in get_args(annotation):
            yield from _forms(arm)


@cache
def _all_places(root: type[BaseModel]) -> tuple[tuple[Place, object], ...]:
    """Return the path and type of every key of a file's model, shortest path first."""
    found: dict[Place, object] = {}

    def visit(form: type[BaseModel], above: Place) -> None:
        for name in form.model_fields:
            if name == "parameters" and issubclass(form, PlugInEntry):
                continue
            annotation, place = _annotation(form, name), (*above, name)
            found.setdefault(place, annotation)
            for inner in _forms(annotation):
                visit(inner, place)
            for inner in _forms(_entries(annotation)):
                visit(inner, (*place, NAME))

    visit(root, ())
    return tuple(sorted(found.items(), key=lambda item: len(item[0])))


def _takes(annotation: object, value: object) -> bool:
    try:
        TypeAdapter(cast("type[object]", annotation)).validate_python(value)
    except ValueError:  # pydantic's error for a refused value
        return False
    return True


def form_at(model: type[BaseModel], location: tuple[str | int, ...]) -> type[BaseModel] | None:
    """Return the model at pydantic's location; None if there is another type."""
    at = without_none(annotation_at(model, location))
    return at if isinstance(at, type) and issubclass(at, BaseModel) else None


def annotation_at(model: type[BaseModel], location: tuple[str | int, ...]) -> object:
    """Return the type, with metadata, of the value at pydantic's location."""
    at: object = model
    for step in location:
        at = _inner(at, step)
    return at


def _inner(at: object, step: str | int) -> object:
    at = without_none(at)
    if get_origin(at) in (Union, UnionType):
        return next((arm for arm in get_args(at) if step in _names(arm)), None)
    if isinstance(at, type) and issubclass(at, BaseModel):
        return _annotation(at, str(step))
    arguments = get_args(at)
    if get_origin(at) is dict:
        return arguments[1]
    return arguments[0] if arguments and isinstance(step, int) else None


def without_none(at: object) -> object:
    """Return a type without `Annotated` and without its `| None`."""
    while get_origin(at) is Annotated:
        at = get_args(at)[0]
    if get_origin(at) in (Union, UnionType):
        arms = [arm for arm in get_args(at) if arm is not type(None)]
        if len(arms) == 1:
            return without_none(arms[0])
    return at


def _names(arm: object) -> tuple[str, ...]:
    """Return the names that pydantic uses in locations for a member of a union."""
    tags = [note.tag for note in get_args(arm) if isinstance(note, Tag)]
    plain = without_none(arm)
    return (*tags, plain.__name__) if isinstance(plain, type) else tuple(tags)
