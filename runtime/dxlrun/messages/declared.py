"""Declared messages: dataclasses whose annotations are the fields of a ROS 2 message.

    float -> float64, int -> int64, bool -> bool, str -> string, another dataclass -> its message
    Floats, NDArray[np.float64] -> float64[], and so for the other numbers of numpy
    tuple[X, ...], list[X] -> X[]
    Annotated[Floats, Length(9)] -> float64[9], Annotated[int, Number("uint8")] -> uint8

The message is called PACKAGE/msg/CLASS; a class variable `ros_type` gives it another name, as those of
dxlrun.messages have it.
"""

from __future__ import annotations

import dataclasses
import re
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Annotated, TypeAlias, cast, get_args, get_origin, get_type_hints

import msgspec
import numpy as np

from dxlrun.messages.cdr import Codec, Value
from dxlrun.messages.definition import (
    PRIMITIVES,
    MessageField,
    MessageType,
    message_type,
    short_name,
)

HEADER = "std_msgs/msg/Header"
"""A field `header` of this message gets the time of the cycle as its stamp."""

_PLAIN: Mapping[object, str] = {float: "float64", int: "int64", bool: "bool", str: "string"}
_ARRAYS: Mapping[object, str] = {
    np.dtype(kind).type: kind for kind in PRIMITIVES if kind not in {"byte", "char"}
}
_NAME = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")
"""Of a field, by the page "Interfaces" of ROS 2's documentation."""
_CLASS = re.compile(r"[A-Z][A-Za-z0-9]*")
_ROS_TYPE = re.compile(r"[a-z][a-z0-9_]*/msg/[A-Z][A-Za-z0-9]*")
_DEEPEST = 16

Plain: TypeAlias = "Callable[[object], Value]"
"""Returns a value of a field as `Codec.pack` takes it."""


def _unaliased(annotation: object) -> object:
    """Return what a `type` alias stands for (Python 3.12); NDArray is one since numpy 2.5."""
    alias = get_origin(annotation) or annotation
    if not hasattr(alias, "__value__"):
        return annotation
    arguments = get_args(annotation)
    return alias.__value__[arguments] if arguments else alias.__value__


class WrongMessage(ValueError):
    """A class that is no message, with how to fix it; or a value that does not fit its message."""

    def __init__(self, what: str, fix: str = "") -> None:
        super().__init__(what)
        self.what = what
        self.fix = fix


class Number(msgspec.Struct, frozen=True):
    """Mark of an annotation: a number of this type of ROS 2, such as `Annotated[int, Number("uint8")]`."""

    kind: str


class Length(msgspec.Struct, frozen=True):
    """Mark of an annotation: an array of a fixed length, such as `Annotated[Floats, Length(9)]`."""

    length: int


@dataclass(frozen=True, slots=True)
class DeclaredMessage:
    """A dataclass as a message: its definition, and how one of its objects becomes bytes."""

    cls: type
    type: MessageType
    stamped: bool
    """True with a field `header` whose stamp is set when it is packed."""
    _codec: Codec
    _plain: tuple[tuple[str, Plain | None], ...]
    """Of each field how it becomes plain; None: it is."""
    _row: Callable[[object], tuple[Value, ...]]
    """Returns all values that a message is made of."""
    _converted: tuple[tuple[int, Plain], ...]
    """Those of them that become plain."""

    def pack(self, message: object, stamp: tuple[int, int]) -> bytes:
        """Return a message as CDR; `stamp`: seconds and nanoseconds for its header.

        Raises WrongMessage, with one sentence that names the field, when it does not fit.
        """
        if not isinstance(message, self.cls):
            raise WrongMessage(f"takes {self.cls.__name__}, not {type(message).__name__}")
        try:
            values: Sequence[Value] = self._row(message)
            if self.stamped:
                values = [*stamp, *values[2:]]
            if self._converted:
                values = list(values)
                for index, plain in self._converted:
                    values[index] = plain(values[index])
            return self._codec.pack_row(values)
        except (ValueError, TypeError, AttributeError, OverflowError, struct.error):
            raise WrongMessage(self._fault(message)) from None

    def _fault(self, message: object) -> str:
        """Return which field of a message does not fit, and why."""
        for name, plain in self._plain:
            field = f"{self.cls.__name__}.{name}"
            try:
                value = getattr(message, name)
                self._codec.pack_field(name, value if plain is None else plain(value))
            except (ValueError, TypeError, AttributeError, OverflowError, struct.error) as error:
                return f"takes no such {field}: {' '.join(str(error).split())}"
        return f"takes no such {self.cls.__name__}"


