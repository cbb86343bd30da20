"""Values: parsing and formatting of a fault's values, such as `3`, `500ms`, `-30deg`, `ff00fd`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import NamedTuple

from dxlsim.texts.duration import parse_duration

Value = int | float | str | bytes | tuple[str, ...]

SHORTEST_PAUSE_NS = 100_000  # A babbling servo without pauses would stall the simulation
_MOST_BYTES = 256
_MOST_DEGREES = 36_000.0


class Reader(NamedTuple):
    """Parser and formatter of one key's value in a fault's line; `example` represents the value in the
    help."""

    example: str
    read: Callable[[str], Value]  # Raises ValueError with the expected form
    show: Callable[..., str] = str


def _read(read: Callable[[str], Value], may_be: Callable[..., bool], asked: str) -> Callable[[str], Value]:
    """Return a parser that accepts the values of `read` for which `may_be` holds; otherwise it raises
    ValueError with `asked`, the expected form."""

    def checked(text: str) -> Value:
        with suppress(ValueError):
            if may_be(value := read(text)):
                return value
        raise ValueError(f"write {asked}")

    return checked


def _whole(lowest: int, highest: int) -> Callable[[str], Value]:
    asked = f"a whole number from {lowest} to {highest}"
    return _read(lambda text: int(text, 0), lambda value: lowest <= value <= highest, asked)


def _number(lowest: float, highest: float) -> Callable[[str], Value]:
    asked = f"a number from {lowest:g} to {highest:g}, without its unit"
    return _read(float, lambda value: lowest <= value <= highest, asked)


def _time(least_ns: int, asked: str) -> Callable[[str], Value]:
    return _read(parse_duration, lambda value: value >= least_ns, f"a time {asked}")


def _degrees(text: str) -> float:
    if text.endswith("deg"):
        return float(text.removesuffix("deg"))
    if text.endswith("rad"):
        return math.degrees(float(text.removesuffix("rad")))
    raise ValueError(text)


_ANGLE = "an angle such as 30deg or -0.5rad, of at most 100 turns"
_turn = _read(_degrees, lambda value: 0.0 < abs(value) <= _MOST_DEGREES, _ANGLE)
_angle = _read(_degrees, lambda value: abs(value) <= _MOST_DEGREES, _ANGLE)
_share = _read(float, lambda value: 0.0 < value <= 1.0, "a number above 0, at most 1")
_hex = _read(
    bytes.fromhex,
    lambda data: 1 <= len(data) <= _MOST_BYTES,
    f"1 to {_MOST_BYTES} bytes in hex, such as ff00fd",
)


def _show_time(total_ns: int) -> str:
    for unit, ns in (("s", 10**9), ("ms", 10**6), ("us", 10**3)):
        if total_ns % ns == 0:
            return f"{total_ns // ns}{unit}"
    return f"{total_ns}ns"


def _show_number(value: float) -> str:
    short = f"{value:g}"
    return short if float(short) == value else repr(value)


def _show_angle(value: float) -> str:
    return f"{_show_number(value)}deg"


_time_of = Reader("TIME", _time(1, "longer than 0, such as 500ms"), _show_time)
_angle_of = Reader("ANGLE", _angle, _show_angle)
TURN = Reader("ANGLE", _turn, _show_angle)  # Reader of `by` if it is an angle
READERS: Mapping[str, Reader] = {
    "bus": Reader("NAME", _read(str, bool, "the name of a bus")),
    "servo": Reader("ID", _whole(0, 253)),
    "from": Reader("host", _read(str, "host".__eq__, "from=host for an instruction, servo=ID for a reply")),
    "byte": Reader("INDEX", _whole(-_MOST_BYTES, _MOST_BYTES)),
    "flip": Reader("BITS", _whole(1, 255), "{:#04x}".format),
    "keep": Reader("BYTES", _whole(1, _MOST_BYTES)),
    "by": _time_of,
    "about": Reader("AXIS", _read(str, ("x", "y", "z").__contains__, "x, y or z: an axis of the device")),
    "copies": Reader("NUMBER", _whole(2, 16)),
    "data": Reader("HEX", _hex, bytes.hex),
    "size": Reader("BYTES", _whole(1, _MOST_BYTES)),
    "every": Reader("TIME", _time(SHORTEST_PAUSE_NS, "of 100us or more"), _show_time),
    "number": Reader("NUMBER", _whole(0, 65_535)),
    "volts": Reader("V", _number(0.0, 60.0), _show_number),
    "celsius": Reader("DEGREES", _number(-50.0, 200.0), _show_number),
    "share": Reader("0.1", _share, _show_number),
    "low": _angle_of,
    "high": _angle_of,
    "ohms": Reader("OHM", _number(0.0, 100.0), _show_number),
    "seed": Reader("NUMBER", _whole(0, 2**63 - 1)),
    "faults": Reader("NUMBER", _whole(1, 100_000)),
    "within": _time_of,
    "kinds": Reader("KIND,...", lambda text: tuple(text.split(",")), ",".join),
    "count": Reader("NUMBER", _whole(1, 100_000)),
    "at": Reader("TIME", _time(0, "such as 2s, 500ms or 100us"), _show_time),
    "packet": Reader("NUMBER", _whole(1, 10**9)),
    "for": _time_of,
}
"""Parser and formatter of each key, in the order of the keys in a formatted fault."""
