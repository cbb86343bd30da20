"""A fault as one line of text, `lose servo=3 at=2s`: the kinds there are, and what each takes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import msgspec

from dxlrun.errors import InputError, suggestion


class Fault(msgspec.Struct, frozen=True, kw_only=True):
    """One thing that goes wrong on simulated buses; `str()` gives the line that `parse_fault` reads back.

    None: not given. Times are ns, angles degrees; `at_ns` counts from the start of the simulation.
    """

    kind: str  # one of KINDS
    bus: str | None = None  # None: the only bus there is
    servo: int | None = None  # ID; for a packet: the servo whose reply it is
    host: bool = False  # True: the packet is an instruction of the host, not a reply
    at_ns: int | None = None  # when; None and no `packet`: now
    packet: int | None = None  # after so many more instruction packets on the bus
    for_ns: int | None = None  # how long; None: for good, or as long as such a thing takes
    count: int = 1  # how many packets one after the other
    byte: int | None = None  # index of the byte that is spoilt, negative from the end
    flip: int | None = None  # bits of it that are turned
    keep: int | None = None  # bytes of the packet that get through
    by_ns: int | None = None  # how much later the reply starts
    by_deg: float | None = None
    """How far a shaft is turned, counter-clockwise: towards higher positions; or a device tipped."""
    about: str | None = None  # axis of a device about which it is tipped, in its own frame: x, y or z
    copies: int | None = None  # how often the reply comes in all
    data: bytes | None = None
    size: int | None = None  # bytes of noise, drawn from the script's seed
    every_ns: int | None = None  # pause between two bursts of a babbling servo
    number: int | None = None  # model number
    volts: float | None = None
    celsius: float | None = None
    share: float | None = None  # part of the packets, 0 to 1
    low_deg: float | None = None  # angles of a shaft from the servo's raw 0
    high_deg: float | None = None
    ohms: float | None = None
    seed: int | None = None
    faults: int | None = None
    within_ns: int | None = None
    kinds: tuple[str, ...] | None = None

    def __str__(self) -> str:
        words: list[str] = [self.kind]
        for name in KEYS:
            key = key_of(self.kind, name)
            value = getattr(self, key.field)
            if value is not None and value != key.default:
                words.append(f"{name}={key.show(value)}")
        return " ".join(words)


class Kind(NamedTuple):
    """What a kind of fault does, and the keys that its line takes."""

    does: str
    needs: tuple[str, ...]
    takes: tuple[str, ...]

    @property
    def keys(self) -> tuple[str, ...]:
        """Every key that it knows."""
        return (*self.needs, *self.takes)


NOISE_BYTES = 8
TIMER_NS = 16_000_000  # latency timer of an FTDI adapter as it is shipped (AN232B-04)
FLIPPED_BITS = 0x01
HOT_CELSIUS = 90.0
"""Above Temperature Limit (31) as every model has it from the factory: 85 degrees C at most."""
BOOT_NS = 100_000_000
"""How long a servo that starts again receives nothing; no manual names it [i]."""
BROWNOUT_NS = 200_000_000
BABBLE_NS = 200_000_000
BABBLE_PAUSE_NS = 2_000_000
TURN_NS = 1_000_000_000
SHORTEST_PAUSE_NS = 100_000
"""A babbling servo without pauses would leave the simulation no time."""
OF_SERVOS = frozenset(("overload", "overheat", "turn", "duplicate_id", "loose", "jam", "sag"))
"""Kinds that need a shaft, or a servo's model: they do not happen to other devices."""
OF_DEVICES = frozenset(("tip",))  # kinds that happen to devices alone

