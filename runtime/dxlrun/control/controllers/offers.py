"""Offers: classes of plug-ins for the sections of features, checked against the contract when loaded."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TypeAlias

import msgspec

Breach = tuple[str, str]
"""What is wrong, and how to fix it."""


DriverClass: TypeAlias = type[Any]


class DriverOffer(msgspec.Struct, frozen=True):
    """A class that a plug-in offers for the section of a feature."""

    type: str
    """The robot file's name for it."""
    driver: DriverClass
    distribution: str
    """Its publisher: `name version`."""


@dataclass(frozen=True)
class OfferStage:
    """`STAGE` of `offer.py`: classes that plug-ins offer for the entries of the feature's section."""

    FILE: ClassVar[str] = "offer"

    hook: str
    """Hook that returns them, by type: `dxlrun_sensors`."""
    kind: str
    """Word for one of them in sentences: `sensor`."""
    form: str
    """Name of the form of an entry, in whose schema their parameters are."""
    find_breach: Callable[[object], Breach | None]
    """Checks a class against the contract when it is loaded."""
    facts: Callable[[DriverClass], Mapping[str, object]] = lambda driver: {}
    """Returns what `dxlrun plugins --json` has of a class beside its type."""


def methods_breach(found: object, base: type, names: Sequence[str]) -> Breach | None:
    """Check the methods of a class that derives from the contract's."""
    if missing := sorted(getattr(found, "__abstractmethods__", ())):
        return f"which has no method {' and no method '.join(missing)}", "write it"
    for name in names:
        own, expected = getattr(found, name), getattr(base, name)
        if not takes(own, expected):
            return (
                f"whose {name}{arguments(own)} cannot be called as {name}{arguments(expected)}",
                "give it these arguments",
            )
    return None


def is_model(found: object, base: type) -> bool:
    """Return whether something is a class derived from another."""
    return isinstance(found, type) and issubclass(found, base)


def takes(found: Callable[..., object], contract: Callable[..., object]) -> bool:
    """Return whether a method can be called as the contract's: by position, with as many arguments."""
    if found is contract:  # inherited
        return True
    count = len(inspect.signature(contract).parameters)
    try:
        inspect.signature(found).bind(*range(count))
    except (TypeError, ValueError):  # ValueError: nothing is known about its arguments
        return False
    return True


def arguments(method: Callable[..., object]) -> str:
    """Return the arguments of a method, as they are shown."""
    return f"({', '.join(str(name) for name in inspect.signature(method).parameters if name != 'self')})"
