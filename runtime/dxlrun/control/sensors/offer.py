"""Offers of sensors: a class of a plug-in is checked against the contract when it is loaded."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import Any, cast

import msgspec

from dxlrun.contract.sensor import Sensor
from dxlrun.description.form import ParametersModel

Breach = tuple[str, str]
"""What is wrong, and how to fix it."""

_METHODS = ("__init__", "states", "units", "links", "noisy", "open", "read", "close")
"""Called by dxlrun, all by position."""


SensorClass = type[Sensor[Any]]


class SensorOffer(msgspec.Struct, frozen=True):
    """A sensor that a plug-in offers."""

    type: str
    """The robot file's name for it."""
    sensor: SensorClass
    distribution: str
    """Its publisher: `name version`."""


def sensor_breach(sensor: object) -> Breach | None:
    """Check a class that is offered as a sensor."""
    if not is_model(sensor, Sensor):
        return "which is no sensor", "derive a class from dxlrun.Sensor"
    if breach := methods_breach(sensor, Sensor, _METHODS):
        return breach
    if not is_model(getattr(sensor, "Parameters", None), ParametersModel):
        return "whose Parameters is no model of parameters", "derive it from dxlrun.ParametersModel"
    for flag in ("waits", "simulated"):
        if not isinstance(getattr(sensor, flag), bool):
            return f"whose {flag} is neither True nor False", "write one of them"
    return None


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


def names_breach(states: object, links: object) -> Breach | None:
    """Check what a sensor's `states` and `links` returned."""
    for what, names in (("states", states), ("links", links)):
        if not isinstance(names, tuple) or not all(isinstance(one, str) for one in names):
            return f"returns {names!r} from {what}", "return a tuple of names, such as angular_velocity.x"
    found = cast("tuple[str, ...]", states)
    if not found:
        return "returns () from states", "return a tuple of names, such as angular_velocity.x"
    if wrong := [one for one in found if not one or "/" in one or one == "age"]:
        return (
            f"has a state {wrong[0]!r}",
            "name a state as angular_velocity.x; each source has an age already",
        )
    if len(set(found)) < len(found):
        return f"has a state twice: {', '.join(found)}", "name each once"
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
