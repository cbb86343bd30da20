"""Problems: converts validation errors of pydantic into sentences with line, column and fix."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Set
from contextlib import suppress
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from dxlrun.description.base_form import Mistakes, PlugInEntry
from dxlrun.description.document import KeyPath, Marks, PlainDocument, plain_value, text_of
from dxlrun.description.mistakes.forms import annotation_at, example_at, form_at, keys_for, without_none
from dxlrun.description.mistakes.syntax import list_text
from dxlrun.description.mistakes.words import SWITCHED_OFF, Remedy, UnknownKeyContext, yaml_text
from dxlrun.description.units import bound_text, example_of, units_of
from dxlrun.errors import InputError, Mark, Problem, suggestion, what_and_fix
from dxlrun.features import broken_features
from dxlsim.texts.duration import split_quantity
from dxlwire.control_table.servo_models import perhaps_meant

Form = TypeVar("Form", bound=BaseModel)


def problems_of(
    error: ValidationError,
    marks: Marks,
    prefix: KeyPath = (),
    *,
    model: type[BaseModel] | None = None,
    beside: Collection[str] = (),
    document: type[BaseModel] | None = None,
    unknown: Set[KeyPath] = frozenset(),
    most: int | None = None,
) -> list[Problem]:
    """Convert pydantic's errors into problems, one for each place in the file, in file order.

    With a model, unknown keys get the nearest known key, also from the keys in `beside`. Missing keys get an
    example.

    Args:
        error: The model's errors.
        marks: Places in the file.
        prefix: Path of the model's data in the file.
        model: The model.
        document: Model of the whole file if `model` is a part: a key may belong elsewhere.
        unknown: Paths to skip, with everything below them.
        most: Most errors of pydantic to convert; None: all.
    """
    found: dict[KeyPath, list[_Error]] = {}
    for details in _each_of(error.errors(include_url=False)[:most]):
        one = _Error(details, marks, prefix, model, beside)
        if one.meant and not any(one.path[:end] in unknown for end in range(len(one.path) + 1)):
            found.setdefault(one.path, []).append(one)
    _join_lists(found)
    problems = [_merged(errors, marks) for errors in _explain_unknown_keys(found, marks, document)]
    # A list with two values too few has the same problem twice.
    problems = [*dict.fromkeys(problems)]
    return sorted(problems, key=lambda problem: problem.mark)


def _join_lists(found: dict[KeyPath, list[_Error]]) -> None:
    """Join each list without brackets, of which YAML took all items but the first for keys."""
    for path, (first, *_) in [*found.items()]:
        if _TYPES.get(first.kind) == "a list" and isinstance(first.input, str):
            for other, errors in [*found.items()]:
                if other[:-1] == path[:-1] and (errors[0].kind, errors[0].input) == ("extra_forbidden", None):
                    first.input += f", {found.pop(other)[0].path[-1]}"


def _explain_unknown_keys(
    found: Mapping[KeyPath, list[_Error]], marks: Marks, document: type[BaseModel] | None
) -> Iterator[list[_Error]]:
    """Yield the errors of each place, after unknown keys were explained and their consequences removed.

    A missing key is not an error if an unknown key means it.
    """
    parents: dict[KeyPath, dict[str, _Error]] = {}
    for path, errors in found.items():
        if errors[0].kind == "extra_forbidden":
            parents.setdefault(path[:-1], {})[str(path[-1])] = errors[0]
    settled: set[KeyPath] = set()
    for parent, errors_of in parents.items():
        for remedy in _remedies_at(parent, errors_of, marks, document):
            first, *others = (errors_of[key] for key in remedy.keys)
            first.remedy = remedy
            settled.update(one.path for one in others)
            if (missing := found.get((*parent, remedy.means))) and missing[0].missing:
                settled.add((*parent, remedy.means))
    for parent in {path[:-1] for path in found}:
        entries = [path for path in found if path[:-1] == parent and _is_key_of_entry(found[path][0])]
        settled.update(entries[1:])
        if entries:
            above = [path for path in found if path[:-1] == parent and found[path][0].input is None]
            found[entries[0]][0].unindented = [str(path[-1]) for path in entries]
            settled.update(above)
    for path, errors in found.items():
        if path not in settled or (errors[0].kind == "extra_forbidden" and errors[0].remedy is not None):
            yield errors


def _remedies_at(
    parent: KeyPath, unknown: Mapping[str, _Error], marks: Marks, document: type[BaseModel] | None
) -> list[Remedy]:
    first = next(iter(unknown.values()))
    form = None if first.model is None else form_at(first.model, first.location[:-1])
    if first.model is None or form is None:
        return []
    sections: dict[str, list[str]] = {}
    for path in marks.keys:
        if len(path) <= 2:
            sections.setdefault(str(path[0]), []).extend(map(str, path[1:]))
    known, refused = _keys_at(first.model, first.location[:-1])
    known = (*known, *first.beside) if len(first.location) == 1 else known
    values = {key: error.input for key, error in unknown.items() if key not in refused}
    present = [str(path[-1]) for path in marks.keys if path[:-1] == parent]
    return [
        *UnknownKeyContext(document or first.model, form, parent, known, present, sections).remedies(values)
    ]


def _each_of(errors: Iterable[ErrorDetails]) -> Iterator[ErrorDetails]:
    """Yield pydantic's errors, where an error with `Mistakes` is split into one for each mistake."""
    for details in errors:
        several = details.get("ctx", {}).get("error")
        if not isinstance(several, Mistakes):
            yield details
            continue
        for path, text in several.found:
            what, fix = what_and_fix(text)
            context = {"what": what, "fix": fix}
            yield {**details, "type": "dxlrun", "loc": (*details["loc"], *path), "ctx": context}


