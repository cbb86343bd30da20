"""Unknown keys: finds the key that was meant, for terms of other systems and misplaced keys.

The terms are in `words.toml`. The forms determine which keys exist at which place.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable, Collection, Iterator, Mapping
from functools import cache
from pathlib import Path

import msgspec
from pydantic import BaseModel

from dxlrun.description.base_form import folded
from dxlrun.description.mistakes.forms import (
    NAME,
    Place,
    entries_of,
    example_at,
    keys_for,
    keys_of,
    may_be_entry,
    may_be_value,
    places_of,
    section_of,
)
from dxlrun.errors import near, suggestion

_REMARKS = {"comment", "comments", "description", "note", "notes", "remark", "remarks", "author", "version"}
_LONGEST = 80  # characters of a value in a message
_TURN = 6.3  # rad; a larger limit is in deg
_LARGEST_ANGLE = 720  # deg; a larger number counts ticks of a servo
_PARTS_OF_JOINT = {"Limits": "limits", "GoalTolerance": "tolerance", "SharedTolerance": "tolerance"}
_SERVO_FORM = "ServoEntry"  # base of the forms of servos with keys of a joint


_NEEDLESS = {
    "type": "remove it: only controllers have a type",
    "model": "remove it: the joint's controller sets the mode of the servo",
    "revolute": "remove it: joints turn by default",
    "continuous": "write `continuous: true`",
    "prismatic": "write `travel_per_turn: 94.2 mm`, the travel per turn of the servo",
    "fixed": "remove the joint: a joint without a servo belongs in the URDF only",
    "position": "remove it: the joint's controller sets the mode of the servo",
}
"""Values of a joint's needless keys `type` and `mode`, each with the fix."""
SWITCHED_OFF = {"recording": "remove it, and run with --no-record"}
"""Fixes for sections of the file whose value is `false`."""


class Remedy(msgspec.Struct, frozen=True):
    """Fix for one unknown key, or for two unknown keys (such as lower and upper) that mean one key."""

    keys: tuple[str, ...]
    fix: str
    means: str = ""
    """Key that was meant; it is then not reported as missing."""


class _Meaning(msgspec.Struct, frozen=True):
    """Key that a foreign term means, and how to convert its value: a key of `_CONVERSIONS`."""

    place: Place
    kind: str


