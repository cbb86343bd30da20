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
SERVO, JOINT, AIM = (np.dtype(STRUCTS[name]) for name in ("Servo", "Joint", "Aim"))


@unique
class StepResult(IntEnum):
    """Why the compiled `motion_step_to` returned; it continues with the next call."""

    DONE = 0
    ACTION = 1  # An action is due
    STRAINED = 2  # The temperature of a servo has changed by a degree, or an overload lasts too long
    STEP = 3  # Python takes the next step: of another plant, or while shafts are turned by hand


@unique
class ShownQuantity(IntEnum):
    """Quantities that registers of a servo show."""

    POSITION = 0
    VELOCITY = 1  # rad/s
    SETPOINT = 2
    SETPOINT_VELOCITY = 3  # rad/s
    DUTY = 4  # Fraction of the supply voltage
    CURRENT = 5  # A
    MOVING = 6
    MOVING_STATUS = 7
    TEMPERATURE = 8  # degrees C
    VOLTAGE = 9  # V
    TIME = 10  # ms since the start


@unique
class Counting(IntEnum):
    """Ways in which Present Position counts turns of the shaft."""

    ENDLESS = 0
    JOINT = 1  # One turn; beyond its range the nearest end
    WHEEL = 2  # One turn, which begins again
    TURNS = 3  # 16 bits, with Multi Turn Offset and Resolution Divider


def function_address(name: str) -> int | None:
    """Return the address of a compiled function, for other compiled code."""
    return ctypes.cast(getattr(library(), f"motion_{name}"), c_void_p).value


@cache
def library() -> ctypes.PyDLL:
    """Load the compiled mechanics and declare the types of their functions.

    Raises:
        NotCompiled: They were not built, or were built from another source.
    """
    found = load_compiled(SOURCE, ctypes.PyDLL)
    for name, result, arguments in (
        ("aim", None, (c_void_p, c_int64, c_double, c_double, c_double)),
        ("angle", c_double, (c_void_p,)),
        ("check_rest", None, (c_void_p,)),
        ("drive", None, (c_void_p,)),
        ("end_step", None, (c_void_p,)),
        ("follow", c_int32, (c_void_p,)),
        ("is_moving", c_int32, (c_void_p,)),
        ("next_step", c_int64, (c_void_p,)),
        ("plan", c_int32, (c_void_p, c_int32)),
        ("position_tick", c_double, (c_void_p, c_double)),
        ("show", None, (c_void_p, c_int64, c_int32, c_int32)),
        ("step_joints", None, (*(c_void_p, c_void_p, c_int64), *(c_void_p,) * 4, c_int64, c_double)),
        ("step_to", c_int32, (c_void_p, c_int64)),
        ("take_goal", c_int32, (c_void_p, c_int64)),
        ("withdraw", None, (c_void_p, c_int64)),
    ):
        function = getattr(found, f"motion_{name}")
        function.argtypes, function.restype = arguments, result
    return found
