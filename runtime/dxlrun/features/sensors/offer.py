"""Checks sensor classes of plug-ins against the contract of `Sensor` when they are loaded."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import cast

from dxlrun.control.controllers.offers import Breach, OfferStage, is_model, methods_breach
from dxlrun.description.base_form import ParametersModel
from dxlrun.features.sensors.driver import Sensor
from dxlrun.features.sensors.form import SensorEntry

_METHODS = ("__init__", "states", "units", "links", "noisy", "open", "read", "close")
"""Methods of a sensor that dxlrun calls, always with positional arguments."""


def sensor_breach(sensor: object) -> Breach | None:
    """Return how an object breaks the contract of a sensor class, with the fix; None if it does not."""
    if not is_model(sensor, Sensor):
        return "it is not a sensor", "derive it from dxlrun.Sensor"
    if breach := methods_breach(sensor, Sensor, _METHODS):
        return breach
    if not is_model(getattr(sensor, "Parameters", None), ParametersModel):
        return "its Parameters is not a parameters model", "derive it from dxlrun.ParametersModel"
    for flag in ("waits", "simulated"):
        if not isinstance(getattr(sensor, flag), bool):
            return f"its {flag} is neither True nor False", "set it to True or False"
    return None


def names_breach(states: object, links: object) -> Breach | None:
    """Return what is wrong with a sensor's results of `states` and `links`, with the fix; None if nothing."""
    for what, names in (("states", states), ("links", links)):
        if not isinstance(names, tuple) or not all(isinstance(one, str) for one in names):
            return f"returns {names!r} from {what}", "return a tuple of names, such as angular_velocity.x"
    found = cast("tuple[str, ...]", states)
    if not found:
        return "returns () from states", "return a tuple of names, such as angular_velocity.x"
    if wrong := [one for one in found if not one or "/" in one or one == "age"]:
        return (
            f"has a state {wrong[0]!r}",
            "choose a name such as angular_velocity.x; age is reserved",
        )
    if len(set(found)) < len(found):
        return f"has a state twice: {', '.join(found)}", "name each state once"
    return None


def is_units(found: object, states: Collection[str]) -> bool:
    """Return True if a result of a sensor's `units` maps some of its states to texts."""
    return (
        isinstance(found, Mapping)
        and set(found) <= set(states)
        and all(isinstance(unit, str) for unit in found.values())
    )


STAGE = OfferStage(
    "dxlrun_sensors",
    "sensor",
    SensorEntry.__name__,
    sensor_breach,
    lambda driver: {"simulated": driver.simulated},
)