def read_form(grown: PlainDocument, model: type[Form]) -> Form:
    """Validate a document with a model and return it; raise InputError with all problems."""
    problems, form = [*grown.problems], None
    try:
        form = model.model_validate(grown.data)
    except ValidationError as error:
        problems += problems_of(error, grown.marks, model=model, unknown=grown.unknown)
    if form is None or problems:
        raise InputError(sorted(problems, key=lambda problem: problem.mark))
    return form


_ROUNDS = 3
"""Attempts to repair values before giving up; a repaired value may be refused for another reason."""


def errors_between_keys(
    data: Mapping[str, object], error: ValidationError, model: type[BaseModel]
) -> tuple[ValidationError, frozenset[KeyPath]] | None:
    """Find mistakes between keys that pydantic did not check because single values were wrong.

    pydantic checks several keys together only if each of them is valid, so refused values are replaced by
    valid ones. The second part of the result contains their paths, about which no error may be reported.

    Args:
        data: Data that the model refused.
        error: The model's errors.
        model: The model; its validators may be foreign code.

    Returns:
        None without errors, or if a refused value cannot be replaced.
    """
    repaired, replaced = copy.deepcopy(dict(data)), set[KeyPath]()
    for _ in range(_ROUNDS):
        wrong = [each for each in error.errors(include_url=False) if not _is_between_keys(each)]
        if not wrong:
            return (error, frozenset(replaced)) if replaced else None
        for one in (_Error(details, Marks("", {}, {}), model=model) for details in wrong):
            if not one.meant:
                continue
            path = _repair(repaired, one)
            if path is None:
                return None
            replaced.add(path)
        try:
            model.model_validate(repaired)
        except ValidationError as further:
            error = further
        except Exception:  # a plug-in's validator; its first error is reported
            return None
        else:
            return None
    return None


def _is_between_keys(details: ErrorDetails) -> bool:
    return isinstance(details["input"], dict) and details["type"] in ("value_error", "dxlrun")


