"""Object state: what a controller's attributes hold, as bytes, and back into one that is configured.

Written with pickle, as the loop has no time for more, and read without it: unpickling sets the attributes of
whatever it has made, also of numpy's own types, so that bytes could make an array that reaches beyond its
memory (Python documentation, "pickle": only unpickle data you trust). The reader here knows the operations
that the writer uses (pickletools, Protocol 5), calls functions of this module alone, and makes objects of the
controller's own package by their attributes: bytes of a log run no code of others.
"""

from __future__ import annotations

import io
import pickle
import sys
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from copy import copy
from enum import Enum
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

MOST_STATE = 1 << 20
"""Bytes of a state."""
_PROTOCOL = 5
_CALLABLE = (FunctionType, BuiltinFunctionType, ModuleType, type)
"""What stays as `on_configure` made it."""
_ITERATORS: tuple[type, ...] = (type(iter(())), type(iter([])))
_MESSAGES = "dxlrun.messages"

Names = Callable[[object], str]
"""Return the name of an object that belongs to the run and not to the state; empty: it does not."""
Named = Callable[[str], object]
"""Return the object of a name."""


class StateError(ValueError):
    """A state that cannot be written down, or is none; a sentence without its subject."""


def state_of(owner: object, names: Names, roots: Mapping[int, str]) -> bytes:
    """Return the state of an object: every attribute but functions, classes and modules.

    `roots`: id of an array that belongs to the run -> its name, for views of it. Raises StateError.
    """
    stream = io.BytesIO()
    writing = _Writing(stream, owner, names, roots)
    try:
        writing.dump(_attributes(owner, outermost=True))
    except StateError:
        raise
    except Exception as error:
        raise StateError(f"holds what cannot be written down ({type(error).__name__}: {error})") from error
    data = stream.getvalue()
    if len(data) > MOST_STATE:
        raise StateError(f"has a state of {len(data)} bytes; {MOST_STATE} is the most")
    return data


def restore(owner: object, data: bytes, named: Named) -> None:
    """Give an object the attributes of a state. Raises StateError when the bytes are none of it."""
    try:
        state = _Reading(data, owner, named).load()
        _fill(owner, state)
    except Exception as error:
        raise StateError(f"has a state that does not fit ({type(error).__name__}: {error})") from error


def _attributes(owner: object, *, outermost: bool = False) -> dict[str, object]:
    """Return the attributes of an object, those in slots too."""
    found = dict(getattr(owner, "__dict__", {}))
    for cls in type(owner).__mro__:
        slots = cls.__dict__.get("__slots__", ())
        for name in (slots,) if isinstance(slots, str) else slots:
            place = f"_{cls.__name__.lstrip('_')}{name}" if name.startswith("__") else name
            if place not in {"__dict__", "__weakref__"} and hasattr(owner, place):
                found[place] = getattr(owner, place)
    if outermost:
        return {name: value for name, value in found.items() if not _configured(owner, value)}
    return found


def _configured(owner: object, value: object) -> bool:
    own = isinstance(value, MethodType) and value.__self__ is owner
    return own or isinstance(value, _CALLABLE)


def _packages(owner: object) -> frozenset[str]:
    return frozenset(
        cls.__module__.partition(".")[0] for cls in type(owner).__mro__ if cls.__module__ != "builtins"
    ) - {"abc", "typing", "dxlrun"} | {"dxlrun_controllers"}


def _is_own(module: str, packages: frozenset[str]) -> bool:
    return module.partition(".")[0] in packages or module.startswith(_MESSAGES)


def _fill(target: object, state: object) -> None:
    if not isinstance(state, dict):
        raise StateError("its attributes are missing")
    for name, value in state.items():
        if name.startswith("__") and name.endswith("__"):
            raise StateError(f"it sets {name}")
        object.__setattr__(target, name, value)


