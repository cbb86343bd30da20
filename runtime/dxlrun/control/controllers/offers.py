"""Offers: classes (such as sensor drivers) that plug-ins offer for features, and checks of their methods."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, TypeAlias

import msgspec

Breach = tuple[str, str]
"""Violation of the plug-in contract: the problem and its fix, two clauses of one message."""


DriverClass: TypeAlias = type[Any]


class DriverOffer(msgspec.Struct, frozen=True):
    """A class that a plug-in offers for entries of a feature's section in the robot file, such as sensors."""

    type: str
    """Name of the class in the robot file, `type:`."""
    driver: DriverClass
    distribution: str
    """Python package that offers the class: `name version`."""


class OfferStage(msgspec.Struct, frozen=True):
    """Plug-in classes of a feature: the object `STAGE` of its `offer.py`."""

    FILE: ClassVar[str] = "offer"

    hook: str
    """Name of the plug-in hook that returns the classes by type: `dxlrun_sensors`."""
    kind: str
    """Noun for an entry in messages: `sensor`."""
    form: str
    """Name of the schema of an entry, which includes the parameters of the classes."""
    find_breach: Callable[[object], Breach | None]
    """Checks a class against the contract when it is loaded; returns the first violation or None."""
    facts: Callable[[DriverClass], Mapping[str, object]] = lambda driver: {}
    """Returns additional fields of a class for `dxlrun plugins --json`."""


def methods_breach(found: object, base: type, names: Sequence[str]) -> Breach | None:
    """Return the first method in `names` that a class lacks, or declares with other arguments than `base`."""
    if missing := sorted(getattr(found, "__abstractmethods__", ())):
        return f"it has no method {' and no method '.join(missing)}", "add the method"
    for name in names:
        own, expected = getattr(found, name), getattr(base, name)
        if not takes(own, expected):
            return (
                f"its {name}{arguments(own)} cannot be called as {name}{arguments(expected)}",
                "declare these arguments",
            )
    return None


def is_model(found: object, base: type) -> bool:
    """Return whether `found` is a class derived from `base`, not an instance or another object."""
    return isinstance(found, type) and issubclass(found, base)


def takes(found: Callable[..., object], contract: Callable[..., object]) -> bool:
    """Return whether a method can be called with as many positional arguments as the contract's method."""
    if found is contract:  # inherited
        return True
    count = len(inspect.signature(contract).parameters)
    try:
        inspect.signature(found).bind(*range(count))
    except (TypeError, ValueError):  # ValueError: the method has no signature
        return False
    return True


def arguments(method: Callable[..., object]) -> str:
    """Return the argument list of a method for messages, without `self`."""
    return f"({', '.join(str(name) for name in inspect.signature(method).parameters if name != 'self')})"