def _repair(data: dict[str, object], error: _Error) -> KeyPath | None:
    """Replace a refused value by a valid one, or remove it if its key has a default.

    Returns its path; None if no valid value is known.
    """
    at: Any = data
    path: KeyPath = ()
    *above, key = error.location or ("",)
    for step in above:
        with suppress(KeyError, TypeError):  # a step that names a union's member is not in the data
            at, path = at[step], (*path, step)
    if isinstance(at, dict) and (error.kind == "extra_forbidden" or _has_default(error)):
        at.pop(key, None)
        return (*path, key)
    good = _good_value(error)
    if good is None or not isinstance(at, dict | list):
        return None
    container: Any = at
    container[key] = good
    return (*path, key)


def _has_default(error: _Error) -> bool:
    owner = None if error.model is None else form_at(error.model, error.location[:-1])
    info = None if owner is None else owner.model_fields.get(str(error.location[-1]))
    return info is not None and not info.is_required()


def _good_value(error: _Error) -> object:
    """Return a value that pydantic will accept in place of a refused one; None if none is known."""
    bound = error.context.get("ge", error.context.get("le"))
    if isinstance(bound, int | float):
        units = error.units
        unit = next(iter(units), "")
        return f"{bound / units[unit]!r} {unit}" if units else bound
    notes = () if error.model is None else _notes_at(error.model, error.location)
    examples = (example_of(note) for note in notes)
    return next((example for example in examples if example), None)


def sentences_of(error: ValidationError, what: str, model: type[BaseModel], most: int) -> list[str]:
    """Convert pydantic's errors as `data_problems`, into sentences `problem; fix`."""
    return [f"{problem.what}; {problem.fix}" for problem in data_problems(error, what, model, most)]


def data_problems(error: ValidationError, what: str, model: type[BaseModel], most: int) -> list[Problem]:
    """Convert pydantic's errors about data that is not from a file into problems without a place.

    Args:
        error: The model's errors.
        what: Name of the data, as in `posvel of head has no velocities; add ...`.
        model: The model.
        most: Most errors of pydantic to convert.
    """
    places: dict[KeyPath, Mark] = {}
    for details in error.errors(include_url=False)[:most]:
        # the step names a member of a union
        location = [part for part in details["loc"] if not str(part).startswith("<")]
        if details["type"] == "missing":
            location.pop()
        places |= {(what, *location[:end]): Mark(what) for end in range(len(location) + 1)}
    return problems_of(error, Marks(what, places, places), (what,), model=model, most=most)


class _Error:
    """One error of pydantic, with its path in the file and what is known for a better message."""

    def __init__(
        self,
        details: ErrorDetails,
        marks: Marks,
        prefix: KeyPath = (),
        model: type[BaseModel] | None = None,
        beside: Collection[str] = (),
    ) -> None:
        self.kind = details["type"]
        self.context: Mapping[str, object] = details.get("ctx", {})
        self.input: object = details["input"]
        self.model = model
        self.beside = beside
        self.location = details["loc"]
        of_key = self.location[-1:] == ("[key]",)
        location = self.location[:-1] if of_key else self.location
        self.missing = self.kind in ("missing", "missing_argument")
        path = _in_file(location[:-1] if self.missing else location, marks, prefix)
        self.path: KeyPath = (*path, location[-1]) if self.missing else path
        self.at_key = of_key or self.missing or self.kind == "extra_forbidden"
        self.remedy: Remedy | None = None
        self.unindented: list[str] = []
        """Keys that are indented like the name of their entry, instead of below it; this one is first."""

    @property
    def meant(self) -> bool:
        """False if the error only follows from another error, and should not be reported.

        pydantic counts only valid items, so it also reports a list with invalid items as too short. It
        reports a second item as missing if both are written as one range: `[-90..90 deg]`.
        """
        least = self.context.get("min_length")
        if self.missing and isinstance(self.input, list) and any(map(_is_range, self.input)):
            return False
        return not (
            self.kind == "too_short"
            and isinstance(least, int)
            and isinstance(self.input, list | dict)
            and len(self.input) >= least
        )

    @property
    def path_name(self) -> str:
        """Path of the value as text: `joints.head.limits.position[1]`."""
        return path_text(self.path)

    @property
    def example(self) -> str:
        """Example of the key's value from its field; empty if it has none."""
        return "" if self.model is None else example_at(self.model, self.location)

    @property
    def units(self) -> Mapping[str, float]:
        """Units that the value's quantity accepts, with their size in SI units; empty if it has no unit."""
        notes = () if self.model is None else _notes_at(self.model, self.location)
        return next((units for units in map(units_of, notes) if units), {})


