"""Joint columns: fields of some cycles, joint by joint in memory, so that each joint is read without gaps."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dxlrun import Floats


class JointColumns:
    """Fields of some cycles by name, each copied once: shape (joints, cycles), or (cycles,) for a scalar."""

    def __init__(self, *parts: NDArray[np.void]) -> None:
        """Join consecutive cycles."""
        self._parts = parts
        self._copied: dict[str, NDArray[Any]] = {}
        self.times: Floats = self["read_ns"] * 1e-9  # s
        self.steps: Floats = np.diff(self.times)  # s between two cycles

    def __len__(self) -> int:
        """Return the number of cycles."""
        return len(self.times)

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return a field; it is not to be changed."""
        if name not in self._copied:
            columns = [part[name].T for part in self._parts]
            shape = (*columns[0].shape[:-1], sum(column.shape[-1] for column in columns))
            self._copied[name] = np.concatenate(columns, axis=-1, out=np.empty(shape, columns[0].dtype))
        return self._copied[name]
