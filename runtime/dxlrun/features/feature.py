"""Feature: a section or a key of the robot file with everything that belongs to it, in a folder of its own.

A feature is a package whose files have fixed names, one for each stage in which it takes part: `form.py` has
its section, `joint_key.py`, `servo_key.py` or `policy_key.py` its key of joints, servos or `policies`,
`compile.py` its share of the plan, and so on. Such a file has one object `STAGE`. Its class belongs to the
room that asks for it, and documents when that happens. A feature has as many of these files as it needs. The
stage that asks for a file imports it, so `dxlrun check` imports nothing of the run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import cache
from importlib import import_module
from typing import Any, ClassVar, Generic, Protocol, TypeVar, cast

import msgspec

from dxlwire.joint_unit import JointUnit

T = TypeVar("T")


class Stage(Protocol):
    """Class of the object `STAGE` in one kind of file."""

    FILE: ClassVar[str]
    """Name of the module in the package of a feature."""


S = TypeVar("S", bound=Stage)


class Section(msgspec.Struct, Generic[T], frozen=True):
    """Section of the robot file: `STAGE` of `form.py`, asked for before a file is read.

    The form is built of the sections of all features, so none of them is named anywhere else.
    """

    FILE: ClassVar[str] = "form"

    name: str
    """Key at the top of the robot file, such as `devices`."""
    form: object
    """Type of the section's value, for pydantic, such as `dict[Name, Device]`; or a function that returns it,
    if features add keys to it."""
    field: T
    """Field of the key, with its default, as `dxlrun.description.form.key` returns it."""
    before: str = ""
    """Key that follows it in lists of all keys; it is the last where there is no such key."""
    moved_joints: Callable[[object], Iterable[str]] = lambda section: ()
    """Yields the joints whose servos are in this section, which may have mistakes. Groups and defaults give
    such joints no keys of servos."""

    def of(self, robot: object) -> T:
        """Return the section of a robot file that was read."""
        section: T = getattr(robot, self.name)
        return section


class KeyedJoint(Protocol):
    """Joint of a plan, with the keys of features that the robot file gives it."""

    @property
    def keys(self) -> Mapping[str, object]:
        """Values by key, as JSON has them."""


class JointKey(msgspec.Struct, Generic[T], frozen=True):
    """Key of a joint: `STAGE` of `joint_key.py`, asked for before a file is read.

    Every joint may have it, and so may `groups` and `joint_defaults`. The plan of a joint has the value that
    the robot file gives, numbers in SI units; `dxlrun check` and the clients of a run show it.
    """

    FILE: ClassVar[str] = "joint_key"

    name: str
    """The key, such as `tolerance`; that of the feature."""
    form: object
    """Type of the value in the file, for pydantic: `Position | None`."""
    field: object
    """Field of the key, with its default, as `dxlrun.description.form.key` returns it."""
    value: type[T]
    """Type of the value in the plan: `float`, or a struct of msgspec for a form."""
    before: str = ""
    """Key of a joint that follows it in lists of all keys; it is the last where there is no such key."""
    examples: Mapping[JointUnit, str] = {}
    """How a value is written where the joint turns, and where it is linear; one of the other kind is refused.
    Empty: its unit has nothing to do with that of the joint."""

    def of(self, joint: KeyedJoint) -> T | None:
        """Return the value of a joint in a plan; None: the robot file gives none."""
        return msgspec.convert(joint.keys[self.name], self.value) if self.name in joint.keys else None


class KeyedServo(Protocol):
    """Servo of a robot file, with the keys of features."""

    @property
    def keys(self) -> Mapping[str, object]:
        """Values by key, as the form of the key has read them."""


class ServoKey(msgspec.Struct, Generic[T], frozen=True):
    """Key of a servo: `STAGE` of `servo_key.py`, asked for before a file is read.

    A joint with servos of its own has it for all of them, and one of its servos for itself; so have `groups`,
    `joint_defaults`, and the servos in the section of a feature.
    """

    FILE: ClassVar[str] = "servo_key"

    name: str
    """The key, such as `registers`; that of the feature."""
    form: object
    """Type of the value in the file, for pydantic."""
    field: object
    """Field of the key in a joint, with its default, as `dxlrun.description.form.key` returns it."""
    of_one: object
    """Field of the key in one of several servos of a joint. Its default is None: the value of the joint."""
    of_section: object
    """Field of the key in a servo that has no joint of its own."""
    before: str = ""
    """Key of a servo that follows it in lists of all keys; it is the last where there is no such key."""

    def of(self, servo: KeyedServo) -> T:
        """Return the value of a servo, which is that of its joint if it has none itself."""
        return cast("T", servo.keys[self.name])


class PolicyKey(msgspec.Struct, Generic[T], frozen=True):
    """Key of the section `policies`: `STAGE` of `policy_key.py`, asked for before a file is read."""

    FILE: ClassVar[str] = "policy_key"

    name: str
    """The key, such as `on_lost_servo`; that of the feature."""
    form: object
    """Type of the value, for pydantic: `Literal["stop", "limp"] | None`."""
    field: T
    """Field of the key, with its default, as `dxlrun.description.form.key` returns it."""
    before: str = ""
    """Key of the section that follows it in lists of all keys; it is the last where there is no such key."""
    group: PolicyKey[Any] | None = None
    """The same key of `policies.groups.NAME`; None: groups do not have it."""

    def of(self, policies: object) -> T:
        """Return the value in the section, or in one of its groups, that was read."""
        value: T = getattr(policies, self.name)
        return value


class Feature(msgspec.Struct, frozen=True):
    """A feature by its name and the package that has its files."""

    name: str
    """Its key in the robot file, such as `devices`: at the top, of joints, of servos or of `policies`."""
    package: str
    """Package with its files, such as `dxlrun.features.devices`."""
    distribution: str = ""
    """Publisher of the plug-in that has the package: `name version`. Empty for the features of dxlrun."""

    def stage(self, kind: type[S]) -> S | None:
        """Return what the feature does in one stage, or None if it has no such file."""
        return _stage(self.package, kind)


@cache
def _stage(package: str, kind: type[S]) -> S | None:
    module = f"{package}.{kind.FILE}"
    try:
        stage = import_module(module).STAGE
    except ModuleNotFoundError as error:
        if error.name == module:
            return None
        raise
    if not isinstance(stage, kind):
        raise TypeError(f"STAGE of {module} is a {type(stage).__name__}, not a {kind.__name__}")
    return stage