class _Writing(pickle.Pickler):
    """Writes arrays as their bytes, views as places in them, and objects of plug-ins by their attributes."""

    def __init__(self, stream: io.BytesIO, owner: object, names: Names, roots: Mapping[int, str]) -> None:
        super().__init__(stream, protocol=_PROTOCOL)
        self._owner = owner
        self._names = names
        self._roots = roots
        self._packages = _packages(owner)
        self._left = MOST_STATE

    def reducer_override(  # noqa: C901, PLR0911, PLR0912  one branch a kind of object
        self, obj: object
    ) -> Any:  # noqa: ANN401  as pickle declares it
        """Return how an object that is no plain value is written."""
        kind = type(obj)
        if kind is np.ndarray:
            return self._array(obj)  # type: ignore[arg-type]  # what it is, is in the line above
        if kind is FunctionType and obj in _READERS:
            return NotImplemented
        if obj is self._owner:
            return named, ("",)
        if name := self._names(obj):
            return named, (name,)
        if isinstance(obj, np.generic):
            if obj.dtype.hasobject:
                raise StateError(f"holds a {kind.__name__}")
            return number, (obj.dtype.str, obj.tobytes())
        if isinstance(obj, np.dtype) and obj.fields is None and not obj.hasobject:
            return number_type, (obj.str,)
        if isinstance(obj, slice):
            return a_slice, (obj.start, obj.stop, obj.step)
        if isinstance(obj, deque):
            return a_deque, (list(obj), obj.maxlen)
        if kind in _ITERATORS:
            left: list[Any] = list(copy(obj))  # type: ignore[call-overload]  # its type is one of an iterator
            return an_iterator, (left,)
        if isinstance(obj, Enum):
            return member, (kind.__module__, kind.__qualname__, obj.name)
        if not _is_own(kind.__module__, self._packages):
            raise StateError(f"holds a {kind.__module__}.{kind.__qualname__}")
        if isinstance(obj, tuple):
            return row, (kind.__module__, kind.__qualname__, list(obj))
        if isinstance(obj, dict | list | set | int | float | str | bytes):
            raise StateError(f"holds a {kind.__qualname__}")
        return made, (kind.__module__, kind.__qualname__), _attributes(obj), None, None, filled

    def _array(self, array: NDArray[np.generic]) -> tuple[object, ...]:
        if name := self._roots.get(id(array)):
            return named, (name,)
        root = array
        while isinstance(root.base, np.ndarray):
            root = root.base
        if root is not array:
            if not root.flags.c_contiguous:
                raise StateError("holds a view of an array whose elements are in no row")
            offset = _address(array) - _address(root)
            return view, (root, array.dtype.str, array.shape, offset, array.strides, array.flags.writeable)
        self._left -= array.nbytes
        if self._left < 0:
            raise StateError(f"has arrays of more than {MOST_STATE} bytes")
        if array.dtype.hasobject or array.dtype.fields is not None or not array.flags.c_contiguous:
            raise StateError(f"holds an array of {array.dtype} that is not of plain numbers in a row")
        return numbers, (array.dtype.str, array.shape, array.tobytes(), array.flags.writeable)


def _address(array: NDArray[np.generic]) -> int:
    address: int = array.__array_interface__["data"][0]
    return address


class _Mark(NamedTuple):
    """A place on the stack."""


class _Function(NamedTuple):
    """A function of this module, by its name; no value of a state can be called."""

    name: str


_MARK = _Mark()


