"""What a person writes for a running robot: `key=value` words or a YAML file, to what the gateway takes.

Values are YAML. Where a controller takes what motions are made of (positions, velocities, a trajectory),
quantities need their units, as in a motion file: nobody can see whether `positions=[60]` was meant in deg or
rad. Efforts and PWM are plain numbers: in which unit an effort is depends on the servo's model.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from dxlrun.description.source.marks import KeyPath
from dxlrun.description.source.problems import said
from dxlrun.description.source.syntax import parse, read_text
from dxlrun.description.source.tree import Grown, grow, literal
from dxlrun.description.units import angle, angular_acceleration, angular_velocity, duration
from dxlrun.errors import InputError, Problem

_WORDS = "command line"
_DRIVEN = frozenset({"positions", "velocities", "efforts", "pwm"})
"""What the commands of the group controllers have."""


def _seconds(text: str) -> float:
    return duration(text) / 1e9


def _effort(value: object) -> object:
    if isinstance(value, str):
        raise ValueError(
            f"{value!r} is text; write the number in what the model measures (Nm, A or the fraction of its "
            "most), such as 0.1 for 100 mA"
        )
    return value


def _fraction(value: object) -> object:
    if isinstance(value, str):
        raise ValueError(f"{value!r} is text; write the fraction of the full voltage, such as 0.2 for 20 %")
    return value


QUANTITIES: Mapping[str, Callable[[str], object]] = {
    "positions": angle,
    "velocities": angular_velocity,
    "accelerations": angular_acceleration,
    "efforts": _effort,
    "pwm": _fraction,
    "time": _seconds,
    "start_in": _seconds,
}
"""Keys of commands -> what makes rad, rad/s, rad/s^2 or s of a quantity with its unit."""


@dataclass(frozen=True, slots=True)
class Written:
    """A command or a controller's entry, as it was written; raises InputError with all that is wrong."""

    grown: Grown
    in_words: bool

    @classmethod
    def read(cls, words: Sequence[str], file: Path | None) -> Written:
        """Read `key=value` words, or a file; raises InputError for both, and for what is no YAML."""
        if file is not None and words:
            raise InputError(f"{words[0]!r} and --file say two things; give the words, or the file")
        if file is not None:
            text, name = read_text(file), str(file)
        else:
            text, name = "\n".join(map(_line, words)) or "{}", _WORDS
        try:
            written = cls(grow(parse(text, name), name, literal), in_words=file is None)
        except InputError as error:
            raise _told(error.problems, file is None) from None
        if written.grown.problems:
            raise _told(written.grown.problems, file is None)
        return written

    @property
    def data(self) -> dict[str, object]:
        """As it was written."""
        return self.grown.data

    def in_si(self) -> dict[str, object]:
        """Return it with plain numbers (rad, rad/s, rad/s^2, s) for what motions are made of."""
        problems: list[Problem] = []
        result = {key: self._value(value, (key,), problems) for key, value in self.data.items()}
        if problems:
            raise _told(problems, self.in_words)
        return result

    def _value(self, value: object, path: KeyPath, problems: list[Problem]) -> object:
        if isinstance(value, dict):
            return {key: self._value(inner, (*path, key), problems) for key, inner in value.items()}
        if isinstance(value, list):
            return [self._value(inner, (*path, index), problems) for index, inner in enumerate(value)]
        quantity = QUANTITIES.get(next(str(step) for step in reversed(path) if isinstance(step, str)))
        if quantity is None or value is None:
            return value
        try:
            return quantity(value)  # type: ignore[arg-type]  # it says of a number that the unit is missing
        except ValueError as error:
            what, _, mend = str(error).partition("; ")
            problems.append(Problem(self.grown.marks.value(*path), f"{said(path)}: {what}", mend))
            return None


def is_played(kind: str, schema: Mapping[str, object]) -> bool:
    """Say whether a command is like those of the standard controllers, so that its quantities have units."""
    properties = schema.get("properties")
    names = set(properties) if isinstance(properties, dict) else set()
    return kind == "trajectory" or (bool(names) and names <= _DRIVEN)


def _line(word: str) -> str:
    key, sign, value = word.partition("=")
    if not sign or not key.isidentifier() or "\n" in value:
        raise InputError(f"{word!r} says nothing; write key=value, such as 'positions=[30 deg, 0 deg]'")
    return f"{key}: {value}"


def _told(problems: Sequence[Problem], in_words: bool) -> InputError:
    """Return the error: places for a file, plain sentences for words, where lines and columns say nothing."""
    if not in_words:
        return InputError(problems)
    return InputError("\n".join(f"{problem.what}; {problem.fix}" for problem in problems))
