"""Feature: a section of the robot file with everything that belongs to it, in a folder of its own.

A feature is a package whose files have fixed names, one for each stage in which it takes part: `form.py` has
its section, `compile.py` its share of the plan, and so on. Such a file has one object `STAGE`. Its class
belongs to the room that asks for it, and documents when that happens. A feature has as many of these files as
it needs. The stage that asks for a file imports it, so `dxlrun check` imports nothing of the run.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import ClassVar, Generic, Protocol, TypeVar

T = TypeVar("T")


class Stage(Protocol):
    """Class of the object `STAGE` in one kind of file."""

    FILE: ClassVar[str]
    """Name of the module in the package of a feature."""


S = TypeVar("S", bound=Stage)


@dataclass(frozen=True)
class Section(Generic[T]):
    """Section of the robot file: `STAGE` of `form.py`, asked for before a file is read.

    The form is built of the sections of all features, so none of them is named anywhere else.
    """

    FILE: ClassVar[str] = "form"

    name: str
    """Key at the top of the robot file, such as `devices`."""
    form: object
    """Type of the section's value, for pydantic: `dict[Name, Device]`."""
    field: T
    """Field of the key, with its default, as `dxlrun.description.form.key` returns it."""
    before: str = ""
    """Key that follows it in lists of all keys; empty: it is the last."""

    def of(self, robot: object) -> T:
        """Return the section of a robot file that was read."""
        section: T = getattr(robot, self.name)
        return section


@dataclass(frozen=True)
class Feature:
    """A feature by its name and the package that has its files."""

    name: str
    """Key of its section in the robot file, such as `devices`."""
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