def _is_range(item: object) -> bool:
    return isinstance(item, str) and list_text(item) != ""


def path_text(path: KeyPath) -> str:
    """Write a path as text: `joints.head.limits.position[1]`."""
    text = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in path)
    return text.removeprefix(".") or "the file"


def _in_file(location: Iterable[str | int], marks: Marks, prefix: KeyPath) -> KeyPath:
    """Return pydantic's location as a path in the file, without steps that name members of a union."""
    path = prefix
    for step in location:
        if marks.has((*path, step)):
            path = (*path, step)
    return path


def _merged(errors: list[_Error], marks: Marks) -> Problem:
    """Return one problem for a place, from the errors of all members of a union there."""
    first = errors[0]
    mark = marks.key(*first.path) if first.at_key else marks.value(*first.path)
    expected = list(
        dict.fromkeys(each_expected for each in errors if (each_expected := _expected(each)) is not None)
    )
    if expected:
        origin = marks.origins.get(first.path)
        given = str(first.input) if first.units and first.kind in _BOUNDS else format_value(first.input)
        given += f" (argument {origin})" if origin else ""
        return Problem(
            mark, f"{first.path_name} is {given}, but must be {' or '.join(expected)}", _remedy(first, marks)
        )
    what, fix = _sentence(first)
    if (origin := marks.origins.get(first.path)) is not None:
        what = f"{what} (argument {origin})"
    return Problem(mark, what, fix)


def format_value(value: object) -> str:
    """Describe a value for an error message: `the text 'abc'`, `a list`, or a number as it is."""
    if value is None:
        return "empty"
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, list | tuple):
        return "a list"
    if isinstance(value, str):
        return f"the text {value!r}" if len(value) <= 40 else f"the text {value[:40] + '...'!r}"
    return text_of(value)


_NUMBER = "a number"
_WITH_UNIT = "a number with a unit"
_WHOLE = "a whole number"
_BOOL = "true or false"
_SWITCHES: Mapping[str, str] = {"yes": "true", "on": "true", "no": "false", "off": "false"}
_TEXT = "text"
_TYPES: Mapping[str, str] = {
    "int_type": _WHOLE,
    "int_parsing": _WHOLE,
    "int_from_float": _WHOLE,
    "int_parsing_size": "a whole number with fewer digits",
    "float_type": _NUMBER,
    "float_parsing": _NUMBER,
    "finite_number": "a finite number",
    "bool_type": _BOOL,
    "bool_parsing": _BOOL,
    "string_type": _TEXT,
    "none_required": "empty",
    "dict_type": "a mapping",
    "mapping_type": "a mapping",
    "model_type": "a mapping",
    "model_attributes_type": "a mapping",
    "dataclass_type": "a mapping",
    "list_type": "a list",
    "tuple_type": "a list",
    "set_type": "a list",
    "frozen_set_type": "a list",
    "iterable_type": "a list",
}
_BOUNDS: Mapping[str, str] = {
    "greater_than": "greater than {gt}",
    "greater_than_equal": "at least {ge}",
    "less_than": "less than {lt}",
    "less_than_equal": "at most {le}",
    "multiple_of": "a multiple of {multiple_of}",
    "literal_error": "{expected}",
    "enum": "{expected}",
}
_REMEDIES: Mapping[str, str] = {
    _WHOLE: "write digits only, without quotes or a decimal point",
    _NUMBER: "write a number without quotes",
    _WITH_UNIT: "write the number without a unit",
    _BOOL: "write true or false without quotes (yes, no, on and off are text)",
    _TEXT: "put it in quotes",
    "a mapping": "write `key: value` lines below it, or {key: value, ...} after it",
    "a list": "write [a, b, ...]",
}


