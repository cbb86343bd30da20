"""Requests to the loop: data of its commands, in the form that clients send and the log has."""

from __future__ import annotations

import msgspec


class Switch(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `switch`: names of controllers. The switch is executed in one cycle as a whole, or refused."""

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
    """Data of `cancel`: number of a goal, or the controller whose goal is cancelled."""

    goal: int = 0
    controller: str = ""


class NewCommander(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `commander`: another client commands the robot from now on. It only causes an event."""

    client: str
    instead: str


class Parameters(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `parameters`: live parameters of a controller, already validated by its model."""

    controller: str
    values: dict[str, bool | int | float]
    """Values by dotted name, in SI units."""


class TorqueRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `torque`."""

    joints: tuple[str, ...]
    on: bool
    release: bool = False
    """Deactivate the controllers that command the joints, in the same cycle. Otherwise, torque off is refused
    while there are such controllers, and torque on restarts them at the positions of the joints."""


class RebootRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `reboot`."""

    joints: tuple[str, ...]
    release: bool = False


class RegisterReading(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Data of `get`."""

    joint: str
    """Name of a joint, or of one of its servos if it has several."""
    item: str
    row: int | None = None
    """Row of that servo, after the rows of the joints."""


class Register(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Data of `register`. The sender has checked that the item may be written."""

    joint: str
    """Name of a joint, or of one of its servos if it has several."""
    item: str
    value: int
    """Raw value of the register, signed if the item is."""
    row: int | None = None
    """Row of that servo, after the rows of the joints."""
