"""Turns of continuous joints with `wrap`, for which a full turn leads to the same position."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Positions = TypeVar("Positions", "float", "NDArray[np.float64]")


def nearest_turn(position: Positions, near: Positions) -> Positions:
    """Return the equivalent of a position that is at most half a turn from `near`, rad.

    NaN if either of them is NaN. A position within half a turn is returned unchanged.
    """
    return position - math.tau * ((position - near + math.pi) // math.tau)
