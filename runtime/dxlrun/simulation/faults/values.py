"""How the values of a fault's line are read and written: `3`, `500ms`, `-30deg`, `ff00fd`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

Value = int | float | str | bytes | tuple[str, ...]

SHORTEST_PAUSE_NS = 100_000
"""A babbling servo without pauses would leave the simulation no time."""
_MOST_BYTES = 256
_MOST_DEGREES = 36_000.0


class Reader(NamedTuple):
    """Reads a value from its text, and writes it back; `example` stands for it in the help."""

    example: str
    read: Callable[[str], Value]
    """Raises ValueError with what to write."""
    show: Callable[..., str] = str


def _one_of(may_be: Callable[[str], bool], asked: str) -> Callable[[str], str]:
    def read(text: str) -> str:
        if not may_be(text):
            raise ValueError(f"write {asked}")
        return text

    return read


def _whole(lowest: int, highest: int) -> Callable[[str], int]:
    def read(text: str) -> int:
        try:
            value = int(text, 0)
        except ValueError:
            value = lowest - 1
        if not lowest <= value <= highest:
            raise ValueError(f"write a whole number from {lowest} to {highest}")
        return value

    return read


def _float(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _number(lowest: float, highest: float) -> Callable[[str], float]:
    def read(text: str) -> float:
        value = _float(text)
        if not lowest <= value <= highest:
            raise ValueError(f"write a number from {lowest:g} to {highest:g}, without its unit")
        return value

    return read


def _share(text: str) -> float:
    value = _number(0.0, 1.0)(text)
    if value == 0.0:
        raise ValueError("write a number above 0, at most 1")
    return value


def _angle(text: str) -> float:
    number = text.removesuffix("deg").removesuffix("rad")
    value = _float(number) * (1.0 if text.endswith("deg") else math.degrees(1.0))
    if number == text or not 0.0 < abs(value) <= _MOST_DEGREES:
        raise ValueError("write an angle such as 30deg or -0.5rad, of at most 100 turns")
    return value


def _time(least_ns: int, asked: str) -> Callable[[str], int]:
    def read(text: str) -> int:
        # not above: the process of the simulated buses needs pydantic for nothing else, and it is slow
        from dxlrun.description.units import duration

        try:
            value = duration(text)
        except ValueError:
            raise ValueError("write a time such as 2s, 500ms or 100us") from None
        if value < least_ns:
            raise ValueError(f"write a time {asked}")
        return value

    return read


def _hex(text: str) -> bytes:
    try:
        data = bytes.fromhex(text)
    except ValueError:
        data = b""
    if not 1 <= len(data) <= _MOST_BYTES:
        raise ValueError(f"write 1 to {_MOST_BYTES} bytes in hex, such as ff00fd")
    return data


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
_angle_of = Reader("ANGLE", lambda text: 0.0 if text in ("0deg", "0rad") else _angle(text), _show_angle)
TURN = Reader("ANGLE", _angle, _show_angle)
"""Of `by` where it is an angle."""
READERS: Mapping[str, Reader] = {
    "bus": Reader("NAME", _one_of(bool, "the name of a bus")),
    "servo": Reader("ID", _whole(0, 253)),
    "from": Reader("host", _one_of("host".__eq__, "from=host for an instruction, servo=ID for a reply")),
    "byte": Reader("INDEX", _whole(-_MOST_BYTES, _MOST_BYTES)),
    "flip": Reader("BITS", _whole(1, 255), "{:#04x}".format),
    "keep": Reader("BYTES", _whole(1, _MOST_BYTES)),
    "by": _time_of,
    "about": Reader("AXIS", _one_of(("x", "y", "z").__contains__, "x, y or z: an axis of the device")),
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
    "at": Reader("TIME", _time(0, ""), _show_time),
    "packet": Reader("NUMBER", _whole(1, 10**9)),
    "for": _time_of,
}
"""By key, in the order in which a fault is written."""
