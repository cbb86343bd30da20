"""Fault: one disturbance as one line of text, such as `lose servo=3 at=2s`: parsing, validation and
formatting."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from dxlsim.faults.kinds import DEVICE, KINDS, Kind
from dxlsim.faults.values import READERS, Value
from dxlwire.exceptions import InputError, suggestion


class Fault(msgspec.Struct, frozen=True):
    """One fault to inject into simulated buses; `str()` returns the line that `parse_fault` parses."""

    kind: str  # Key of KINDS
    given: Mapping[str, Value]
    """Values by key; times are ns, angles degrees. The fault happens `at` a time after the start of the
    simulation, or after `packet` more instruction packets on the bus. Without both it happens at once."""

    def number(self, key: str) -> int | None:
        """Return the integer given for a key, such as an ID or a time in ns; None if the key is missing."""
        value = self.given.get(key)
        return value if isinstance(value, int) else None

    @property
    def bus(self) -> str | None:
        """Name of the simulated bus; None: the only bus."""
        value = self.given.get("bus")
        return value if isinstance(value, str) else None

    @property
    def servo(self) -> int | None:
        """ID of the affected servo; for a fault of a packet, the servo that sends the reply. None: not
        given."""
        return self.number("servo")

    @property
    def at_ns(self) -> int | None:
        """Time of the fault after the start of the simulation, ns; None: not given."""
        return self.number("at")

    def __str__(self) -> str:
        readers, given = KINDS[self.kind].readers, self.given
        written = [key for key in READERS if key in given and (key, given[key]) != ("count", 1)]
        return " ".join((self.kind, *(f"{key}={readers[key].show(given[key])}" for key in written)))


def parse_fault(text: str) -> Fault:
    """Return the fault of one line such as `silence servo=3 at=1s for=500ms`.

    Raises:
        InputError: The line is wrong; the message is one sentence with the problem and its fix.

    >>> str(parse_fault("silence for=500ms servo=3 at=1.0s"))
    'silence servo=3 at=1s for=500ms'
    """
    words = text.split()
    if not words:
        raise InputError("the fault is empty; write a fault such as: lose servo=3 at=2s")
    name = words[0]
    kind = KINDS.get(name)
    if kind is None:
        known = suggestion(name, tuple(KINDS), f"the faults are {', '.join(KINDS)}")
        raise InputError(f"unknown fault {name!r}; {known}")
    given: dict[str, Value] = {}
    for word in words[1:]:
        key, equals, value = word.partition("=")
        if not equals:
            raise InputError(f"{name}: {word!r} is not key=value; write it as in: {usage(name)}")
        if key not in kind.readers:
            known = suggestion(key, tuple(kind.readers), f"it takes {', '.join(kind.readers)}")
            raise InputError(f"{name} takes no {key!r}; {known}")
        if key in given:
            raise InputError(f"{name}: {key}= is given twice; give it once")
        try:
            given[key] = kind.readers[key].read(value)
        except ValueError as error:
            raise InputError(f"{name}: {key}={value}: {error}") from error
    _check(name, kind, given)
    return Fault(name, {key: value for key, value in given.items() if (key, value) != ("count", 1)})


def usage(name: str) -> str:
    """Return the syntax of a kind of fault: `lose [servo=ID] [from=host] ...`. Raises KeyError for an
    unknown kind."""
    kind = KINDS[name]
    keys = [(key, f"{key}={reader.example}") for key, reader in kind.readers.items()]
    return " ".join((name, *(text if key in kind.needs else f"[{text}]" for key, text in keys)))


def fault_help() -> tuple[str, ...]:
    """Return the syntax and the effect of each kind of fault, one line per kind."""
    return tuple(f"{usage(name)}: {kind.does}" for name, kind in KINDS.items())


def _check(name: str, kind: Kind, given: Mapping[str, Value]) -> None:
    missing = [f"{key}=" for key in kind.needs if key not in given]
    if missing:
        raise InputError(f"{name} needs {' and '.join(missing)}; write it as in: {usage(name)}")
    for one, other in (("at", "packet"), ("data", "size")):
        if one in given and other in given:
            raise InputError(f"{name} has both {one}= and {other}=; omit one of them")
    if "from" in kind.readers and ("servo" in given) == ("from" in given):
        raise InputError(f"{name} needs servo=ID (alters a reply) or from=host (alters an instruction)")
    low, high = given.get("low"), given.get("high")
    if isinstance(low, float) and isinstance(high, float) and low >= high:
        raise InputError(f"{name} has low= above high=; exchange the values")
    stormy = given.get("kinds")
    if isinstance(stormy, tuple):
        possible = [each for each, one in KINDS.items() if one.of != DEVICE and each != "storm"]
        unknown = [each for each in stormy if each not in possible]
        if unknown:
            near = suggestion(unknown[0], possible, f"choose from {', '.join(possible)}")
            raise InputError(
                f"{name}: kinds={','.join(stormy)}: unknown kind {unknown[0]!r} in a storm; {near}"
            )
