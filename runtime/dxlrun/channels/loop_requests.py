"""Requests to the loop: data of its commands, in the form that clients send and the log has."""

from __future__ import annotations

import msgspec


class Switch(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `switch`: names of controllers. The switch is executed in one cycle as a whole, or refused."""

    activate: tuple[str, ...] = ()
    deactivate: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """The data as text for an event: `activate head; deactivate arm`."""
        parts = {"activate": self.activate, "deactivate": self.deactivate}
        return "; ".join(f"{verb} {', '.join(names)}" for verb, names in parts.items() if names)


class Rate(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `rate`: new rate of the loop."""

    rate: float
    """Rate of the loop, Hz."""

    @property
    def words(self) -> str:
        """The data as text for an event: `40 Hz`."""
        return f"{self.rate:g} Hz"


class Unload(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `unload`: name of an inactive controller to remove from the run."""

    controller: str

    @property
    def words(self) -> str:
        """The data as text for an event: `arm`."""
        return self.controller


class Cancel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `cancel`: number of a goal, or the controller whose goal is cancelled."""

    goal: int = 0
    controller: str = ""

    @property
    def words(self) -> str:
        """The data as text for an event: `goal 3`."""
        return f"goal {self.goal}" if self.goal else f"the goal of {self.controller}"


class NewCommander(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `commander`: another client commands the robot from now on. It only causes an event."""

    client: str
    instead: str

    @property
    def words(self) -> str:
        """The data as text for an event: `anna instead of this computer`."""
        return f"{self.client} instead of {self.instead}"


class ParametersRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `parameters`: live parameters of a controller, already validated by its model."""

    controller: str
    values: dict[str, bool | int | float]
    """New values by dotted name, such as `gains.p`, in SI units."""

    @property
    def words(self) -> str:
        """The data as text for an event: `of arm: gains.p = 3.0`."""
        return (
            f"of {self.controller}: {', '.join(f'{name} = {value}' for name, value in self.values.items())}"
        )


class TorqueRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `torque`: joints whose torque is enabled or disabled."""

    joints: tuple[str, ...]
    on: bool
    release: bool = False
    """Deactivate the controllers that command the joints, in the same cycle. Otherwise, torque off is refused
    while there are such controllers, and torque on restarts them at the positions of the joints."""

    @property
    def words(self) -> str:
        """The data as text for an event: `off: elbow`."""
        return f"{'on' if self.on else 'off'}: {', '.join(self.joints)}"


class RebootRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Data of `reboot`: joints whose servos restart; `release` as in TorqueRequest."""

    joints: tuple[str, ...]
    release: bool = False

    @property
    def words(self) -> str:
        """The data as text for an event: `elbow`."""
        return ", ".join(self.joints)


class RegisterReading(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Data of `get`: a register (control table item) of a servo to read."""

    joint: str
    """Name of a joint, or of one of its servos if it has several."""
    item: str
    row: int | None = None
    """Index of the servo behind the joints' rows if `joint` names a servo; None: the row of the joint."""

    @property
    def words(self) -> str:
        """The data as text for an event: `p_gain of elbow`."""
        return f"{self.item} of {self.joint}"


class Register(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Data of `register`: a register (control table item) of a servo to write.

    It was checked to be writable.
    """

    joint: str
    """Name of a joint, or of one of its servos if it has several."""
    item: str
    value: int
    """Raw value of the register, signed if the item is."""
    row: int | None = None
    """Index of the servo behind the joints' rows if `joint` names a servo; None: the row of the joint."""

    @property
    def words(self) -> str:
        """The data as text for an event: `p_gain of elbow = 40`."""
        return f"{self.item} of {self.joint} = {self.value}"
