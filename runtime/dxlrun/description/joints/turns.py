"""Turns: equivalent positions of a continuous joint with `wrap`, where a full turn changes nothing."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Positions = TypeVar("Positions", "float", "NDArray[np.float64]")


def nearest_turn(position: Positions, near: Positions) -> Positions:
    """Return a position plus or minus whole turns, such that it is at most half a turn from `near`, rad.

    NaN if either of them is NaN. A position within half a turn is returned unchanged.
    """
    return position - math.tau * ((position - near + math.pi) // math.tau)
