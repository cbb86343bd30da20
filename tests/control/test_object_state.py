"""States of objects: what was written comes back; bytes of others run no code and take no memory."""

from __future__ import annotations

import io
import os
import pickle
import tracemalloc
from collections import deque
from enum import Enum
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from dxlrun.control.state import object_state
from dxlrun.control.state.object_state import MOST_STATE, StateError, restore, state_of

RUN = np.arange(6.0)
"""An array of the run."""


class Colour(Enum):
    RED = 1


class Pair(NamedTuple):
    left: float
    right: object


class Part:
    __slots__ = ("other", "value")

    def __init__(self, value: float) -> None:
        self.value = value
        self.other: object = self


class Thing:
    def __init__(self) -> None:
        self.deleted: list[object] = []


def full() -> Thing:
    thing: Any = Thing()
    thing.numbers = [0, 1, 255, 256, 70000, -1, 1 << 40, -(1 << 70), 1 << 3000, 0.5, float("inf"), True, None]
    thing.texts = ["", "a", "\u00e9" * 300, b"", b"x" * 300, b"y" * 70000, bytearray(b"abc")]
    thing.tuples = [(), (1,), (1, 2), (1, 2, 3), (1, 2, 3, 4, (5,))]
    thing.maps = {"a": {1: [2], (1, "x"): {3}}, None: frozenset({4, 5}), Colour.RED: set()}
    thing.same = thing.numbers
    thing.part = Part(2.0)
    thing.part.other = [thing.part, thing]
    thing.row = Pair(1.0, [Colour.RED])
    thing.array = np.arange(12.0).reshape(3, 4)
    thing.column = thing.array[:, 1]
    thing.run, thing.of_run = RUN, RUN[2:4]
    thing.number, thing.kind, thing.slice = np.float32(1.5), np.dtype("<i4"), slice(1, None, 2)
    thing.queue, thing.left = deque([1, 2], 5), iter((7, 8))
    thing.many = list(range(2500))
    return thing


def test_what_comes_back_is_what_was_written() -> None:
    data = state_of(full(), lambda _: "", {id(RUN): "run"})
    back: Any = Thing()
    restore(back, data, {"run": RUN}.__getitem__)
    usual = full()
    for name in ("numbers", "texts", "tuples", "maps", "many", "row", "number", "kind", "slice", "queue"):
        found, expected = getattr(back, name), getattr(usual, name)
        assert (type(found), found) == (type(expected), expected)
    assert back.same is back.numbers
    assert (back.part.value, back.part.other) == (2.0, [back.part, back])
    back.array[2, 1] = 99.0
    assert back.column.tolist() == [1.0, 5.0, 99.0]
    assert back.run is RUN
    assert np.shares_memory(back.of_run, RUN)
    assert list(back.left) == [7, 8]
    assert back.queue.maxlen == 5


class System:
    """What a stranger writes into a log."""

    def __reduce__(self) -> Any:
        return os.mkdir, ("it_ran",)


def name(function: str, module: str = object_state.__name__) -> bytes:
    return b"".join(b"\x8c" + bytes([len(text)]) + text.encode() for text in (module, function)) + b"\x93"


def call(function: str, *arguments: object) -> bytes:
    """Return the operations of a call, as Protocol 5 has them."""
    body = io.BytesIO()
    writing = pickle.Pickler(body, protocol=5)
    writing.dump(arguments)
    return name(function) + body.getvalue().partition(b"\x95")[2][8:-1] + b"R"


PLAIN = call("numbers", "<f8", (1,), bytes(8), True)
BOMB = b"\x8c\x01a]" + b"(" + b"N" * 300_000 + b"e\x94"
"""A list that is there already."""
HOSTILE = {
    "another module's function": pickle.dumps({"a": System()}, protocol=5),
    "a function of this module that no state names": b"\x80\x05}\x8c\x01a" + name("state_of") + b"s.",
    "the state of an array": b"\x80\x05}\x8c\x01a" + PLAIN + b"(K\x01tbs.",
    "the state of a type of numbers": b"\x80\x05}\x8c\x01a" + call("number_type", "<f8") + b"(K\x01tbs.",
    "an object that is called": b"\x80\x05}\x8c\x01a" + call("named", "") + b")Rs.",
    "attributes of an object of the run": b"\x80\x05}\x8c\x01a" + call("filled", [1], {"x": 1}) + b"s.",
    "another class": pickle.dumps({"__class__": 1}, protocol=5),
    "a class of others": b"\x80\x05}\x8c\x01a" + call("made", "subprocess", "Popen") + b"s.",
    "a class of others by a way round": b"\x80\x05}\x8c\x01a" + call("made", __name__, "io.BytesIO") + b"s.",
    "objects in an array": b"\x80\x05}\x8c\x01a" + call("numbers", "O", (1,), bytes(8), True) + b"s.",
    "an array beyond its bytes": b"\x80\x05}\x8c\x01a" + call("numbers", "<f8", (9,), bytes(8), True) + b"s.",
    "a list that is copied again and again": b"\x80\x05}"
    + BOMB
    + (name("an_iterator") + b"h\x00\x85R0") * 5
    + b"s.",
    "keys whose hash never ends": b"\x80\x05}" + b"N" + b"\x94\x30h\x00" + b"\x85" * 9 + b"Ns.",
    "an instance by its class": b"\x80\x05}\x8c\x01a(ios\nsystem\ns.",
    "an extension": b"\x80\x05}\x8c\x01a\x82\x01s.",
    "nothing on the stack": b"\x80\x050000.",
    "no end": b"\x80\x05}",
    "nothing": b"",
    "too long": pickle.dumps({"a": bytes(MOST_STATE)}, protocol=5),
}


@pytest.mark.parametrize("what", HOSTILE)
def test_bytes_of_others_run_no_code_and_take_no_memory(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    tracemalloc.start()
    try:
        with pytest.raises(StateError, match="has a state that does not fit"):
            restore(Thing(), HOSTILE[what], {}.__getitem__)
        assert tracemalloc.get_traced_memory()[1] < 40 * MOST_STATE
    finally:
        tracemalloc.stop()
    assert list(tmp_path.iterdir()) == []


def test_flipped_bits_are_refused_or_other_values() -> None:
    data = state_of(full(), lambda _: "", {id(RUN): "run"})
    random = np.random.default_rng(15)
    refused = 0
    for place in random.integers(0, len(data), 400):
        changed = bytearray(data)
        changed[place] ^= 1 << int(random.integers(8))
        try:
            restore(Thing(), bytes(changed), {"run": RUN}.__getitem__)
        except StateError:
            refused += 1
    assert 0 < refused < 400
