"""Problems: what pydantic found, as sentences of ours at the place in the file where each thing stands."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Mapping, Set

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from dxlrun.description.fields import Field, field_at, keys_at
from dxlrun.description.source.marks import KeyPath, Marks
from dxlrun.description.source.scalars import plain_value, text_of
from dxlrun.errors import Mark, Problem


def problems_of(
    error: ValidationError,
    marks: Marks,
    prefix: KeyPath = (),
    *,
    model: type[BaseModel] | None = None,
    unknown: Set[KeyPath] = frozenset(),
) -> list[Problem]:
    """Return one problem for each place that a model refused, in file order.

    `prefix` is where the model's data stands in the file. With `model`, unknown keys get the nearest known
    one and missing keys an example. Nothing is said about `unknown` paths and what is below them.
    """
    return _problems(error.errors(include_url=False), marks, prefix, model, unknown)


def _problems(
    errors: Iterable[ErrorDetails],
    marks: Marks,
    prefix: KeyPath,
    model: type[BaseModel] | None,
    unknown: Set[KeyPath] = frozenset(),
) -> list[Problem]:
    found: dict[KeyPath, list[_Complaint]] = {}
    for details in errors:
        complaint = _Complaint(details, marks, prefix, model)
        if complaint.meant and not any(
            complaint.path[:end] in unknown for end in range(len(complaint.path) + 1)
        ):
            found.setdefault(complaint.path, []).append(complaint)
    problems = [_merged(complaints, marks) for complaints in found.values()]
    return sorted(problems, key=lambda problem: problem.mark)


def sentences_of(error: ValidationError, what: str, model: type[BaseModel], most: int) -> list[str]:
    """Return one sentence for each of the first places that a model refused in data without a file.

    `what` is what the data are called: `posvel of head has no velocities; add ...`.
    """
    errors = error.errors(include_url=False)[:most]
    places: dict[KeyPath, Mark] = {}
    for details in errors:
        location = details["loc"]
        places |= {(what, *location[:end]): Mark(what) for end in range(len(location) + 1)}
    problems = _problems(errors, Marks(what, places, places), (what,), model)
    return [f"{problem.what}; {problem.fix}" for problem in problems]


def places_of(error: ValidationError, marks: Marks) -> list[KeyPath]:
    """Return every place that a model refused."""
    return [_Complaint(details, marks, (), None).path for details in error.errors(include_url=False)]


class _Complaint:
    """One error of pydantic, and the place in the file that it is about."""

    def __init__(
        self, details: ErrorDetails, marks: Marks, prefix: KeyPath, model: type[BaseModel] | None
    ) -> None:
        self.kind = details["type"]
        self.context: Mapping[str, object] = details.get("ctx", {})
        self.input: object = details["input"]
        self.model = model
        self.location = details["loc"]
        of_key = self.location[-1:] == ("[key]",)
        location = self.location[:-1] if of_key else self.location
        self.missing = self.kind in ("missing", "missing_argument")
        path = _in_file(location[:-1] if self.missing else location, marks, prefix)
        self.path: KeyPath = (*path, location[-1]) if self.missing else path
        self.at_key = of_key or self.missing or self.kind == "extra_forbidden"

    @property
    def meant(self) -> bool:
        """Say whether it tells something: a list is not too short because its items are wrong."""
        least = self.context.get("min_length")
        return not (
            self.kind == "too_short"
            and isinstance(least, int)
            and isinstance(self.input, list | dict)
            and len(self.input) >= least
        )

    @property
    def name(self) -> str:
        """The path as a person says it: `joints.head.limits.position[1]`."""
        return said(self.path)

    def field(self) -> Field | None:
        """Return what the model says about the key."""
        return None if self.model is None else field_at(self.model, self.location)


def said(path: KeyPath) -> str:
    """Return a path as a person says it: `joints.head.limits.position[1]`."""
    text = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in path)
    return text.removeprefix(".") or "the file"


def _in_file(location: Iterable[str | int], marks: Marks, prefix: KeyPath) -> KeyPath:
    """Return the part of pydantic's location that the file has; names of union members are not in it."""
    path = prefix
    for step in location:
        if marks.has((*path, step)):
            path = (*path, step)
    return path


def _merged(complaints: list[_Complaint], marks: Marks) -> Problem:
    """Return one problem of a place; the members of a union each have complained about it."""
    first = complaints[0]
    mark = marks.key(*first.path) if first.at_key else marks.value(*first.path)
    wanted = list(dict.fromkeys(want for each in complaints if (want := _wanted(each)) is not None))
    if wanted:
        origin = marks.origins.get(first.path)
        given = shown(first.input) + (f" (argument {origin})" if origin else "")
        return Problem(mark, f"{first.name} is {given}, but must be {' or '.join(wanted)}", _remedy(first))
    what, fix = _sentence(first)
    if (origin := marks.origins.get(first.path)) is not None:
        what = f"{what} (argument {origin})"
    return Problem(mark, what, fix)


