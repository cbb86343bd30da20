"""Numbers of a difference as text that keeps their bits."""

from __future__ import annotations

import numpy as np


def shown_bits(bits: int) -> str:
    """Return a float64 as text from which its bits can be read again; a bare `nan` would hide its payload."""
    value = float(np.uint64(bits).view(np.float64))
    return repr(value) if np.isfinite(value) else f"{value} (bits {bits:#018x})"
