"""Description: robot files and motion files, their form only; validated, frozen, with line and column."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dxlrun.description import units
    from dxlrun.description.motion import Motion
    from dxlrun.description.reading import (
        Description,
        MotionDescription,
        Survey,
        read_motion,
        read_robot,
        survey_robot,
    )
    from dxlrun.description.robot import Robot
    from dxlrun.description.source.marks import KeyPath, Marks
    from dxlrun.description.source.problems import problems_of

__all__ = [
    "Description",
    "KeyPath",
    "Marks",
    "Motion",
    "MotionDescription",
    "Robot",
    "Survey",
    "problems_of",
    "read_motion",
    "read_robot",
    "survey_robot",
    "units",
]

_HOMES = {
    "Description": "reading",
    "KeyPath": "source.marks",
    "Marks": "source.marks",
    "Motion": "motion",
    "MotionDescription": "reading",
    "Robot": "robot",
    "Survey": "reading",
    "problems_of": "source.problems",
    "read_motion": "reading",
    "read_robot": "reading",
    "survey_robot": "reading",
}


def __getattr__(name: str) -> object:
    # the loop's process needs units for parameters, but neither YAML nor the models
    if name == "units":
        return import_module("dxlrun.description.units")
    if name in _HOMES:
        return getattr(import_module(f"dxlrun.description.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