_PARTS = {"WHEN": "bus at packet", "PACKET": "servo from count bus at packet"}
_TABLE = """
lose: / PACKET: the next reply of a servo, or instruction of the host, is lost
corrupt: / byte flip PACKET: a byte of it (default: the last) has bits flipped (default 0x01)
truncate: keep / PACKET: only its first bytes get through
delay: servo by / count WHEN: the next reply of a servo starts later
duplicate: servo / copies count WHEN: the next reply of a servo comes twice, or as often as copies=
noise: / data size WHEN: bytes that no servo sent are on the line: those of data= (hex), or size= random
    ones (default 8)
silence: servo / for WHEN: the data line of a servo is cut: it keeps moving
babble: servo / for every size WHEN: a servo sends random bytes (size=, default 8) every 2 ms (every=) for
    200 ms (for=), unasked
reboot: servo / for WHEN: a servo starts again by itself: RAM is lost, and it receives nothing for 100 ms
    (for=)
brownout: / servo for WHEN: a servo, or every one on the bus, has no power for 200 ms (for=), then starts
    again
voltage: volts / servo for WHEN: the supply of a servo, or of every one on the bus, is another one
other_model: servo number / for WHEN: a servo or device answers with another model number
overload: servo / WHEN: the shaft of a servo is loaded beyond its torque
overheat: servo / celsius for WHEN: a servo is hot (default 90)
turn: servo by / for WHEN: a hand turns the shaft of a servo in 1 s (for=); it gives way to one that holds
    or drives it
tip: servo by / about for WHEN: a device turns in 1 s (for=) and stays so: forward about y, or about=x, z of
    its own axes
duplicate_id: servo / WHEN: a second servo of the same model has this ID
loose: servo low high / share for WHEN: the cable of a servo has no contact while its shaft is between two
    angles, or a share= of the time
lossy: share / servo for WHEN: a share of all packets of a servo, or of every one on the bus, is lost
slow: servo by / for WHEN: a servo starts every reply later
jam: servo / for WHEN: the shaft of a servo is blocked
sag: ohms / for WHEN: the supply of the whole bus has a resistance: its voltage falls with the current of
    all servos
timer: / by for WHEN: the adapter has a latency timer of 16 ms (by=), as FTDI chips are shipped
unplug: / for WHEN: the adapter is pulled, and comes back after for=, under another name
wedge: / for WHEN: the adapter takes bytes and gives none
storm: faults within / seed kinds bus at: so many faults at random times within a time, of those in kinds=
    (default: those that pass)
"""
"""A line a kind: its name, the keys that it needs / those that it takes, and what it does."""


def _kinds_of(table: str) -> Mapping[str, Kind]:
    kinds = {}
    for line in table.strip().replace("\n    ", " ").splitlines():
        name, keys, does = line.split(": ", 2)
        needs, _, takes = keys.partition("/")
        words = [_PARTS.get(word, word) for word in takes.split()]
        kinds[name] = Kind(does, tuple(needs.split()), tuple(" ".join(words).split()))
    return kinds


KINDS = _kinds_of(_TABLE)


def parse_fault(text: str) -> Fault:
    """Return the fault of one line such as `silence servo=3 at=1s for=500ms`.

    Raises InputError with one sentence: what is wrong and how to write it.
    """
    words = text.split()
    if not words:
        raise InputError("a fault is missing; write one such as: lose servo=3 at=2s")
    name = words[0]
    kind = KINDS.get(name)
    if kind is None:
        raise InputError(f"there is no fault {name!r}; {_meant(name, tuple(KINDS), 'the faults are')}")
    given: dict[str, object] = {}
    for word in words[1:]:
        key, equals, value = word.partition("=")
        if not equals:
            raise InputError(f"{name}: {word!r} is no key=value; write it as in: {usage(name)}")
        if key not in kind.keys:
            raise InputError(f"{name} takes no {key!r}; {_meant(key, kind.keys, 'it takes')}")
        reader = key_of(name, key)
        if reader.field in given:
            raise InputError(f"{name}: {key}= is there twice; leave one of them out")
        try:
            given[reader.field] = reader.parse(value)
        except ValueError as error:
            raise InputError(f"{name}: {key}={value}: {error}") from error
    _check(name, kind, given)
    return Fault(kind=name, **given)  # type: ignore[arg-type]  # each key's parser gives its field's type


