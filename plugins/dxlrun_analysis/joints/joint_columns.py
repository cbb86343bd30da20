"""Joint columns: fields of some cycles, joint by joint in memory, so that each joint is read without gaps."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dxlrun import Floats


class JointColumns:
    """Fields of some cycles by name, each copied once: shape (joints, cycles), or (cycles,) for a scalar."""

    def __init__(self, cycles: NDArray[np.void]) -> None:
        self._cycles = cycles
        self._copied: dict[str, NDArray[Any]] = {}
        self.times: Floats = cycles["read_ns"] * 1e-9  # s
        self.steps: Floats = np.diff(self.times)  # s between two cycles

    def __len__(self) -> int:
        """Return the number of cycles."""
        return len(self._cycles)

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return a field; it is not to be changed."""
        if name not in self._copied:
            self._copied[name] = np.ascontiguousarray(self._cycles[name].T)
        return self._copied[name]
