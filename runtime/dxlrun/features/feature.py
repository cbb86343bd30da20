"""Feature: a section or a key of the robot file with everything that it needs, in one place.

A feature is a package whose files have fixed names, one for each stage in which it takes part: `form.py` has
its section, `joint_key.py`, `servo_key.py` or `policy_key.py` its key of joints, servos or `policies`,
`compile.py` its share of the plan, and so on. Each file has one object `STAGE`. The class of the object
belongs to the package of that stage, and documents when the stage is used. A feature has only the files that
it needs. The stage imports its file, so `dxlrun check` does not import any file of the run.

A small feature is one module with these objects in a tuple `STAGES`, but for `events`, `process` and `safe`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from types import FunctionType
from typing import Any, ClassVar, Generic, Protocol, TypeVar, cast

import msgspec

from dxlwire.joint_unit import JointUnit

T = TypeVar("T")


class Stage(Protocol):
    """Class of the object `STAGE` in one kind of file."""

    FILE: ClassVar[str]
    """Name of the module in the package of a feature."""


S = TypeVar("S", bound=Stage)


def type_of(form: object) -> object:
    """Return the type of a key's value, which a feature may give as a function that returns the type."""
    return form() if isinstance(form, FunctionType) else form


class Section(msgspec.Struct, Generic[T], frozen=True):
    """Section of the robot file: `STAGE` of `form.py`, used before a file is read.

    The form consists of the sections of all features, so no section is named anywhere else.
    """

    FILE: ClassVar[str] = "form"

    name: str
    """Key at the top of the robot file, such as `devices`."""
    form: object
    """Type of the section's value, for pydantic, such as `dict[Name, Device]`; or a function that returns the
    type, if features add keys to it."""
    field: T
    """Field of the key with its default, as `dxlrun.description.form.key` returns it."""
    before: str = ""
    """Next key in lists of all keys; if it does not exist, this key is the last."""
    moved_joints: Callable[[object], Iterable[str]] = lambda section: ()
    """Yields the joints whose servos are in this section, which may contain mistakes. These joints get no
    keys of servos from groups and defaults."""

    def of(self, robot: object) -> T:
        """Return the section of a validated robot file."""
        section: T = getattr(robot, self.name)
        return section


class KeyedJoint(Protocol):
    """Joint of a plan, with the features' keys that the robot file sets for it."""

    @property
    def keys(self) -> Mapping[str, object]:
        """Values by key, in JSON types."""


class JointKey(msgspec.Struct, Generic[T], frozen=True):
    """Key of a joint: `STAGE` of `joint_key.py`, used before a file is read.

    Every joint can have it, and so can `groups` and `joint_defaults`. The plan of a joint has the value from
    the robot file, with numbers in SI units; `dxlrun check` and the clients of a run show it.
    """

    FILE: ClassVar[str] = "joint_key"

    name: str
    """The key, such as `tolerance`; also the name of the feature."""
    form: object
    """Type of the value in the file, for pydantic: `Position | None`."""
    field: object
    """Field of the key with its default, as `dxlrun.description.form.key` returns it."""
    value: type[T]
    """Type of the value in the plan: `float`, or a struct of msgspec for a form."""
    before: str = ""
    """Next key of a joint in lists of all keys; if it does not exist, this key is the last."""
    examples: Mapping[JointUnit, str] = {}
    """Example of a value for rotary and for linear joints; a value of the other kind is refused. Empty: the
    unit does not depend on that of the joint."""

    def of(self, joint: KeyedJoint) -> T | None:
        """Return the value of a joint in a plan; None: the robot file does not set it."""
        return msgspec.convert(joint.keys[self.name], self.value) if self.name in joint.keys else None


class KeyedServo(Protocol):
    """Servo of a robot file, with the keys of features."""

    @property
    def keys(self) -> Mapping[str, object]:
        """Values by key, as validated by the form of the key."""