class UnknownKeyContext(msgspec.Struct, frozen=True):
    """The mapping in a file that has unknown keys: its model, its path, and its other keys."""

    root: type[BaseModel]
    """Model of the whole file."""
    form: type[BaseModel]
    path: tuple[str | int, ...]
    """Path of the mapping in the file."""
    known: Collection[str]
    """Names of all keys that the mapping may have."""
    present: Collection[str]
    """Names of the keys that the mapping has in the file."""
    sections: Mapping[str, Collection[str]]
    """Names of the entries in each section of the file, such as the names of all joints."""

    def remedies(self, unknown: Mapping[str, object]) -> Iterator[Remedy]:
        """Yield fixes for unknown keys, given with their values; keys without a good guess are omitted."""
        meant = {key: meaning for key in unknown if (meaning := self.meaning(key)) is not None}
        limits = {meaning.kind: key for key, meaning in meant.items() if meaning.kind in ("lower", "upper")}
        if limits:
            keys = tuple(key for key in unknown if key in limits.values())
            yield Remedy(keys, self._limits(limits, unknown), meant[keys[0]].place[0])
        for key, value in unknown.items():
            if key in limits.values():
                continue
            section = section_of(self.root, value)
            if section and not self._is_misplaced_section:
                where = f"like {self.path[1]}" if section in self.path[:1] else f"below `{section}:`"
                yield Remedy((key,), f"indent it {where}, as an entry of {section}")
            elif (meaning := meant.get(key)) is not None:
                yield Remedy((key,), self._said_of(meaning, key, value), meaning.place[0])
            elif fix := self._misplaced(key, value):
                yield Remedy((key,), fix)
            elif close := near(key, self.known):
                yield Remedy((key,), suggestion(key, self.known), close[0] if len(close) == 1 else "")

    @property
    def _is_misplaced_section(self) -> bool:
        """True if the mapping is a section of the file, indented below another section by mistake."""
        return len(self.path) == 2 and self.path[1] in self.root.model_fields.keys() - self.sections.keys()

    def meaning(self, key: str) -> _Meaning | None:
        """Return what a term of another system means here; None if it is not known or not possible here.

        The terms of a joint also apply to its parts: `lower` means the same in a joint as in its limits.
        """
        word, name = folded(key), self.form.__name__
        bases = [base.__name__ for base in self.form.__mro__]
        for base in bases:
            meaning = _table().get(base, {}).get(word)
            if meaning is not None and meaning.place[0] in self.known:
                return meaning
        meaning = _table()["BareJoint"].get(word)
        if meaning is None:
            return None
        if meaning.place[0] == _PARTS_OF_JOINT.get(name, ""):
            return _Meaning(meaning.place[1:], meaning.kind)
        return meaning if _SERVO_FORM in bases and meaning.place[0] in self.known else None

    def _limits(self, limits: Mapping[str, str], unknown: Mapping[str, object]) -> str:
        """Return the fix for foreign keys of a lower and an upper limit, one of which may be missing."""
        values = [unknown.get(limits.get(side, "")) for side in ("lower", "upper")]
        of_urdf = not {"lower", "upper"}.isdisjoint(limits.values())
        length = ("m" if of_urdf else "mm") if "travel_per_turn" in self.present else ""
        written = _limits_text([*values], of_urdf=of_urdf, length=length)
        said = "limits are angles, not ticks: write for example" if written is None else "write"
        text, condition = written or ("[-90 deg, 90 deg]", "")
        return f"{said} `{self._at(('limits', 'position'), text)}`{condition}"

    def _at(self, place: Place, text: str) -> str:
        """Write a key below its parents as in a file: `limits: {velocity: 2 rad/s}`."""
        here = place[1:] if place[0] == _PARTS_OF_JOINT.get(self.form.__name__, "") else place
        return _in_mappings(here[:-1], f"{here[-1]}: {text}")

    def _said_of(self, meaning: _Meaning, word: str, value: object) -> str:
        """Return the fix for a foreign term: remove it, or write dxlrun's key."""
        if meaning.kind == "needless" and (
            folded(word) != "type" or isinstance(value, int) or yaml_text(value).lower() in _NEEDLESS
        ):
            return _NEEDLESS.get(yaml_text(value).lower(), _NEEDLESS[meaning.place[0]])
        if meaning.place[0] == "reference":
            return self._reference()
        if value is False and meaning.place[0] in SWITCHED_OFF:
            return SWITCHED_OFF[meaning.place[0]]
        return self._renamed(meaning, word, value)

    def _renamed(self, meaning: _Meaning, word: str, value: object) -> str:
        """Return the fix that replaces a foreign term by dxlrun's key, with its value converted."""
        place, key = meaning.place, meaning.place[0]
        is_same = len(place) == 1 and not meaning.kind
        if key in self.present and len(place) == 1:
            if is_same and (elsewhere := places_of(self.root, folded(word), value)):
                return self._moved(folded(word), value, elsewhere)
            return f"remove it, or `{key}`: both mean the same"
        if is_same and isinstance(value, dict | list) and key in keys_for(self.form, value):
            return f"rename it to `{key}`"
        example = example_at(self.form, place)
        converted = _CONVERSIONS.get(meaning.kind or ".".join(place), _plain)(value, example)
        if converted == (yaml_text(value), "") and not may_be_value(self.form, place, value):
            converted = None
        text, condition = converted or (example, "")
        if not text:
            return f"did you mean {key}?"
        such = "write" if converted is not None else "write for example"
        below = f"{place[-1]}: {text}` below `{key}" if key in self.present else self._at(place, text)
        return f"{such} `{below}`{condition}"

    def _reference(self) -> str:
        measure = "`dxlrun calibrate ROBOT.yaml` measures it"
        if "reference" in self.present:
            return f"remove it: `reference` sets the zero of the joint; {measure}"
        return f"write `reference`, the servo's angle at the joint's zero, such as 180 deg; {measure}"

    def _misplaced(self, key: str, value: object) -> str:
        """Return the fix for a key of dxlrun at the wrong place, or misspelled; empty if none is found."""
        if fix := self._miswritten(key, value):
            return fix
        if self._is_misplaced_section:
            return f"`{self.path[1]}` is a section of the file: write it without indentation"
        ours = folded(key)
        if ours in self.known or near(key, self.known):
            return ""
        if not (places := places_of(self.root, ours, value)):
            ours = next(iter(near(key, keys_of(self.root))), ours)
            places = places_of(self.root, ours, value)
        # `time` and `position` of a joint's tolerance are keys of many other forms.
        places = [place for place in places if len(place) < 4 or self.path[:1] in ((), place[:1])]
        return self._moved(ours, value, places) if places else ""

    def _miswritten(self, key: str, value: object) -> str:
        """Return the fix for text that is not a key, such as `rate=50`; empty if it may be one."""
        word, sign, rest = (part.strip() for part in re.split(r"([:=]|$)", key, maxsplit=1))
        named = f"remove it: the entry already has the name {self.path[1]}" if len(self.path) == 2 else ""
        if re.match(r"\d+ *[a-z%]", key) and value is None:
            fix = f"write a point instead of a decimal comma, such as 1.{key}, or a list in square brackets"
        elif re.fullmatch(r"\d{3}", key) and value is None:
            fix = "write the number without commas, such as 1_000_000"
        elif sign and word in self.known and value is None:
            how = "write a space after the colon" if sign == ":" else "write a colon instead of ="
            fix = f"{how}: `{word}: {rest}`"
        elif not self.path and isinstance(value, str) and value.startswith(("/dev/", "COM")):
            fix = f"write it at a bus: `buses: {{main: {{port: {value}, ...}}}}`"
        elif {"time", "joints"} <= {*self.known} - {*near(key, self.known)} and _UNIT.fullmatch(str(value)):
            fix = f"write `joints: {{{key}: {{position: {value}}}}}`"
        elif key == "name" and named:
            fix = named
        elif folded(key) in _REMARKS and not near(key, self.known):
            fix = f"write it as a comment: `# {yaml_text(value)}`"
        else:
            fix = ""
        return fix

    def _moved(self, key: str, value: object, places: list[Place]) -> str:
        """Return the fix that moves a key to the nearest of its possible places."""
        here = tuple(NAME if at == 1 else str(step) for at, step in enumerate(self.path))

        def shared(place: Place) -> int:
            same = (one == other for one, other in zip(place, here, strict=False))
            return next((steps for steps, each in enumerate(same) if not each), min(len(place), len(here)))

        place = max(places, key=lambda place: (shared(place), -len(place)))
        common, written = shared(place), f"{key}: {yaml_text(value)}"
        below = place[common:-1]
        if common == len(here) and below and NAME not in below:
            if below[0] in self.present:
                return f"move it to `{'.'.join(below)}`"
            return f"move it to `{'.'.join(below)}`: write `{_in_mappings(below, written)}`"
        names = [*self.sections.get(place[0], ())]
        entry = str(self.path[1]) if common >= 2 else names[0] if len(names) == 1 else NAME
        where = ".".join(entry if step == NAME else step for step in place[:-1])
        if not where:
            return f"move it to the top level: write `{written}` without indentation"
        return f"move it to `{where}`: write `{written}` there"


