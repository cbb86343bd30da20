"""Description: robot files and motion files, their form only; validated, frozen, with line and column."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dxlrun.description import units
    from dxlrun.description.document import KeyPath, Marks
    from dxlrun.description.motion import Motion, MotionDescription, read_motion
    from dxlrun.description.problems import problems_of
    from dxlrun.description.reading import (
        Description,
        Replacement,
        Survey,
        read_robot,
        survey_robot,
    )
    from dxlrun.description.robot import Robot

__all__ = [
    "Description",
    "KeyPath",
    "Marks",
    "Motion",
    "MotionDescription",
    "Replacement",
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
    "KeyPath": "document",
    "Marks": "document",
    "Motion": "motion",
    "MotionDescription": "motion",
    "Replacement": "reading",
    "Robot": "robot",
    "Survey": "reading",
    "problems_of": "problems",
    "read_motion": "motion",
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
