"""Arguments: `arguments:` of a robot file, `name:=value` on the command line, and `${name}` in values.

A value that consists of `${name}` alone has the argument's type: text if the default is text, otherwise the
type that YAML reads. Inside longer text the argument is inserted as text. `$${` stands for a plain `${`.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Annotated

from pydantic import AfterValidator, ValidationError

from dxlrun.description.base_form import Form, key, validation_error
from dxlrun.description.document import FilledScalar, KeyPath, Marks, literal, plain_value, text_of
from dxlrun.description.form_problems import problems_of
from dxlrun.errors import Mark, Problem, suggestion

COMMAND_LINE = Mark("command line", 0, 0)  # place of a problem of `name:=value`

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*", re.ASCII)
_OF_SHELL = re.compile(r"\$(?:\((?:arg )?)?(\w+)\)?")  # as in a shell, or a launch file of ROS
_USE = re.compile(r"\$\$\{|\$\{([^{}]*)(\}?)")


def _scalar(value: object) -> object:
    if isinstance(value, dict | list):
        raise validation_error(
            "the default of an argument must be one value", "write text, a number, true or false"
        )
    return value


class Argument(Form):
    """Form of one entry under `arguments:` of a robot file: its default value and help text."""

    default: Annotated[object, AfterValidator(_scalar)] = key(
        "Value of the argument if the command line gives none; an argument without a default is required.",
        "sim",
        None,
    )
    help: str = key("Purpose of the argument.", '"serial port of the adapter"', "")


class Arguments:
    """All arguments of a robot file with their values in one run, from defaults and command line."""

    def __init__(self, block: object, given: Mapping[str, str], marks: Marks) -> None:
        """Compare the command line with the declared arguments; mistakes are added to `problems`.

        Args:
            block: The `arguments:` block as read from the file; None: there was none.
            given: Values from the command line, by name.
            marks: Places in the file.
        """
        self.problems: list[Problem] = []
        self.texts: dict[str, str] = {}
        """Value of each argument as text, by name; arguments without a value are missing."""
        self._values: dict[str, object] = {}
        self._names: tuple[str, ...] = ()
        self._given = given
        self._marks = marks
        if isinstance(block, dict):
            self._names = tuple(block)
            for name, entry in block.items():
                self._declare(name, entry)
        elif block is not None or marks.has(("arguments",)):
            self._problem(
                ("arguments",),
                "arguments is not a mapping",
                "write `arguments: {port: {default: sim, help: ...}}`",
            )
        for name in given:
            if name not in self._names:
                what = f"argument {name}:={given[name]} is not declared in the robot file"
                self.problems.append(Problem(COMMAND_LINE, what, _suggestion(name, self._names)))

    def _declare(self, name: str, entry: object) -> None:
        path = ("arguments", name)
        if not _NAME.fullmatch(name):
            self._problem(path, f"{name!r} is not a valid name of an argument", "use letters, digits and _")
        if isinstance(entry, str | int | float):
            self._problem(
                path, f"{name} has no key for its default", f"write `{name}: {{default: {text_of(entry)}}}`"
            )
            return
        try:
            default = Argument.model_validate(entry).default
        except ValidationError as error:
            self.problems.extend(problems_of(error, self._marks, path, model=Argument))
            return
        if name in self._given:
            text = self._given[name]
            # With a text as the default the value stays text, even if it looks like a number.
            self._values[name] = text if isinstance(default, str) else plain_value(text)
            self.texts[name] = text
        elif default is not None:
            self._values[name] = default
            self.texts[name] = text_of(default)
        else:
            self._problem(
                path,
                f"the argument {name} has no value",
                f"write {name}:=... after the robot file, or give it a default",
            )

    def _problem(self, path: KeyPath, what: str, fix: str) -> None:
        self.problems.append(Problem(self._marks.key(*path), what, fix))

    def insert_arguments(self, path: KeyPath, text: str, quoted: bool) -> FilledScalar:
        """Insert the arguments into a scalar of the file, at a path; return its value and its origin."""
        if "${" not in text:
            return self._without_arguments(path, text, quoted)
        if path[:1] == ("arguments",):
            if path[-1] == "help":
                return literal(path, text, quoted)
            return _unusable("the default of an argument cannot contain ${...}", "write the value")
        uses = [match for match in _USE.finditer(text) if match[0] != "$${"]
        wrong = tuple(problem for use in uses for problem in self._wrong(use))
        names = [use[1].strip() for use in uses]
        if wrong or not all(name in self._values for name in names):
            return FilledScalar(None, problems=wrong, unknown=True)
        origin = ", ".join(f"{name}:={self.texts[name]}" for name in dict.fromkeys(names)) or None
        if len(uses) == 1 and uses[0][0] == text.strip():
            return FilledScalar(self._values[names[0]], origin)
        filled = _USE.sub(lambda use: "${" if use[0] == "$${" else self.texts[use[1].strip()], text)
        return FilledScalar(filled if quoted else plain_value(filled), origin)

    def _without_arguments(self, path: KeyPath, text: str, quoted: bool) -> FilledScalar:
        if (shell := _OF_SHELL.fullmatch(text)) and shell[1] in self._names:
            return _unusable(f"{text} is not an argument", f'write "${{{shell[1]}}}"')
        return literal(path, text, quoted)

    def _wrong(self, use: re.Match[str]) -> list[tuple[str, str]]:
        name = use[1].strip()
        if not use[2]:
            return [("${ has no closing }", "write ${name}, or $${ for a literal ${")]
        if name in self._names:
            return []
        return [(f"argument {name!r} is not declared", _suggestion(name, self._names))]


def refuse_arguments(path: KeyPath, text: str, quoted: bool) -> FilledScalar:
    """Return the value of a scalar in a file without arguments, as a motion file: `${` is a problem."""
    if "${" in text:
        return _unusable("this file cannot contain ${...}", "write the value")
    return literal(path, text, quoted)


def _unusable(what: str, fix: str) -> FilledScalar:
    return FilledScalar(None, problems=((what, fix),), unknown=True)


def _suggestion(name: str, known: Sequence[str]) -> str:
    if not known:
        return f"remove it, or declare it: `arguments: {{{name}: {{default: ..., help: ...}}}}`"
    return suggestion(name, known, f"known arguments: {', '.join(known)}")