def usage(name: str) -> str:
    """Return how a kind is written: `lose [servo=ID] [from=host] ...`; raises KeyError for no kind."""
    kind = KINDS[name]
    needs = [f"{key}={key_of(name, key).example}" for key in kind.needs]
    takes = [f"[{key}={key_of(name, key).example}]" for key in kind.takes]
    return " ".join((name, *needs, *takes))


def fault_help() -> tuple[str, ...]:
    """Return what a person can write: for each kind its line, and what it does."""
    return tuple(f"{usage(name)}: {kind.does}" for name, kind in KINDS.items())


def _check(name: str, kind: Kind, given: Mapping[str, object]) -> None:
    missing = [key for key in kind.needs if key_of(name, key).field not in given]
    if missing:
        raise InputError(
            f"{name} needs {' and '.join(f'{key}=' for key in missing)}; write it as in: {usage(name)}"
        )
    if "at_ns" in given and "packet" in given:
        raise InputError(f"{name} has both at= and packet=; leave one of them out")
    if "from" in kind.keys and ("servo" in given) == ("host" in given):
        raise InputError(f"{name} needs either servo=ID, for its reply, or from=host, for an instruction")
    low, high = given.get("low_deg"), given.get("high_deg")
    if isinstance(low, float) and isinstance(high, float) and low >= high:
        raise InputError(f"{name} has low= above high=; exchange them")
    if "data" in given and "size" in given:
        raise InputError(f"{name} has both data= and size=; leave one of them out")


def _meant(name: str, known: tuple[str, ...], otherwise: str) -> str:
    return suggestion(name, known, f"{otherwise} {', '.join(known)}")


# How values are read and written


class Key(NamedTuple):
    """How one key of a fault's line is read and written."""

    field: str
    example: str
    parse: Callable[[str], object]
    show: Callable[[object], str] = str
    default: object = None


def _integer(lowest: int, highest: int) -> Callable[[str], int]:
    def parse(text: str) -> int:
        try:
            value = int(text, 0)
        except ValueError:
            raise ValueError(f"write a whole number from {lowest} to {highest}") from None
        if not lowest <= value <= highest:
            raise ValueError(f"write a whole number from {lowest} to {highest}")
        return value

    return parse


def _number(lowest: float, highest: float) -> Callable[[str], float]:
    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not lowest <= value <= highest:
            raise ValueError(f"write a number from {lowest:g} to {highest:g}, without its unit")
        return value

    return parse


def _time(text: str) -> int:
    # not above: the process of the simulated buses needs pydantic for nothing else, and it is slow to import
    from dxlrun.description.units import duration

    try:
        return duration(text)
    except ValueError:
        raise ValueError("write a time such as 2s, 500ms or 100us") from None


def _time_from(least_ns: int, asked: str) -> Callable[[str], int]:
    def parse(text: str) -> int:
        value = _time(text)
        if value < least_ns:
            raise ValueError(f"write a time {asked}")
        return value

    return parse


def _show_time(value: object) -> str:
    total = int(str(value))
    for unit, ns in (("s", 10**9), ("ms", 10**6), ("us", 10**3)):
        if total % ns == 0:
            return f"{total // ns}{unit}"
    return f"{total}ns"


def _show_number(value: object) -> str:
    short = f"{value:g}"
    return short if float(short) == value else repr(value)


def _angle(text: str) -> float:
    number = text.removesuffix("deg").removesuffix("rad")
    try:
        value = float(number) * (1.0 if text.endswith("deg") else math.degrees(1.0))
    except ValueError:
        value = math.nan
    if number == text or not 0.0 < abs(value) <= _MOST_DEGREES:
        raise ValueError("write an angle such as 30deg or -0.5rad, of at most 100 turns")
    return value


def _any_angle(text: str) -> float:
    return 0.0 if text in ("0deg", "0rad") else _angle(text)


def _share(text: str) -> float:
    value = _number(0.0, 1.0)(text)
    if value == 0.0:
        raise ValueError("write a number above 0, at most 1")
    return value