class _Reading:
    """Reads what _Writing wrote, and nothing else."""

    def __init__(self, data: bytes, owner: object, named: Named) -> None:
        self._data = data
        self._owner = owner
        self._named = named
        self._packages = _packages(owner)
        self._known: dict[str, Callable[..., object]] = {
            "named": self.named, "made": self.made, "member": self.member, "row": self.row,
            "filled": self.filled,
            "numbers": numbers, "number": number, "number_type": number_type, "view": view,
            "a_slice": a_slice, "a_deque": a_deque,
            "an_iterator": an_iterator,
        }  # fmt: skip
        self._made: dict[int, object] = {}
        """By id: objects that this state made, of which it may set attributes."""
        self._stack: list[object] = []
        self._memo: list[object] = []
        self._left = len(data)
        """Bytes and elements that functions may copy: none is written twice, so that memory is bounded."""

    def load(self) -> object:
        """Return the state. Raises StateError and whatever an unfit one makes of it."""
        from pickletools import genops  # only replays read states

        if len(self._data) > MOST_STATE:
            raise StateError(f"it has {len(self._data)} bytes; {MOST_STATE} is the most")
        for operation, value, _ in genops(self._data):
            if operation.name == "STOP":
                (state,) = self._stack
                return state
            self._step(operation.name, value)
        raise StateError("it has no end")

    def _step(self, name: str, value: object) -> None:  # noqa: C901, PLR0912  one branch a kind of operation
        stack = self._stack
        match name:
            case "PROTO" | "FRAME":
                pass
            case _ if name in _VALUES:
                stack.append(value)
            case "NONE" | "NEWTRUE" | "NEWFALSE":
                stack.append({"NONE": None, "NEWTRUE": True, "NEWFALSE": False}[name])
            case "EMPTY_LIST" | "EMPTY_DICT" | "EMPTY_SET" | "EMPTY_TUPLE":
                stack.append({"L": list, "D": dict, "S": set, "T": tuple}[name[6]]())
            case "MARK":
                stack.append(_MARK)
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                count = int(name[-1])
                stack[-count:] = [tuple(stack[-count:])]
            case "TUPLE":
                stack.append(tuple(self._marked()))
            case "FROZENSET":
                stack.append(frozenset(map(_key, self._marked())))
            case "APPEND" | "APPENDS":
                items = self._marked() if name == "APPENDS" else [stack.pop()]
                _exactly(list, stack[-1]).extend(items)
            case "SETITEM" | "SETITEMS":
                items = self._marked() if name == "SETITEMS" else [stack.pop(-2), stack.pop()]
                _exactly(dict, stack[-1]).update(zip(map(_key, items[::2]), items[1::2], strict=True))
            case "ADDITEMS":
                items = self._marked()
                _exactly(set, stack[-1]).update(map(_key, items))
            case "MEMOIZE":
                self._memo.append(stack[-1])
            case "BINGET" | "LONG_BINGET":
                stack.append(self._memo[_exactly(int, value)])
            case "POP":
                stack.pop()
            case "POP_MARK":
                self._marked()
            case "STACK_GLOBAL":
                module, function = stack[-2:]
                if module != __name__ or function not in self._known:
                    raise StateError(f"it names {module}.{function}")
                stack[-2:] = [_Function(_exactly(str, function))]
            case "REDUCE":
                arguments = _exactly(tuple, stack.pop())
                stack.append(self._call(_exactly(_Function, stack.pop()), arguments))
            case _:
                raise StateError(f"it has {name}, which no state has")

    def _marked(self) -> list[object]:
        """Take what is above the last mark off the stack, and the mark."""
        stack = self._stack
        at = next(place for place in range(len(stack) - 1, -1, -1) if stack[place] is _MARK)
        items = stack[at + 1 :]
        del stack[at:]
        return items

    def _call(self, function: _Function, arguments: tuple[object, ...]) -> object:
        self._left -= sum(len(one) for one in arguments if isinstance(one, bytes | list))
        if self._left < 0:
            raise StateError("it copies more than it has")
        return self._known[function.name](*arguments)

    def named(self, name: str) -> object:
        """Return an object of the run."""
        return self._owner if not name else self._named(name)

    def made(self, module: str, name: str) -> object:
        """Return a new object of a class of the controller's package, without attributes."""
        cls = self._class(module, name)
        new: object = object.__new__(cls)
        self._made[id(new)] = new
        return new

    def filled(self, target: object, state: object) -> None:
        """Give an object that was made its attributes."""
        if self._made.get(id(target)) is not target:
            raise StateError("its attributes are of no object")
        _fill(target, state)

    def member(self, module: str, name: str, member: str) -> object:
        """Return a member of an enumeration."""
        cls = self._class(module, name, self._packages | {"dxlrun"})
        if not issubclass(cls, Enum):
            raise StateError(f"{name} is no enumeration")
        return cls[member]

    def row(self, module: str, name: str, values: list[object]) -> object:
        """Return a named tuple."""
        cls = self._class(module, name)
        if not issubclass(cls, tuple):
            raise StateError(f"{name} is no tuple")
        return tuple.__new__(cls, values)

    def _class(self, module: str, name: str, packages: frozenset[str] = frozenset()) -> type:
        known = _is_own(module, packages or self._packages)
        place: object = sys.modules.get(module) if known else None
        for part in name.split("."):
            place = getattr(place, part, None)
        if not isinstance(place, type) or place.__module__ != module:
            raise StateError(f"it has an object of {module}.{name}, which is not there")
        return place