def declared_message(cls: object, package: str) -> DeclaredMessage:
    """Return a dataclass as a message of this package. Raises WrongMessage for what ROS 2 has nothing for."""
    reader = _Annotations(package)
    name = reader.message(cls, ())
    kind = message_type(name, reader.definitions)
    own = reader.definitions[short_name(name)]
    stamped = own[0].name == "header" and own[0].kind == short_name(HEADER) and not own[0].sequence
    codec, plain = Codec(kind), reader.plain[short_name(name)]
    row: Callable[[object], tuple[Value, ...]] = attrgetter(*codec.leaves)
    if len(codec.leaves) == 1:
        row = _alone(codec.leaves[0])
    converted = tuple(reader.conversions(short_name(name)))
    return DeclaredMessage(cast("type", cls), kind, stamped, codec, plain, row, converted)


def _alone(place: str) -> Callable[[object], tuple[Value, ...]]:
    value = attrgetter(place)
    return lambda message: (value(message),)


def package_of(distribution: str) -> str:
    """Return the name of a package for messages of a distribution: `my_robotics` of `My-Robotics 0.1.0`."""
    words = re.findall(r"[a-z0-9]+", distribution.rpartition(" ")[0].lower() or distribution.lower())
    name = "_".join(words)
    return name if name[:1].isalpha() else f"package_{name}".rstrip("_")


class _Annotations:
    """Collects definitions, and how values become plain, from a dataclass and all that it contains."""

    def __init__(self, package: str) -> None:
        self.definitions: dict[str, tuple[MessageField, ...]] = {}
        self.plain: dict[str, tuple[tuple[str, Plain | None], ...]] = {}
        self._classes: dict[str, object] = {}
        self._package = package

    def message(self, cls: object, inside: tuple[object, ...]) -> str:
        """Return the full name of the message of a dataclass, whose fields are known then."""
        shown = getattr(cls, "__name__", repr(cls))
        if not (isinstance(cls, type) and _is_message(cls)):
            raise WrongMessage(f"{shown} is no dataclass", "put @dataclass above the class of the message")
        if cls in inside or len(inside) >= _DEEPEST:
            raise WrongMessage(f"{shown} contains itself", "a message of ROS 2 cannot: take the field out")
        name = self._name(cls)
        short = short_name(name)
        if self._classes.setdefault(short, cls) is not cls:
            raise WrongMessage(f"two classes are the message {name}", "give one of them another name")
        if short not in self.definitions:
            self.definitions[short] = ()  # its place: before all that it depends on
            pairs = [self._field(cls, *pair, (*inside, cls)) for pair in _annotations(cls)]
            self.definitions[short] = tuple(field for field, _ in pairs)
            self.plain[short] = tuple((field.name, plain) for field, plain in pairs)
        return name

    def conversions(self, name: str) -> list[tuple[int, Plain]]:
        """Return which of the values of a message, nested ones in their place, become plain, and how."""
        found: list[tuple[int, Plain]] = []
        count = 0
        for field, (_, plain) in zip(self.definitions[name], self.plain[name], strict=True):
            if field.kind in self.definitions and not field.sequence:
                inner = self.conversions(field.kind)
                found += [(count + index, convert) for index, convert in inner]
                count += self._values(field.kind)
                continue
            if plain is not None:
                found.append((count, plain))
            count += 1
        return found

    def _values(self, name: str) -> int:
        fields = self.definitions[name]
        nested = (field.kind in self.definitions and not field.sequence for field in fields)
        return sum(
            self._values(field.kind) if inner else 1 for field, inner in zip(fields, nested, strict=True)
        )

    def _name(self, cls: type) -> str:
        given: object = getattr(cls, "ros_type", None)
        if given is not None:
            if not isinstance(given, str) or not _ROS_TYPE.fullmatch(given):
                what = f"{cls.__name__}.ros_type is {given!r}"
                raise WrongMessage(what, 'a type of ROS 2 is written "std_msgs/msg/Header"')
            return given
        if not _CLASS.fullmatch(cls.__name__):
            raise WrongMessage(
                f"{cls.__name__} is no name of a message", "name the class like WaveState: letters and digits"
            )
        return f"{self._package}/msg/{cls.__name__}"

    def _field(
        self, cls: type, name: str, annotation: object, inside: tuple[object, ...]
    ) -> tuple[MessageField, Plain | None]:
        field = f"{cls.__name__}.{name}"
        if not _NAME.fullmatch(name):
            raise WrongMessage(
                f"{field} is no name of a field", "ROS 2 takes lower case, digits, and single _"
            )
        found = self._kind(annotation, inside)
        if found is None:
            shown = getattr(annotation, "__name__", None) if isinstance(annotation, type) else None
            raise WrongMessage(
                f"{field} is {shown or str(annotation).removeprefix('typing.')}, for which ROS 2 has nothing",
                "use float, int, bool, str, dxlrun.Floats, a dataclass, or tuple[X, ...] of one of them",
            )
        kind, sequence, length, plain = found
        return MessageField(name, kind, sequence, length), plain

    def _kind(
        self, annotation: object, inside: tuple[object, ...]
    ) -> tuple[str, bool, int, Plain | None] | None:
        """Return type, whether it is a sequence, fixed length, and how a value becomes plain; None: none."""
        base, *marks = get_args(annotation) if get_origin(annotation) is Annotated else (annotation,)
        base = _unaliased(base)
        number = next((mark.kind for mark in marks if isinstance(mark, Number)), None)
        length = next((mark.length for mark in marks if isinstance(mark, Length)), 0)
        if isinstance(base, type) and _is_message(base) and not marks:
            name = short_name(self.message(base, inside))
            return name, False, 0, _nested(base, self.plain, name)
        if base in (float, int, bool, str) and not length:
            kind = number or _PLAIN[base]
            fits = base in (float, int) and kind in PRIMITIVES and kind.startswith("float") == (base is float)
            return (kind, False, 0, None) if fits or not number else None
        many = self._many(base, inside)
        if many is None or number or (length and many[0] not in PRIMITIVES):
            return None
        return many[0], not length, length, many[1]

    def _many(self, base: object, inside: tuple[object, ...]) -> tuple[str, Plain | None] | None:
        """Return the type of an array's or a sequence's elements, and how a value becomes plain."""
        arguments = get_args(base)
        if get_origin(base) is np.ndarray and len(arguments) == 2:
            elements = get_args(arguments[1])
            kind = _ARRAYS.get(elements[0]) if elements else None
            return None if kind is None else (kind, None)
        whole = get_origin(base) is list or (get_origin(base) is tuple and arguments[1:] == (Ellipsis,))
        element = self._kind(arguments[0], inside) if whole and arguments else None
        if element is None or element[1] or element[2]:
            return None
        kind, _, _, plain = element
        if kind == "string":
            return kind, None
        if kind in PRIMITIVES:
            return kind, _array(np.dtype(kind).newbyteorder("<"))
        return None if plain is None else (kind, _each(plain))


