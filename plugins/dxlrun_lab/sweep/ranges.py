"""Ranges: `PATH=LO..HIxN` and `PATH=a,b,c` of the command line become the values of one parameter."""

from __future__ import annotations

import math
import re

import msgspec

from dxlrun.description.arguments import COMMAND_LINE
from dxlrun.description.document import KeyPath, plain_value
from dxlrun.description.problems import path_text
from dxlrun.errors import Mark

Value = str | float | bool
"""As the robot file has it (int included): 0.5, `5 rad/s^2`, true."""

HOW = "write PATH=LO..HIxN, PATH=LO..HIxNlog or PATH=A,B,C"
MOST_VALUES = 10_000
_DIGITS = 12
"""Significant digits of a computed value: 0.1 + 0.2 is 0.3."""
_RANGE = re.compile(r"(?P<low>.*?)\.\.(?P<high>.*)x\s*(?P<count>\d+)\s*(?P<log>log)?")
_NUMBER = re.compile(
    r"(?P<number>[-+]?(?:\d+(?:_\d+)*)?(?:\.\d*)?(?:[eE][-+]?\d{1,3})?)\s*(?P<unit>[A-Za-z/%].*)?"
)
_STEP = re.compile(r"(?P<key>[A-Za-z_][A-Za-z0-9_]*)(?P<indices>(?:\[\d+\])*)")


class Parameter(msgspec.Struct, frozen=True):
    """One value of the robot file that the sweep changes, and what it is in turn."""

    name: str
    """As it was written: `gains.p`."""
    steps: KeyPath
    values: tuple[Value, ...]
    unit: str = ""
    """Of all values: `rad/s^2`; empty for plain numbers and for words."""
    place: KeyPath = ()
    """Where it is in the robot file, `("arguments", "rate")` for an argument; empty: not looked up yet."""
    mark: Mark = Mark(COMMAND_LINE)
    """Where it stands"""

    @property
    def argument(self) -> str | None:
        """The argument's name; None: it is none."""
        return str(self.place[1]) if self.place[0] == "arguments" else None

    @property
    def place_text(self) -> str:
        """The place as text; of an argument its name."""
        return self.argument or path_text(self.place)

    @property
    def cells(self) -> tuple[float, ...] | tuple[str, ...]:
        """The values as a table has them: numbers without their unit, else words."""
        numbers = [number for number, _ in map(_split, self.values) if number is not None]
        if len(numbers) == len(self.values):
            return tuple(map(float, numbers))
        return tuple(str(value).lower() if isinstance(value, bool) else str(value) for value in self.values)


def parse_range(text: str) -> Parameter:
    """Read one `--over`; raises ValueError with `what; how to fix it`."""
    path, sign, values = text.partition("=")
    path, values = path.strip(), values.strip()
    if not sign or not path or not values:
        raise ValueError(f"this names no range; {HOW}, as in gains.p=0.5..3x8")
    steps = _steps(path)
    if ".." in values:
        found = _RANGE.fullmatch(values)
        if found is None:
            raise ValueError(f"{values!r} has no number of points; {HOW}, as in {path}=0.5..3x8")
        return _spaced(path, steps, found)
    words = [word.strip() for word in values.split(",")]
    if not all(words):
        raise ValueError(f"{values!r} has an empty value; {HOW}")
    if (twice := next((word for word in words if words.count(word) > 1), None)) is not None:
        raise ValueError(f"{twice} is given twice; give each value once")
    read = tuple(_scalar(word) for word in words)
    units = {unit for _, unit in map(_split, read)}
    if len(units) > 1:
        raise ValueError(
            f"its values have different units ({', '.join(map(_unit, sorted(units)))}); give all one"
        )
    return Parameter(path, steps, read, next(iter(units)))


def _steps(path: str) -> KeyPath:
    steps: list[str | int] = []
    for part in path.split("."):
        found = _STEP.fullmatch(part)
        if found is None:
            raise ValueError(
                f"{path!r} is no place in a robot file; name keys with dots between, as in gains.p, "
                "and a list's item as limits.position[0]"
            )
        steps.append(found["key"])
        steps += [int(index) for index in re.findall(r"\d+", found["indices"])]
    return tuple(steps)


def _spaced(path: str, steps: KeyPath, found: re.Match[str]) -> Parameter:
    (low, low_unit), (high, unit) = (_split(_scalar(found[end].strip())) for end in ("low", "high"))
    count, log = int(found["count"]), found["log"] is not None
    if low is None or high is None:
        wrong = found["low" if low is None else "high"].strip()
        raise ValueError(f"{wrong or 'nothing'!r} is no number; {HOW}")
    if low_unit != unit:
        raise ValueError(f"its ends have different units ({_unit(low_unit)}, {_unit(unit)}); give both one")
    if not low < high:
        raise ValueError(f"the range is empty: {low:g} is not below {high:g}; {HOW} with LO below HI")
    if not 2 <= count <= MOST_VALUES:
        raise ValueError(f"x{count} is no number of points; give from 2 to {MOST_VALUES}, or one value")
    if log and low <= 0:
        raise ValueError(f"a range with log begins above 0, not at {low:g}; begin above 0, or leave out log")
    part = [step / (count - 1) for step in range(count)]
    numbers = [low * (high / low) ** x for x in part] if log else [low + (high - low) * x for x in part]
    numbers[0], numbers[-1] = low, high
    if isinstance(low, int) and isinstance(high, int) and "registers" in steps:
        numbers = [float(round(number)) for number in numbers]  # registers hold whole numbers
        if len(set(numbers)) < count:
            raise ValueError(f"{low}..{high} has fewer than {count} whole numbers; give fewer points")
    whole = isinstance(low, int) and isinstance(high, int)
    return Parameter(path, steps, tuple(_written(number, unit, whole=whole) for number in numbers), unit)


def _written(number: float, unit: str, *, whole: bool) -> Value:
    """Return a number as the robot file would have it; without a point where the ends have none."""
    rounded = float(f"{number:.{_DIGITS}g}")
    plain: float = int(rounded) if whole and rounded.is_integer() else rounded
    return f"{plain!r} {unit}" if unit else plain


def _scalar(word: str) -> Value:
    value = plain_value(word)
    return value if isinstance(value, str | bool | int | float) else word


def _split(value: Value) -> tuple[float | None, str]:
    """Return number and unit of a value; None for a word."""
    if isinstance(value, bool):
        return None, ""
    if isinstance(value, int | float):
        return (value, "") if math.isfinite(value) else (None, "")
    found = _NUMBER.fullmatch(value.strip())
    if found is None or not any(character.isdigit() for character in found["number"]):
        return None, ""
    number = plain_value(found["number"])
    if isinstance(number, bool) or not isinstance(number, int | float) or not math.isfinite(number):
        return None, ""
    return number, (found["unit"] or "").strip()


def _unit(unit: str) -> str:
    return unit or "none"
