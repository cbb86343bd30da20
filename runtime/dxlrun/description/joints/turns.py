"""Turns of continuous joints to which a turn more is the same place."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Positions = TypeVar("Positions", "float", "NDArray[np.float64]")


def nearest_turn(position: Positions, near: Positions) -> Positions:
    """Return the equivalent of a position that is at most half a turn from `near`, rad.

    NaN where one of the two is. A position that is near enough is returned as it is.
    """
    return position - math.tau * ((position - near + math.pi) // math.tau)