def misplaced_sections(
    root: type[BaseModel], data: Mapping[str, object]
) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield path and fix of each section of a robot file that is misnamed or indented too far."""
    early = getattr(root, "read_before", ())
    absent = [name for name in (*root.model_fields, *early) if name not in data]
    context = UnknownKeyContext(root, root, (), [*root.model_fields], [*data], {})
    for key, value in data.items():
        if key in early:
            continue
        if key not in root.model_fields and isinstance(value, dict) and near(key, absent):
            # Its name counts more than its entries: `joints_default` has the keys of a joint.
            yield (key,), suggestion(key, absent)
            continue
        inner = value if isinstance(value, dict) else {}
        own = [name for name in inner if name in root.model_fields and name not in data]
        if key not in root.model_fields and len(own) > 1:
            fix = f"remove `{key}:` and the indentation of its keys"
            yield from (((key, name), fix) for name in own)
            continue
        for name in own if entries_of(root, key) is not None else ():
            if not may_be_entry(root, key, inner[name]):
                yield (key, name), f"`{name}` is a section of the file: write it without indentation"
        meaning = None if key in root.model_fields else context.meaning(key)
        if meaning is None or not isinstance(value, dict | list) or section_of(root, value):
            continue
        if len(meaning.place) == 1 and not meaning.kind and meaning.place[0] not in data:
            yield (key,), f"rename it to `{meaning.place[0]}`"


def words_for(form: str, keys: Collection[str]) -> frozenset[str]:
    """Return the foreign terms, in this form, for any of these keys."""
    return frozenset(word for word, meaning in _table().get(form, {}).items() if meaning.place[0] in keys)


@cache
def _table() -> Mapping[str, Mapping[str, _Meaning]]:
    """Read `words.toml`: the meaning of each foreign term, by the name of the form where it is written."""
    text = Path(__file__).with_name("words.toml").read_text("utf-8")
    found: dict[str, dict[str, _Meaning]] = {}
    for form, meanings in tomllib.loads(text).items():
        words = found.setdefault(form, {})
        for target, theirs in meanings.items():
            place, _, kind = target.partition(":")
            for word in theirs.split():
                words.setdefault(word, _Meaning(tuple(place.split(".")), kind))
    return found


def _in_mappings(keys: Place, written: str) -> str:
    return f"{keys[0]}: {{{_in_mappings(keys[1:], written)}}}" if keys else written


def yaml_text(value: object) -> str:
    """Write a value as in a YAML file, cut off if it is long."""
    if isinstance(value, dict):
        text = f"{{{', '.join(f'{key}: {yaml_text(each)}' for key, each in value.items())}}}"
    elif isinstance(value, list):
        text = f"[{', '.join(map(yaml_text, value))}]"
    else:
        text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


_Written = tuple[str, str] | None
"""Value written for dxlrun, and a condition such as `, if this is in deg`; None: it cannot be converted."""
_UNIT = re.compile(r"[-0-9.]+ ([A-Za-z/^0-9%]+)")
_PERIOD = re.compile(r"([0-9.]+) *(s|ms|us)?")
_SECONDS = {None: 1.0, "s": 1.0, "ms": 1e-3, "us": 1e-6}
_FORWARDS = ("1", "+1", "direct", "normal", "forward", "forwards", "positive", "false", "+")
_BACKWARDS = ("-1", "indirect", "reverse", "reversed", "inverted", "backward", "backwards", "negative", "-")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _plain(value: object, example: str) -> _Written:
    if isinstance(value, dict | list) or value is None:
        return None
    unit = _UNIT.fullmatch(example)
    if unit is not None and _is_number(value):
        return f"{yaml_text(value)} {unit[1]}", f", if the value is in {unit[1]}"
    return (yaml_text(value), "") if unit is None or isinstance(value, str) else None


def _limits_text(values: list[object], *, of_urdf: bool = False, length: str = "") -> _Written:
    """Write a lower and an upper limit as a list with units; a missing limit is LOWER or UPPER.

    Args:
        values: The limits as written.
        of_urdf: True: they are written as in a URDF, in SI.
        length: Unit of the limits of a linear joint; empty: the joint is rotary.
    """
    numbers = [abs(value) for value in values if isinstance(value, int | float)]
    if numbers and max(numbers) > _LARGEST_ANGLE and not of_urdf:
        return None
    in_rad = of_urdf or any(isinstance(number, float) and number % 1 for number in numbers)
    turns = "rad" if in_rad and max(numbers, default=0) <= _TURN else "deg"
    unit = length or turns
    texts = [
        name if value is None else f"{yaml_text(value)} {unit}" if _is_number(value) else yaml_text(value)
        for value, name in zip(values, ("LOWER", "UPPER"), strict=True)
    ]
    return f"[{', '.join(texts)}]", f", if the values are in {unit}" if numbers and not of_urdf else ""


def _pair(value: object, example: str) -> _Written:
    return _limits_text(value) if isinstance(value, list) and len(value) == 2 else None


def _direction(value: object, example: str) -> _Written:
    word = yaml_text(value).lower()
    return ("1", "") if word in _FORWARDS else ("-1", "") if word in _BACKWARDS else None


def _inverted(value: object, example: str) -> _Written:
    # Bit 0 of Drive Mode is Reverse Mode (e-Manual, Drive Mode).
    return ("-1" if value & 1 else "1", "") if isinstance(value, int) else None


def _ids(value: object, example: str) -> _Written:
    return (yaml_text([{"id": one} for one in value]), "") if isinstance(value, list) else None


def _on_or_off(value: object, example: str) -> _Written:
    return ("on" if value in (True, 1, "on") else "off", "")


def _targets(value: object, example: str) -> _Written:
    if not isinstance(value, dict):
        return None
    targets = {name: one if isinstance(one, dict) else {"position": one} for name, one in value.items()}
    return yaml_text(targets), ""


def _point(value: object, example: str) -> _Written:
    return f"[{{time: 2 s, pose: {yaml_text(value)}}}]", ""


def _rate(value: object, example: str) -> _Written:
    period = _PERIOD.fullmatch(yaml_text(value))
    seconds = float(period[1]) * _SECONDS[period[2]] if period and period[1].count(".") <= 1 else 0.0
    return (f"{1 / seconds:.6g}", "") if seconds > 0 else None


_CONVERSIONS: Mapping[str, Callable[[object, str], _Written]] = {
    "direction": _direction,
    "ids": _ids,
    "inverted": _inverted,
    "pair": _pair,
    "period": _rate,
    "pose": _point,
    "targets": _targets,
    "torque": _on_or_off,
}
