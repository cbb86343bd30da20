"""Definition: text of a message in ROS 2 format (`ros2msg`), its fields, and its RIHS01 hash.

Sources: ROS 2's documentation "Interfaces" for the text, REP 2011 and REP 2016 for the hash: SHA-256 of the
type description as JSON.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from hashlib import sha256

import msgspec

RULE = "=" * 80

PRIMITIVES: Mapping[str, str] = {
    "bool": "?",
    "byte": "B",
    "char": "B",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
"""Number types of definitions, with their codes in `struct`."""

_FIELD = re.compile(r"^([A-Za-z0-9_/]+)(?:<=\d+)?(\[(<=)?(\d*)\])?\s+([a-z][a-z0-9_]*)(?:\s+\S.*)?$")
"""Groups: type with bound of a text, brackets, bound of a sequence, length, name; the default value
follows."""
_CONSTANT = re.compile(r"^[a-z0-9<=]+\s+[A-Z][A-Z0-9_]*\s*=")
_RULE = re.compile(r"^=+$", re.MULTILINE)
_NUMBERS = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64")
_TYPE_IDS = {name: number for number, name in enumerate(_NUMBERS, 2)} | {
    "char": 13,
    "bool": 15,
    "byte": 16,
    "string": 17,
}
"""Values of type_description_interfaces/msg/FieldType: FIELD_TYPE_INT8 and so on; a nested type is 1."""
_ARRAY, _SEQUENCE = 48, 144


class MessageType(msgspec.Struct, frozen=True):
    """A message type: full name, and definition with all its dependencies."""

    name: str
    text: str

    @property
    def type_hash(self) -> str:
        """RIHS01 hash of the type."""
        definitions = parse(self)
        top = short_name(self.name)
        others = sorted(_full_name(other) for other in definitions if other != top)
        description = {
            "type_description": _described(self.name, definitions[top]),
            "referenced_type_descriptions": [
                _described(other, definitions[short_name(other)]) for other in others
            ],
        }
        return f"RIHS01_{sha256(json.dumps(description).encode()).hexdigest()}"


class MessageField(msgspec.Struct, frozen=True):
    """One field of a definition."""

    name: str
    kind: str
    """Number type, `string`, or the name of another message, without `msg/`."""
    sequence: bool = False
    length: int = 0
    """Length of a fixed-length array; 0 otherwise."""

    @property
    def definition_line(self) -> str:
        """Line of the field in the definition."""
        many = f"[{self.length}]" if self.length else "[]" if self.sequence else ""
        return f"{self.kind}{many} {self.name}"


Definitions = Mapping[str, tuple[MessageField, ...]]
"""Fields of a message and of its dependencies, by names without `msg/`; its own fields come first."""


def short_name(name: str) -> str:
    """Return the name without `msg/`: `std_msgs/Header` for `std_msgs/msg/Header`."""
    return name.replace("/msg/", "/")


def parse(message: MessageType) -> dict[str, tuple[MessageField, ...]]:
    """Return the definitions in a message's text, without constants, default values and bounds.

    Raises ValueError for an invalid line, and for an undefined type.
    """
    definitions: dict[str, tuple[MessageField, ...]] = {}
    name = message.name
    for block in _RULE.split(message.text):
        fields: list[MessageField] = []
        for line in block.strip().splitlines():
            text = line.split("#", 1)[0].strip()
            if text.startswith("MSG: "):
                name = text.removeprefix("MSG: ").strip()
            elif text and not _CONSTANT.match(text):
                match = _FIELD.match(text)
                if match is None:
                    raise ValueError(f"{message.name}: cannot parse {line!r}")
                kind, many, bound, length, field = match.groups()
                fixed = 0 if bound else int(length or 0)
                fields.append(MessageField(field, _full_kind(kind, name), bool(many) and not fixed, fixed))
        definitions[short_name(name)] = tuple(fields)
    known = {*PRIMITIVES, "string", *definitions}
    for one in (field for fields in definitions.values() for field in fields):
        if one.kind not in known:
            raise ValueError(f"{message.name}: the type {one.kind} of {one.name} is not defined")
    return definitions


def _full_kind(kind: str, inside: str) -> str:
    """Return the full name of a field's type; the default package is that of the enclosing message."""
    if kind in PRIMITIVES or kind in ("string", "wstring"):
        return kind
    return short_name(kind) if "/" in kind else f"{inside.partition('/')[0]}/{kind}"


def message_type(name: str, definitions: Definitions) -> MessageType:
    """Return the message type of this full name."""
    top = short_name(name)
    blocks = ["".join(f"{field.definition_line}\n" for field in definitions[top])]
    for other, fields in definitions.items():
        if other != top:
            lines = "".join(f"{field.definition_line}\n" for field in fields)
            blocks.append(f"{RULE}\nMSG: {other}\n{lines}")
    return MessageType(name, "".join(blocks))


def _full_name(name: str) -> str:
    return name.replace("/", "/msg/", 1)


def _described(name: str, fields: tuple[MessageField, ...]) -> dict[str, object]:
    return {
        "type_name": name,
        "fields": [{"name": field.name, "type": _field_type(field)} for field in fields],
    }


def _field_type(field: MessageField) -> dict[str, object]:
    nested = field.kind not in _TYPE_IDS
    many = _ARRAY if field.length else _SEQUENCE if field.sequence else 0
    return {
        "type_id": many + (1 if nested else _TYPE_IDS[field.kind]),
        "capacity": field.length,
        "string_capacity": 0,
        "nested_type_name": _full_name(field.kind) if nested else "",
    }