class ServoKey(msgspec.Struct, Generic[T], frozen=True):
    """Key of a servo: `STAGE` of `servo_key.py`, used before a file is read.

    A joint with its own servos has the key for all of them, and each servo can have it for itself. So can
    `groups`, `joint_defaults`, and the servos in the section of a feature.
    """

    FILE: ClassVar[str] = "servo_key"

    name: str
    """The key, such as `registers`; also the name of the feature."""
    form: object
    """Type of the value in the file, for pydantic."""
    field: object
    """Field of the key in a joint with its default, as `dxlrun.description.form.key` returns it."""
    of_one: object
    """Field of the key in one of several servos of a joint. Its default is None: the value of the joint."""
    of_section: object
    """Field of the key in a servo without a joint of its own."""
    before: str = ""
    """Next key of a servo in lists of all keys; if it does not exist, this key is the last."""

    def of(self, servo: KeyedServo) -> T:
        """Return the value of a servo, which is its joint's value if the servo has none."""
        return cast("T", servo.keys[self.name])


class PolicyKey(msgspec.Struct, Generic[T], frozen=True):
    """Key of the section `policies`: `STAGE` of `policy_key.py`, used before a file is read."""

    FILE: ClassVar[str] = "policy_key"

    name: str
    """The key, such as `on_lost_servo`; also the name of the feature."""
    form: object
    """Type of the value, for pydantic: `Literal["stop", "limp"] | None`."""
    field: T
    """Field of the key with its default, as `dxlrun.description.form.key` returns it."""
    does: str = ""
    """Action of `hold`, for `dxlrun check`. With it, the value is a `WrittenPolicy`: `hold` while the run
    continues, or steps that end the run, which are checked as those of `on_exit`."""
    before: str = ""
    """Next key of the section in lists of all keys; if it does not exist, this key is the last."""
    group: PolicyKey[Any] | None = None
    """The same key of `policies.groups.NAME`; None: groups do not have it."""

    def of(self, policies: object) -> T:
        """Return the value in the validated section, or in one of its groups."""
        value: T = getattr(policies, self.name)
        return value


class Feature(msgspec.Struct, frozen=True):
    """Name of a feature, and the package with its files, or its one module."""

    name: str
    """Its key in the robot file, such as `devices`: at the top, of joints, of servos or of `policies`."""
    package: str
    """Package with its files, such as `dxlrun.features.devices`, or module with `STAGES`."""
    distribution: str = ""
    """Publisher of the plug-in with the package: `name version`. Empty for the features of dxlrun."""

    def stage(self, kind: type[S]) -> S | None:
        """Return the feature's object for one stage; None if the feature takes no part in it."""
        return _stage(self.package, kind)


_OF_PACKAGES = ("events", "process", "safe")
"""Files that guardian, processes of sensors and readers of logs import without the rest of a feature."""


@cache
def _stage(package: str, kind: type[S]) -> S | None:
    names = _files(package)
    if names is None:
        found = () if kind.FILE in _OF_PACKAGES else getattr(import_module(package), "STAGES", ())
        return next((each for each in found if isinstance(each, kind)), None)
    if kind.FILE not in names:
        return None
    module = f"{package}.{kind.FILE}"
    stage = import_module(module).STAGE
    if not isinstance(stage, kind):
        raise TypeError(f"STAGE of {module} is a {type(stage).__name__}, not a {kind.__name__}")
    return stage


@cache
def _files(package: str) -> frozenset[str] | None:
    """Return the names of the modules in a package; None for a module.

    A feature has few of the files, so one list costs less than a search for each missing file.
    """
    spec = find_spec(package)
    if spec is None:
        raise ModuleNotFoundError(f"No module named {package!r}", name=package)
    if (folders := spec.submodule_search_locations) is None:
        return None
    return frozenset(name.partition(".")[0] for folder in folders for name in os.listdir(folder))