def _expected(error: _Error) -> str | None:
    """Return what the value must be, such as `at least 5` or `a number`; None for other kinds of errors."""
    if error.kind in _BOUNDS:
        plain = {key: _bound(value, error) for key, value in error.context.items()}
        return _BOUNDS[error.kind].format(**plain)
    return _TYPES.get(error.kind)


def _bound(value: object, error: _Error) -> str:
    if isinstance(value, int | float) and (units := error.units):
        return bound_text(value, units, error.input)
    return f"{value:g}" if isinstance(value, float) else str(value).replace("'", "")


def _remedy(error: _Error, marks: Marks) -> str:
    """Return the fix for a value of the wrong type or outside its range."""
    expected = _TYPES.get(error.kind, "")
    if isinstance(error.input, str) and (meant := _meant(error.input, expected, error, marks)):
        return f"write `{error.path[-1] if error.path else 'LIST'}: {meant}`"
    if expected in ("a mapping", "a list") and (fix := _indentation(error) or _only_key(error, marks)):
        return fix
    if error.kind in ("literal_error", "enum"):
        at = None if error.model is None else without_none(annotation_at(error.model, error.location))
        options = (*get_args(at),) if get_origin(at) is Literal else ()
        return suggestion(
            str(error.input), [one for one in options if isinstance(one, str)], "write one of them"
        )
    written = plain_value(error.input) if isinstance(error.input, str) else None
    if isinstance(written, int | float) and expected in (_WHOLE, _NUMBER, _BOOL):
        return "remove the quotes" if expected != _WHOLE or isinstance(written, int) else _REMEDIES[_WHOLE]
    if expected == _TEXT and isinstance(error.input, bool | int | float):
        return _text_for_number(error)
    if isinstance(written, str) and expected in (_WHOLE, _NUMBER) and split_quantity(written):
        expected = _WITH_UNIT
    return _example(error) or _REMEDIES.get(expected, "correct it")


def _text_for_number(error: _Error) -> str:
    """Return the fix for a number in place of a text: the model with this number, else quotes."""
    if error.path[-1:] == ("model",):
        return perhaps_meant(str(error.input))
    is_device = error.path[-1:] == ("port",)  # no port is a number
    return (_example(error) if is_device else "") or f'put it in quotes: "{text_of(error.input)}"'


def _meant(text: str, expected: str, error: _Error, marks: Marks) -> str:
    """Return the value that a text means: a list, `true` for `yes`, 0.3 for `30%`; else an empty text."""
    if expected == "a list":
        return _items(text, error, marks)
    if expected == _BOOL:
        return _SWITCHES.get(text.lower(), "")
    parts = split_quantity(text) if expected == _NUMBER else None
    return f"{float(parts[0]) / 100:g}" if parts is not None and parts[1] == "%" else ""


def _items(text: str, error: _Error, marks: Marks) -> str:
    """Return a text as the list that it means, such as `[pan, tilt]` for `pan, tilt`; else an empty text."""
    if items := list_text(text):
        return items
    if re.fullmatch(r"\[.*\]", text):  # in quotes
        return text
    names = re.findall(r"[\w.]+", text)
    at = None if error.model is None else without_none(annotation_at(error.model, (*error.location, 0)))
    if at is not str or not re.fullmatch(r"[\w., ]+|\*", text):
        return ""
    if error.path[-1] == "joints" and text in ("all", "*"):
        names = [str(path[1]) for path in marks.keys if path[0] == "joints" and len(path) == 2]
    return f"[{', '.join(names)}]" if names else ""


