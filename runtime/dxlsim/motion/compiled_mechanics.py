"""Compiled mechanics: structs and functions of `mechanics.c`, which the build compiles."""

from __future__ import annotations

import ctypes
from ctypes import c_double, c_int32, c_int64, c_void_p
from enum import IntEnum, unique
from functools import cache
from pathlib import Path

import numpy as np

from dxlwire.compiled import load_compiled, parse_structs

SOURCE = Path(__file__).with_name("mechanics.c")
STRUCTS = parse_structs(SOURCE.read_text())
SERVO, JOINT = (np.dtype(STRUCTS[name]) for name in ("Servo", "Joint"))


@unique
class StepResult(IntEnum):
    """Why the compiled `motion_step_to` returned; it continues with the next call."""

    DONE = 0
    ACTION = 1  # An action is due
    STRAINED = 2  # The temperature of a servo has changed by a degree, or an overload lasts too long
    STEP = 3  # Python takes the next step: of another plant, or while shafts are turned by hand


@cache
def library() -> ctypes.PyDLL:
    """Load the compiled mechanics and declare the types of their functions.

    Raises:
        NotCompiled: They were not built, or were built from another source.
    """
    found = load_compiled(SOURCE, ctypes.PyDLL)
    for name, result, arguments in (
        ("at_goal", c_int32, (c_void_p,)),
        ("check_rest", None, (c_void_p,)),
        ("drive", None, (c_void_p,)),
        ("end_step", None, (c_void_p,)),
        ("step_joints", None, (c_void_p, c_void_p, c_void_p, c_void_p, c_void_p, c_int64, c_double)),
        ("step_to", c_int32, (c_void_p, c_int64)),
        ("stribeck", None, (c_void_p, c_void_p, c_void_p, c_int64)),
    ):
        function = getattr(found, f"motion_{name}")
        function.argtypes, function.restype = arguments, result
    return found
