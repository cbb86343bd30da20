"""Checked values: values of a file of another program, each refused at its place if it is wrong."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence

from dxlrun import InputError
from dxlrun.tooling.files import FileContent, Mark, Problem

Step = str | int


def refused(mark: Mark, what: str, fix: str) -> InputError:
    """Return an InputError about a place of a file."""
    return InputError([Problem(mark, what, fix)])


def value_at(content: FileContent, *path: Step) -> object:
    """Return the value at a path of keys and indices; None if it is not in the file."""
    at: object = content.values
    for step in path:
        if isinstance(at, Mapping) and step in at:
            at = at[str(step)]
        elif isinstance(at, list) and isinstance(step, int) and step < len(at):
            at = at[step]
        else:
            return None
    return at


def number_at(content: FileContent, *path: Step, default: float | None = None) -> float:
    """Return a finite number; `default` if the file does not have it. Raises InputError."""
    value = value_at(content, *path)
    if value is None and default is not None:
        return default
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise wrong(content, path, value, "a number")
    return float(value)


def whole_at(content: FileContent, *path: Step, default: int | None = None) -> int:
    """Return a whole number; `default` if the file does not have it. Raises InputError."""
    number = number_at(content, *path, default=None if default is None else float(default))
    if number != int(number):
        raise wrong(content, path, number, "a whole number")
    return int(number)


def text_at(content: FileContent, *path: Step, default: str | None = None) -> str:
    """Return a text; `default` if the file does not have it. Raises InputError."""
    value = value_at(content, *path)
    if value is None and default is not None:
        return default
    if not isinstance(value, str):
        raise wrong(content, path, value, "text")
    return value


def mapping_at(content: FileContent, *path: Step) -> Mapping[str, object]:
    """Return a mapping. Raises InputError."""
    value = value_at(content, *path)
    if not isinstance(value, Mapping):
        raise wrong(content, path, value, "a mapping")
    return value


def list_at(content: FileContent, *path: Step) -> Sequence[object]:
    """Return a list. Raises InputError."""
    value = value_at(content, *path)
    if not isinstance(value, list):
        raise wrong(content, path, value, "a list")
    return value


def wrong(content: FileContent, path: Sequence[Step], value: object, wanted: str) -> Exception:
    """Return an InputError about a value that is missing or of another type."""
    name = ".".join(map(str, path)) or "the file"
    if value is None:
        return content.refusal(f"{name} is missing", f"add it: {wanted}; or export the file again", *path)
    found = f"{value!r}" if isinstance(value, int | float | str) else "something else"
    return content.refusal(f"{name} is {found:.60}, but must be {wanted}", "correct it", *path)


def valid_name(name: str) -> str:
    """Return a name as robot files accept it: letters, digits and `_`, a letter first."""
    folded = re.sub(r"\W", "_", name, flags=re.ASCII).strip("_")
    return folded if folded[:1].isalpha() else f"joint_{folded}"