def _only_key(error: _Error, marks: Marks) -> str:
    """Return the fix for a value without its key, if only one key can be meant: `loop: 50`; else empty."""
    form = None if error.model is None else form_at(error.model, error.location)
    if form is None or error.input is None:
        return ""
    takes = keys_for(form, error.input)
    required = {name for name, info in form.model_fields.items() if info.is_required()}
    if required:
        meant = [name for name in takes if name in required]
    else:
        meant = takes if isinstance(error.input, str | list) else []  # many keys take a number
    if len(meant) > 1:  # 1 is a direction by chance only
        meant = [key for key in meant if get_origin(without_none(annotation_at(form, (key,)))) is not Literal]
    if len(meant) != 1:
        return ""
    keys = {meant[0]: yaml_text(error.input)}
    if issubclass(form, PlugInEntry) and keys[meant[0]].startswith("/dev/"):
        keys = {"type": example_at(form, ("type",)), "port": keys[meant[0]]}
    given = [path[1] for path in marks.keys if path[:-1] == ("joint_defaults",) and error.path[0] == "joints"]
    keys |= {name: example_at(form, (name,)) or "..." for name in sorted(required.difference(keys, given))}
    such = "write" if len(keys) == 1 else "write for example"
    entry = f"{{{', '.join(f'{name}: {text}' for name, text in keys.items())}}}"
    return f"{such} `{entry if isinstance(error.path[-1], int) else f'{error.path[-1]}: {entry}'}`"


def _is_key_of_entry(error: _Error) -> bool:
    """Return True if an entry's name is really a key of the entry, indented too little."""
    if _TYPES.get(error.kind) != "a mapping" or error.model is None or not error.path:
        return False
    form = form_at(error.model, error.location)
    return form is not None and error.path[-1] in form.model_fields


def _indentation(error: _Error) -> str:
    """Return the fix for a mapping that is indented wrongly or is a list, or the opposite; else empty."""
    if isinstance(error.input, dict) and (error.example or "[{").startswith("[{"):
        return "write `- ` before each entry, or [{...}] around it"
    if error.unindented:
        *others, last = error.unindented
        named = f"{', '.join(others)} and {last}" if others else last
        return f"write a name with a colon above {named}, and indent {named} below it"
    if isinstance(error.input, list) and error.input and all(isinstance(one, dict) for one in error.input):
        names = [one.get("name", "NAME") for one in error.input]
        return f"write `{names[0]}: {{...}}` for each entry, without `-` before it"
    return ""


def _example(error: _Error) -> str:
    key = error.path[-1] if error.path else ""
    if error.input is False and key in SWITCHED_OFF:
        return SWITCHED_OFF[key]
    example = error.example if isinstance(key, str) else ""
    if not example and error.model is not None and error.path[1:] and error.location[1:]:
        # An entry has no example of its own, but its section has one. The last step may be a union's member.
        steps = error.location[: -1 if error.location[-1] == error.path[-1] else -2]
        key, example = error.path[-2], example_at(error.model, steps)
    return f"write for example `{key}: {example}`" if example else ""


def _sentence(error: _Error) -> tuple[str, str]:
    """Return problem and fix for errors about keys, lengths or patterns, and of validators."""
    sentence = _SENTENCES.get(error.kind)
    return sentence(error) if sentence is not None else (f"{error.path_name}: {error.kind}", "correct it")


def _sentence_missing(error: _Error) -> tuple[str, str]:
    key = error.path[-1]
    parent = path_text(error.path[:-1])
    if isinstance(key, int):
        return f"{parent} has too few values", "add the missing ones"
    example = error.example or _good_value(error) or "..."
    return f"{parent} has no {key}", f"add `{key}: {example}`"