def _hex(text: str) -> bytes:
    try:
        data = bytes.fromhex(text)
    except ValueError:
        data = b""
    if not 1 <= len(data) <= _MOST_BYTES:
        raise ValueError(f"write 1 to {_MOST_BYTES} bytes in hex, such as ff00fd")
    return data


def _host(text: str) -> bool:
    if text != "host":
        raise ValueError("write from=host for an instruction, servo=ID for a reply")
    return True


def _word(may_be: Callable[[str], bool], asked: str) -> Callable[[str], str]:
    def parse(text: str) -> str:
        if not may_be(text):
            raise ValueError(f"write {asked}")
        return text

    return parse


def _kinds(text: str) -> tuple[str, ...]:
    names = tuple(text.split(","))
    possible = tuple(name for name in KINDS if name not in OF_DEVICES and name != "storm")
    unknown = [name for name in names if name not in possible]
    if unknown:
        near = _meant(unknown[0], possible, "write some of")
        raise ValueError(f"a storm has no {unknown[0]!r}; {near}")
    return names


_MOST_BYTES = 256
_MOST_DEGREES = 36_000.0
_some_time = _time_from(1, "longer than 0, such as 500ms")


def _show_angle(value: object) -> str:
    return f"{_show_number(value)}deg"


KEYS: Mapping[str, Key] = {
    "bus": Key("bus", "NAME", _word(bool, "the name of a bus")),
    "servo": Key("servo", "ID", _integer(0, 253)),
    "from": Key("host", "host", _host, lambda value: "host", default=False),
    "byte": Key("byte", "INDEX", _integer(-_MOST_BYTES, _MOST_BYTES)),
    "flip": Key("flip", "BITS", _integer(1, 255), lambda value: f"{value:#04x}"),
    "keep": Key("keep", "BYTES", _integer(1, _MOST_BYTES)),
    "by": Key("by_ns", "TIME", _some_time, _show_time),
    "about": Key("about", "AXIS", _word(("x", "y", "z").__contains__, "x, y or z: an axis of the device")),
    "copies": Key("copies", "NUMBER", _integer(2, 16)),
    "data": Key("data", "HEX", _hex, lambda value: value.hex() if isinstance(value, bytes) else ""),
    "size": Key("size", "BYTES", _integer(1, _MOST_BYTES)),
    "every": Key("every_ns", "TIME", _time_from(SHORTEST_PAUSE_NS, "of 100us or more"), _show_time),
    "number": Key("number", "NUMBER", _integer(0, 65_535)),
    "volts": Key("volts", "V", _number(0.0, 60.0), _show_number),
    "celsius": Key("celsius", "DEGREES", _number(-50.0, 200.0), _show_number),
    "share": Key("share", "0.1", _share, _show_number),
    "low": Key("low_deg", "ANGLE", _any_angle, _show_angle),
    "high": Key("high_deg", "ANGLE", _any_angle, _show_angle),
    "ohms": Key("ohms", "OHM", _number(0.0, 100.0), _show_number),
    "seed": Key("seed", "NUMBER", _integer(0, 2**63 - 1)),
    "faults": Key("faults", "NUMBER", _integer(1, 100_000)),
    "within": Key("within_ns", "TIME", _some_time, _show_time),
    "kinds": Key(
        "kinds", "KIND,...", _kinds, lambda value: ",".join(value) if isinstance(value, tuple) else ""
    ),
    "count": Key("count", "NUMBER", _integer(1, 100_000), default=1),
    "at": Key("at_ns", "TIME", _time, _show_time),
    "packet": Key("packet", "NUMBER", _integer(1, 10**9)),
    "for": Key("for_ns", "TIME", _some_time, _show_time),
}
OF_KIND: Mapping[tuple[str, str], Key] = {
    (kind, "by"): Key("by_deg", "ANGLE", _angle, _show_angle) for kind in ("turn", "tip")
}
"""Keys that mean something else to one kind."""


def key_of(kind: str, name: str) -> Key:
    """Return how a key of a kind is read and written; raises KeyError for no key."""
    return OF_KIND.get((kind, name)) or KEYS[name]
