"""Requests to the loop itself: the data of its commands, as clients send them and as the log has them."""

from __future__ import annotations

import msgspec


class Switch(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `switch`: names of controllers; all of it happens in one cycle, or nothing does."""

    activate: tuple[str, ...] = ()
    deactivate: tuple[str, ...] = ()


class Rate(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `rate`."""

    rate: float
    """Hz"""


class Unload(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `unload`."""

    controller: str


class Cancel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `cancel`: a goal by its number, or the one that a controller has."""

    goal: int = 0
    controller: str = ""


class NewCommander(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `commander`: another client commands from now on; the event that reports it is all."""

    client: str
    instead: str


class Parameters(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `parameters`: live parameters of a controller, checked against its model before."""

    controller: str
    values: dict[str, bool | int | float]
    """By dotted name, in SI units."""


class TorqueRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `torque`."""

    joints: tuple[str, ...]
    on: bool
    release: bool = False
    """Deactivate the controllers that command the joints, in the same cycle. Without it torque off is refused
    while there are any; torque on starts them again where the joints are."""


class RebootRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `reboot`."""

    joints: tuple[str, ...]
    release: bool = False


class RegisterReading(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Data of `get`."""

    joint: str
    """Or one of its servos, where it has several"""
    item: str
    row: int | None = None
    """Of that servo, behind those of the joints"""


class Register(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Data of `register`; whether the item may be written was checked before."""

    joint: str
    """Or one of its servos, where it has several"""
    item: str
    value: int
    """The integer on the wire, signed where the item is."""
    row: int | None = None
    """Of that servo, behind those of the joints"""