def _sentence_unknown(error: _Error) -> tuple[str, str]:
    key, parent = str(error.path[-1]), path_text(error.path[:-1])
    known, refused = ((), {}) if error.model is None else _keys_at(error.model, error.location[:-1])
    if len(error.location) == 1:
        known = (*known, *error.beside)
    if key in refused:
        return f"{path_text(error.path)} is not allowed here", refused[key]
    if why := broken_features().get(key):
        return what_and_fix(why)
    if error.remedy is not None:
        keys = error.remedy.keys
        named = f"an unknown key {key!r}" if len(keys) == 1 else f"unknown keys {keys[0]!r} and {keys[1]!r}"
        return f"{parent} has {named}", error.remedy.fix
    otherwise = f"remove it; known keys: {', '.join(known)}" if known else "remove it"
    return f"{parent} has an unknown key {key!r}", suggestion(key, known, otherwise)


def _sentence_length(error: _Error) -> tuple[str, str]:
    least, most = error.context.get("min_length"), error.context.get("max_length")
    if error.kind in ("too_long", "string_too_long"):
        counted = "entries" if error.kind == "too_long" else "characters"
        if isinstance(error.input, list) and {int, str} == {type(one) for one in error.input}:
            return f"{error.path_name} is too long", "write a point instead of each decimal comma"
        return f"{error.path_name} is too long", f"write at most {most} {counted}"
    if error.kind == "string_too_short":
        return f"{error.path_name} is too short", "write something"
    return f"{error.path_name} has too few entries", f"write at least {least}"


def _sentence_own(error: _Error) -> tuple[str, str]:
    """Return problem and fix that a validator raised, which may be a plug-in's: `problem; fix`."""
    if "what" in error.context and "fix" in error.context:
        what, fix = str(error.context["what"]), str(error.context["fix"])
    else:
        what, fix = what_and_fix(error.context.get("error", "the value is not accepted"))
    return f"{error.path_name}: {what}", fix or "correct it"


def _sentence_json(error: _Error) -> tuple[str, str]:
    return f"{error.path_name} is not JSON ({error.context.get('error')})", "correct it"


def _sentence_pattern(error: _Error) -> tuple[str, str]:
    pattern = error.context.get("pattern")
    return f"{error.path_name} is {format_value(error.input)}, but must match {pattern}", "correct it"


_SENTENCES: Mapping[str, Callable[[_Error], tuple[str, str]]] = {
    "missing": _sentence_missing,
    "missing_argument": _sentence_missing,
    "extra_forbidden": _sentence_unknown,
    "too_short": _sentence_length,
    "too_long": _sentence_length,
    "string_too_short": _sentence_length,
    "string_too_long": _sentence_length,
    "string_pattern_mismatch": _sentence_pattern,
    "json_invalid": _sentence_json,
    "value_error": _sentence_own,
    "assertion_error": _sentence_own,
    "dxlrun": _sentence_own,
}


def _keys_at(
    model: type[BaseModel], location: tuple[str | int, ...]
) -> tuple[tuple[str, ...], Mapping[str, str]]:
    """Return the keys that the model at a location has, and a fix for each key that it refuses.

    A model can list expected keys that are not possible (`refused`), and keys that are removed before the
    model is validated (`read_before`).
    """
    owner = form_at(model, location)
    if owner is None:
        return (), {}
    refused: Mapping[str, str] = getattr(owner, "refused", {})
    return (*owner.model_fields, *getattr(owner, "read_before", ())), refused


def _notes_at(model: type[BaseModel], location: tuple[str | int, ...]) -> Iterator[object]:
    """Yield the metadata (such as a quantity) of the type of the value at pydantic's location."""
    at = annotation_at(model, location)
    while get_origin(at) in (Annotated, Union, UnionType):
        if get_origin(at) is Annotated:
            at, *notes = get_args(at)
            yield from notes
        else:
            at = next(arm for arm in get_args(at) if arm is not type(None))
