"""Declared messages: dataclasses whose annotations define the fields of a ROS 2 message.

    float -> float64, int -> int64, bool -> bool, str -> string, another dataclass -> its message
    Floats, NDArray[np.float64] -> float64[], and so for the other numbers of numpy
    tuple[X, ...], list[X] -> X[]
    Annotated[Floats, Length(9)] -> float64[9], Annotated[int, Number("uint8")] -> uint8

The message's name is PACKAGE/msg/CLASS, unless a class variable `ros_type` gives another name, as in
dxlrun.messages.
"""

from __future__ import annotations

import dataclasses
import re
import struct
from collections.abc import Callable, Mapping, Sequence
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
"""Type of a field `header` whose stamp is set to the time of the cycle."""

_PLAIN: Mapping[object, str] = {float: "float64", int: "int64", bool: "bool", str: "string"}
_ARRAYS: Mapping[object, str] = {
    np.dtype(kind).type: kind for kind in PRIMITIVES if kind not in {"byte", "char"}
}
_NAME = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")
"""Pattern of field names, from the page "Interfaces" of ROS 2's documentation."""
_CLASS = re.compile(r"[A-Z][A-Za-z0-9]*")
_ROS_TYPE = re.compile(r"[a-z][a-z0-9_]*/msg/[A-Z][A-Za-z0-9]*")
_DEEPEST = 16

Plain: TypeAlias = "Callable[[object], Value]"
"""Function that converts a field's value for `Codec.pack`."""


def _unaliased(annotation: object) -> object:
    """Return the value of a `type` alias (Python 3.12); NDArray is an alias since numpy 2.5."""
    alias = get_origin(annotation) or annotation
    if not hasattr(alias, "__value__"):
        return annotation
    arguments = get_args(annotation)
    return alias.__value__[arguments] if arguments else alias.__value__


class WrongMessage(ValueError):
    """A class that is not a valid message, with a fix; or a value that does not fit its message."""

    def __init__(self, what: str, fix: str = "") -> None:
        super().__init__(what)
        self.what = what
        self.fix = fix


class Number(msgspec.Struct, frozen=True):
    """Annotation of a number of this ROS 2 type: `Annotated[int, Number("uint8")]`."""

    kind: str


class Length(msgspec.Struct, frozen=True):
    """Annotation of an array of fixed length: `Annotated[Floats, Length(9)]`."""

    length: int


class DeclaredMessage(msgspec.Struct, frozen=True):
    """Message type declared by a dataclass: definition, and conversion of its objects to bytes."""

    cls: type
    type: MessageType
    stamped: bool
    """True when the stamp of a field `header` is set on packing."""
    _codec: Codec
    _plain: tuple[tuple[str, Plain | None], ...]
    """Conversion of each field; None: not needed."""
    _row: Callable[[object], tuple[Value, ...]]
    """Function that returns all values of a message."""
    _converted: tuple[tuple[int, Plain], ...]
    """Index and conversion of the values in the row that need one."""

    def pack(self, message: object, stamp: tuple[int, int]) -> bytes:
        """Return a message as CDR; `stamp`: seconds and nanoseconds for its header.

        Raises WrongMessage, with one sentence that names the field, when a value does not fit.
        """
        if not isinstance(message, self.cls):
            raise WrongMessage(f"{type(message).__name__} given, {self.cls.__name__} expected")
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
        """Return a sentence about the field that does not fit, and the reason."""
        for name, plain in self._plain:
            field = f"{self.cls.__name__}.{name}"
            try:
                value = getattr(message, name)
                self._codec.pack_field(name, value if plain is None else plain(value))
            except (ValueError, TypeError, AttributeError, OverflowError, struct.error) as error:
                return f"{field}: {' '.join(str(error).split())}"
        return f"not a valid {self.cls.__name__}"


def declared_message(cls: object, package: str) -> DeclaredMessage:
    """Return the message type of a dataclass, in this package.

    Raises WrongMessage for types without a ROS 2 equivalent.
    """
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
    """Return the ROS 2 package of a distribution: `my_robotics` for `My-Robotics 0.1.0`."""
    words = re.findall(r"[a-z0-9]+", distribution.rpartition(" ")[0].lower() or distribution.lower())
    name = "_".join(words)
    return name if name[:1].isalpha() else f"package_{name}".rstrip("_")