def shown(value: object) -> str:
    """Return a value as an error shows it."""
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
_WHOLE = "a whole number"
_BOOL = "true or false"
_TEXT = "text"
_WANTED: Mapping[str, str] = {
    "int_type": _WHOLE,
    "int_parsing": _WHOLE,
    "int_from_float": _WHOLE,
    "int_parsing_size": "a whole number of ordinary size",
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
    _WHOLE: "write digits only, without quotes and without a point",
    _NUMBER: "write a number without quotes",
    _BOOL: "write true or false without quotes (yes, no, on and off are text)",
    _TEXT: "put it in quotes",
    "a mapping": "write `key: value` lines below it, or {key: value, ...} behind it",
    "a list": "write [a, b, ...]",
}


def _wanted(complaint: _Complaint) -> str | None:
    """Return what the value must be, when that is all there is to say."""
    if complaint.kind in _BOUNDS:
        plain = {key: _bound(value) for key, value in complaint.context.items()}
        return _BOUNDS[complaint.kind].format(**plain)
    return _WANTED.get(complaint.kind)


def _bound(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value).replace("'", "")


def _remedy(complaint: _Complaint) -> str:
    """Return how to fix a value of a wrong type or outside its range."""
    wanted = _WANTED.get(complaint.kind, "")
    if complaint.kind in ("literal_error", "enum"):
        return "write it so"
    written = plain_value(complaint.input) if isinstance(complaint.input, str) else None
    if isinstance(written, int | float) and wanted in (_WHOLE, _NUMBER, _BOOL):
        return "take the quotes away" if wanted != _WHOLE or isinstance(written, int) else _REMEDIES[_WHOLE]
    if wanted == _TEXT and isinstance(complaint.input, bool | int | float):
        return f'put it in quotes: "{text_of(complaint.input)}"'
    return _example(complaint) or _REMEDIES.get(wanted, "correct it")


def _example(complaint: _Complaint) -> str:
    field = complaint.field()
    key = complaint.path[-1] if complaint.path else ""
    if field is None or field.example is None or not isinstance(key, str):
        return ""
    return f"write for example `{key}: {field.example}`"


def _sentence(complaint: _Complaint) -> tuple[str, str]:
    """Return what is wrong and how to fix it, for the kinds that need more than a value."""
    teller = _TELLERS.get(complaint.kind)
    return teller(complaint) if teller is not None else (f"{complaint.name}: {complaint.kind}", "correct it")


def _tell_missing(complaint: _Complaint) -> tuple[str, str]:
    key = complaint.path[-1]
    parent = said(complaint.path[:-1])
    if isinstance(key, int):
        return f"{parent} has too few values", "add the others"
    field = complaint.field()
    example = "..." if field is None or field.example is None else field.example
    return f"{parent} has no {key}", f"add `{key}: {example}`"


def _tell_unknown(complaint: _Complaint) -> tuple[str, str]:
    key, parent = str(complaint.path[-1]), said(complaint.path[:-1])
    known, refused = (
        ((), {}) if complaint.model is None else keys_at(complaint.model, complaint.location[:-1])
    )
    if key in refused:
        return f"{said(complaint.path)} is not possible", refused[key]
    close = difflib.get_close_matches(key.lower().replace("-", "_"), known, n=1)
    if close:
        return f"{parent} has an unknown key {key!r}", f"did you mean {close[0]}?"
    return (
        f"{parent} has an unknown key {key!r}",
        f"take it out; known keys: {', '.join(known)}" if known else "take it out",
    )


def _tell_length(complaint: _Complaint) -> tuple[str, str]:
    least, most = complaint.context.get("min_length"), complaint.context.get("max_length")
    if complaint.kind in ("too_long", "string_too_long"):
        return f"{complaint.name} is too long", f"keep {most} at most"
    if complaint.kind == "string_too_short":
        return f"{complaint.name} is too short", "write something"
    return f"{complaint.name} has too few entries", f"write at least {least}"


def _tell_own(complaint: _Complaint) -> tuple[str, str]:
    """Return what a validator of ours or of a plug-in said: `what; how to fix it`."""
    if "what" in complaint.context and "fix" in complaint.context:
        what, fix = str(complaint.context["what"]), str(complaint.context["fix"])
    else:
        what, _, fix = str(complaint.context.get("error", "it is refused")).partition("; ")
    return f"{complaint.name}: {what}", fix or "correct it"


def _tell_json(complaint: _Complaint) -> tuple[str, str]:
    return f"{complaint.name} is no JSON ({complaint.context.get('error')})", "correct it"


def _tell_pattern(complaint: _Complaint) -> tuple[str, str]:
    pattern = complaint.context.get("pattern")
    return f"{complaint.name} is {shown(complaint.input)}, which does not match {pattern}", "correct it"


_TELLERS: Mapping[str, Callable[[_Complaint], tuple[str, str]]] = {
    "missing": _tell_missing,
    "missing_argument": _tell_missing,
    "extra_forbidden": _tell_unknown,
    "too_short": _tell_length,
    "too_long": _tell_length,
    "string_too_short": _tell_length,
    "string_too_long": _tell_length,
    "string_pattern_mismatch": _tell_pattern,
    "json_invalid": _tell_json,
    "value_error": _tell_own,
    "assertion_error": _tell_own,
    "dxlrun": _tell_own,
}
