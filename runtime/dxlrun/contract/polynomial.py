"""Polynomial: pieces of trajectories, evaluated with their derivatives in C."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from ctypes import c_double, c_void_p
from functools import cache
from pathlib import Path

import numpy as np

from dxlrun.channels.cycle import Floats
from dxlwire.compiled import load_compiled, parse_structs

SOURCE = Path(__file__).with_name("polynomial.c")


@cache
def _library() -> tuple[type[ctypes.Structure], Callable[[int, float], None]]:
    evaluate = load_compiled(SOURCE, ctypes.PyDLL).evaluate_pieces
    evaluate.argtypes, evaluate.restype = (c_void_p, c_double), None
    return parse_structs(SOURCE.read_text())["Pieces"], evaluate


class Polynomial:
    """A polynomial of the time for each of some joints, such as a piece of a trajectory.

    A controller evaluates it in each cycle: one call, whatever the order and the number of joints.

    Args:
        order: Highest number of coefficients: 6 for a quintic.
        joints: Number of joints.

    Raises:
        NotCompiled: The compiled part is missing.
    """

    def __init__(self, order: int, joints: int) -> None:
        self._coefficients, self._values = np.zeros((order, joints)), np.zeros((3, joints))
        pieces, self._evaluate = _library()
        self._pieces = pieces(self._coefficients.ctypes.data, self._values.ctypes.data, order, joints)
        self._address = ctypes.addressof(self._pieces)

    def set_piece(self, coefficients: Floats) -> None:
        """Copy coefficients of ascending powers, shape (order, joints), with any order up to the highest."""
        order = len(coefficients)
        np.copyto(self._coefficients[:order], coefficients)
        self._pieces.order = order

    def evaluate(self, t: float) -> Floats:
        """Return position, velocity and acceleration at a time, shape (3, joints).

        The next call overwrites the array.
        """
        self._evaluate(self._address, t)
        return self._values