class _Annotations:
    """Definitions and conversions, collected from a dataclass and all nested ones."""

    def __init__(self, package: str) -> None:
        self.definitions: dict[str, tuple[MessageField, ...]] = {}
        self.plain: dict[str, tuple[tuple[str, Plain | None], ...]] = {}
        self._classes: dict[str, object] = {}
        self._package = package

    def message(self, cls: object, inside: tuple[object, ...]) -> str:
        """Return the full name of a dataclass's message, and add its definition."""
        shown = getattr(cls, "__name__", repr(cls))
        if not (isinstance(cls, type) and _is_message(cls)):
            raise WrongMessage(f"{shown} is not a dataclass", "put @dataclass above the class of the message")
        if cls in inside or len(inside) >= _DEEPEST:
            raise WrongMessage(
                f"{shown} contains itself", "remove the field: a message of ROS 2 cannot be nested in itself"
            )
        name = self._name(cls)
        short = short_name(name)
        if self._classes.setdefault(short, cls) is not cls:
            raise WrongMessage(f"two classes have the message name {name}", "rename one of them")
        if short not in self.definitions:
            # The entry keeps the place before its dependencies.
            self.definitions[short] = ()
            pairs = [self._field(cls, *pair, (*inside, cls)) for pair in _annotations(cls)]
            self.definitions[short] = tuple(field for field, _ in pairs)
            self.plain[short] = tuple((field.name, plain) for field, plain in pairs)
        return name

    def conversions(self, name: str) -> list[tuple[int, Plain]]:
        """Return index and conversion of the values of a message, with nested messages flattened."""
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
                raise WrongMessage(what, 'write a type of ROS 2, such as "std_msgs/msg/Header"')
            return given
        if not _CLASS.fullmatch(cls.__name__):
            raise WrongMessage(
                f"{cls.__name__} is not a valid name of a message",
                "name the class like WaveState: letters and digits",
            )
        return f"{self._package}/msg/{cls.__name__}"

    def _field(
        self, cls: type, name: str, annotation: object, inside: tuple[object, ...]
    ) -> tuple[MessageField, Plain | None]:
        field = f"{cls.__name__}.{name}"
        if not _NAME.fullmatch(name):
            raise WrongMessage(
                f"{field} is not a valid name of a field", "write lower case, digits, and single _ for ROS 2"
            )
        found = self._kind(annotation, inside)
        if found is None:
            shown = getattr(annotation, "__name__", None) if isinstance(annotation, type) else None
            raise WrongMessage(
                f"{field} is {shown or str(annotation).removeprefix('typing.')}, and ROS 2 has no type for "
                "it",
                "use float, int, bool, str, dxlrun.Floats, a dataclass, or tuple[X, ...] of one of them",
            )
        kind, sequence, length, plain = found
        return MessageField(name, kind, sequence, length), plain

    def _kind(
        self, annotation: object, inside: tuple[object, ...]
    ) -> tuple[str, bool, int, Plain | None] | None:
        """Return type, sequence flag, fixed length and conversion of an annotation; None: not supported."""
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
        """Return the element type and the conversion of an array or a sequence; None: not supported."""
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
    """Return whether a class is a dataclass, or a msgspec struct as in dxlrun.messages."""
    return dataclasses.is_dataclass(cls) or issubclass(cls, msgspec.Struct)


def _annotations(cls: type) -> list[tuple[str, object]]:
    names = [field.name for field in dataclasses.fields(cls)] if dataclasses.is_dataclass(cls) else []
    names = names or list(getattr(cls, "__struct_fields__", ()))
    if not names:
        raise WrongMessage(f"{cls.__name__} has no fields", "give it at least one")
    try:
        hints = get_type_hints(cls, include_extras=True)
    # Foreign annotations may raise any exception.
    except Exception as error:
        raise WrongMessage(
            f"the annotations of {cls.__name__} cannot be read ({type(error).__name__}: {error})",
            "import the names in them at the top of the module, not for type checking only",
        ) from error
    return [(name, hints[name]) for name in names]


def _nested(cls: type, known: Mapping[str, tuple[tuple[str, Plain | None], ...]], name: str) -> Plain:
    fields = known[name]

    def plain(value: object) -> Value:
        if not isinstance(value, cls):
            raise ValueError(f"{type(value).__name__} given, {cls.__name__} expected")
        # A tuple made from a list: one that grows from a generator ends in CPython's free list, which then
        # fills.
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
            raise ValueError(f"{type(value).__name__} given, a tuple expected")
        return np.array(value, dtype=element)

    return plain


def _each(convert: Plain) -> Plain:
    def plain(value: object) -> Value:
        if not isinstance(value, list | tuple):
            raise ValueError(f"{type(value).__name__} given, a tuple expected")
        return [convert(one) for one in value]

    return plain