def _is_message(cls: type) -> bool:
    """Return whether a class has fields by its annotations; those of dxlrun.messages are of msgspec."""
    return dataclasses.is_dataclass(cls) or issubclass(cls, msgspec.Struct)


def _annotations(cls: type) -> list[tuple[str, object]]:
    names = [field.name for field in dataclasses.fields(cls)] if dataclasses.is_dataclass(cls) else []
    names = names or list(getattr(cls, "__struct_fields__", ()))
    if not names:
        raise WrongMessage(f"{cls.__name__} has no fields", "give it at least one")
    try:
        hints = get_type_hints(cls, include_extras=True)
    except Exception as error:  # foreign annotations: whatever evaluating them raises
        raise WrongMessage(
            f"the annotations of {cls.__name__} cannot be read ({type(error).__name__}: {error})",
            "import the names in them at the top of the module, not for type checking only",
        ) from error
    return [(name, hints[name]) for name in names]


def _nested(cls: type, known: Mapping[str, tuple[tuple[str, Plain | None], ...]], name: str) -> Plain:
    fields = known[name]

    def plain(value: object) -> Value:
        if not isinstance(value, cls):
            raise ValueError(f"{type(value).__name__} is given where {cls.__name__} is asked")
        # of a list: a tuple that grows with a generator ends in CPython's free list, which then fills
        return tuple(
            [
                getattr(value, one) if convert is None else convert(getattr(value, one))
                for one, convert in fields
            ]
        )

    return plain


def _array(element: np.dtype[np.generic]) -> Plain:
    def plain(value: object) -> Value:
        if not isinstance(value, list | tuple):
            raise ValueError(f"{type(value).__name__} is given where a tuple is asked")
        return np.array(value, dtype=element)

    return plain


def _each(convert: Plain) -> Plain:
    def plain(value: object) -> Value:
        if not isinstance(value, list | tuple):
            raise ValueError(f"{type(value).__name__} is given where a tuple is asked")
        return [convert(one) for one in value]

    return plain
