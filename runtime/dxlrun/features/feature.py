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
    """Class of an object `STAGE`, which a feature's module of a fixed name defines."""

    FILE: ClassVar[str]
    """Name of the module in a feature's package that holds `STAGE`, such as `form`."""


S = TypeVar("S", bound=Stage)


def type_of(form: object) -> object:
    """Return a pydantic type, which a feature may give directly or as a function that returns it."""
    return form() if isinstance(form, FunctionType) else form


class Section(msgspec.Struct, Generic[T], frozen=True):
    """A section that a feature adds to the robot file: `STAGE` of `form.py`, read before the file.

    The form consists of the sections of all features, so no section is named anywhere else.
    """

    FILE: ClassVar[str] = "form"

    name: str
    """Name of the section at the top of the robot file, such as `devices`."""
    form: object
    """Type of the section's value for pydantic, such as `dict[Name, Device]`; or a function that returns the
    type, if other features add keys to it."""
    field: T
    """Description and default of the section, as `dxlrun.description.base_form.key` returns them."""
    before: str = ""
    """Section before which this one is listed; if it does not exist, this section is the last."""
    moved_joints: Callable[[object], Iterable[str]] = lambda section: ()
    """Yields the joints that this (not yet validated) section moves. They get no servo keys from groups and
    defaults."""

    def section_of(self, robot: object) -> T:
        """Return this section's value from a validated robot file."""
        section: T = getattr(robot, self.name)
        return section


class KeyedJoint(Protocol):
    """Anything with the features' values of a joint, such as `JointPlan`."""

    @property
    def keys(self) -> Mapping[str, object]:
        """Values that the robot file sets for the joint, in JSON types, by the key's name."""


class JointKey(msgspec.Struct, Generic[T], frozen=True):
    """A key that a feature adds to joints, `groups` and `joint_defaults`: `STAGE` of `joint_key.py`.

    The plan of a joint has the value from the robot file, with numbers in SI units; `dxlrun check` and the
    clients of a run show it.
    """

    FILE: ClassVar[str] = "joint_key"

    name: str
    """Name of the key, such as `tolerance`; also the name of the feature."""
    form: object
    """Type of the value in the robot file for pydantic: `Position | None`."""
    field: object
    """Description and default of the key, as `dxlrun.description.base_form.key` returns them."""
    value: type[T]
    """Type of the value in a joint's plan: `float`, or a msgspec struct for a form."""
    before: str = ""
    """Key of joints before which this one is listed; if it does not exist, this key is the last."""
    examples: Mapping[JointUnit, str] = {}
    """Example value for rotary and for linear joints, which also fixes the unit that each accepts. Empty: the
    unit does not depend on the joint."""

    def value_of(self, joint: KeyedJoint) -> T | None:
        """Return this key's value from a joint's plan; None if the robot file does not set it."""
        return msgspec.convert(joint.keys[self.name], self.value) if self.name in joint.keys else None


class KeyedServo(Protocol):
    """Anything with the features' values of a servo, such as `DescribedServo`."""

    @property
    def keys(self) -> Mapping[str, object]:
        """Validated values by the key's name."""


class ServoKey(msgspec.Struct, Generic[T], frozen=True):
    """A key that a feature adds to servos and to joints with servos: `STAGE` of `servo_key.py`.

    A joint with its own servos has the key for all of them, and each servo can have it for itself. So can
    `groups`, `joint_defaults`, and the servos in the section of a feature.
    """

    FILE: ClassVar[str] = "servo_key"

    name: str
    """Name of the key, such as `registers`; also the name of the feature."""
    form: object
    """Type of the value in the robot file, for pydantic."""
    field: object
    """Description and default of the key in a joint, as `dxlrun.description.base_form.key` returns them."""
    of_one: object
    """Description and default of the key in one entry of a joint's `servos`. The default None means the
    joint's value."""
    of_section: object
    """Description and default of the key in a servo of a feature's section, such as `transmissions`."""
    before: str = ""
    """Key of servos before which this one is listed; if it does not exist, this key is the last."""

    def value_of(self, servo: KeyedServo) -> T:
        """Return a servo's value of this key, which is that of its joint if the servo has none."""
        return cast("T", servo.keys[self.name])


class PolicyKey(msgspec.Struct, Generic[T], frozen=True):
    """A key that a feature adds to the section `policies`: `STAGE` of `policy_key.py`."""

    FILE: ClassVar[str] = "policy_key"

    name: str
    """Name of the key, such as `on_lost_servo`; also the name of the feature."""
    form: object
    """Type of the value for pydantic: `Literal["stop", "limp"] | None`."""
    field: T
    """Description and default of the key, as `dxlrun.description.base_form.key` returns them."""
    does: str = ""
    """Text for `dxlrun check` that says what `hold` does. If set, the value is `hold`, during which the run
    continues, or steps that end the run and are checked like those of `on_exit`."""
    before: str = ""
    """Key of `policies` before which this one is listed; if it does not exist, this key is the last."""
    group: PolicyKey[Any] | None = None
    """Key of the same name in `policies.groups.NAME`; None: groups do not have it."""

    def value_of(self, policies: object) -> T:
        """Return this key's value from the validated section `policies`, or from one of its groups."""
        value: T = getattr(policies, self.name)
        return value


class SolvedPose(msgspec.Struct, frozen=True):
    """Pose of the robot file, as positions of joints."""

    positions: Mapping[str, float]
    """Positions of joints, rad or m; empty: the pose needs a joint that the run omits."""
    remark: str = ""
    """Part of the pose that the joints do not reach; empty: none."""
    figures: Mapping[str, float] = {}
    """Figures for `dxlrun check`, by the heading of their column."""
    lacking: str = ""
    """Joint that the pose needs, and that the run does not have; empty: none."""


class PoseStage(msgspec.Struct, Generic[T], frozen=True):
    """Hook `STAGE` in a feature's `pose_form.py`: a form of poses, such as the place of a link.

    A pose in the robot file, in a motion file, and in the parameters of a controller can have this form.
    """

    FILE: ClassVar[str] = "pose_form"

    name: str
    """Key that every pose in this form has as a text, such as `tip`; also the name of the feature."""
    form: type[T]
    solve: Callable[[T, str | None, Mapping[str, tuple[float, float]]], SolvedPose]
    """Returns the joints for a pose, the text of the URDF, and the limits of all joints of the run, rad or m.
    The answer may name a lacking joint. Raises `Mistakes` with keys of the pose and texts `problem; fix`."""


class Feature(msgspec.Struct, frozen=True):
    """One feature: its name and the Python package (or module) with its stages."""

    name: str
    """Name of the feature's section or key in the robot file, such as `devices`."""
    package: str
    """Python package with the feature's files, such as `dxlrun.features.devices`, or a module with
    `STAGES`."""
    distribution: str = ""
    """Plug-in package that provides the feature, `name version`; empty for features of dxlrun."""

    def stage(self, kind: type[S]) -> S | None:
        """Return the feature's object `STAGE` of a kind, importing its file; None if it has none."""
        return _stage(self.package, kind)


_OF_PACKAGES = ("events", "process", "safe")
"""Files that other processes import without the rest of the feature, so a one-module feature lacks them."""


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
    """Return the names of the modules in a Python package; None if it is a module.

    A feature has few of the files, so one list costs less than a search for each missing file.
    """
    spec = find_spec(package)
    if spec is None:
        raise ModuleNotFoundError(f"No module named {package!r}", name=package)
    if (folders := spec.submodule_search_locations) is None:
        return None
    return frozenset(name.partition(".")[0] for folder in folders for name in os.listdir(folder))