_VALUES = frozenset(
    {"BININT", "BININT1", "BININT2", "LONG1", "LONG4", "BINFLOAT"}
    | {"SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8"}
    | {"SHORT_BINBYTES", "BINBYTES", "BINBYTES8", "BYTEARRAY8"}
)
"""Operations that have a value beside them."""

_Kind = TypeVar("_Kind")


def _exactly(kind: type[_Kind], value: object) -> _Kind:
    """Return a value that is of this very type, whose methods are none of a plug-in. Raises StateError."""
    if type(value) is not kind:
        raise StateError(f"it has a {type(value).__name__} in place of a {kind.__name__}")
    return value


def _key(value: object) -> object:
    """Return a key of a set or dictionary; the hash of tuples of tuples takes time without a bound."""
    if isinstance(value, tuple) and any(isinstance(one, tuple) for one in value):
        raise StateError("it has tuples of tuples as keys")
    return value


# Functions that a state names


def named(name: str) -> object:
    """Stand for an object of the run; see _Reading."""
    raise NotImplementedError(name)


def made(module: str, name: str) -> object:
    """Stand for an object of a class; see _Reading."""
    raise NotImplementedError(module, name)


def member(module: str, name: str, chosen: str) -> object:
    """Stand for a member of an enumeration; see _Reading."""
    raise NotImplementedError(module, name, chosen)


def row(module: str, name: str, values: list[object]) -> object:
    """Stand for a named tuple; see _Reading."""
    raise NotImplementedError(module, name, values)


def filled(target: object, state: object) -> None:
    """Stand for the attributes of a new object; see _Reading."""
    raise NotImplementedError(target, state)


def numbers(kind: str, shape: tuple[int, ...], data: bytes, writeable: bool) -> NDArray[np.generic]:
    """Return an array of its bytes."""
    array: NDArray[np.generic] = np.ndarray(shape, _plain(kind), data)
    return array.copy() if writeable else array


def number(kind: str, data: bytes) -> object:
    """Return a number of numpy."""
    return np.frombuffer(data, _plain(kind))[0]


def number_type(kind: str) -> np.dtype[np.generic]:
    """Return a type of numbers."""
    return _plain(kind)


def view(  # noqa: PLR0917  in the order in which they are written
    root: NDArray[np.generic],
    kind: str,
    shape: tuple[int, ...],
    offset: int,
    strides: tuple[int, ...],
    writeable: bool,
) -> NDArray[np.generic]:
    """Return a view of an array; numpy checks that it lies inside."""
    shown: NDArray[np.generic] = np.ndarray(shape, _plain(kind), root, offset, strides)
    if not writeable:
        shown.flags.writeable = False
    return shown


def a_slice(start: object, stop: object, step: object) -> slice:
    """Return a slice."""
    return slice(start, stop, step)


def a_deque(values: list[object], most: int | None) -> deque[object]:
    """Return a deque."""
    return deque(values, most)


def an_iterator(values: list[object]) -> Iterator[object]:
    """Return an iterator of what was left."""
    return iter(values)


def _plain(kind: str) -> np.dtype[np.generic]:
    found = np.dtype(kind)
    if found.hasobject or found.fields is not None:
        raise StateError(f"{kind!r} is no type of plain numbers")
    return found


_READERS = frozenset(
    (named, made, member, row, filled, numbers, number, number_type, view, a_slice, a_deque, an_iterator)
)
