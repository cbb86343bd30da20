"""Marks: the place in the file where each key and each value stands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from dxlrun.errors import Mark

KeyPath = tuple[str | int, ...]
"""The way from the top of a document to a value: keys of mappings, indices of lists."""


@dataclass(frozen=True, slots=True)
class Marks:
    """Where everything of one file stands, and which values came from arguments."""

    file: str
    values: Mapping[KeyPath, Mark]
    keys: Mapping[KeyPath, Mark]
    origins: Mapping[KeyPath, str] = field(default_factory=dict)
    """`rate:=100` for each value in which an argument was put."""

    def value(self, *path: str | int) -> Mark:
        """Return where the value stands, or else the nearest parent that the file has."""
        return self.values.get(path) or self._parent(path)

    def key(self, *path: str | int) -> Mark:
        """Return where the key stands; a list's item has none, so its value counts; or the nearest parent."""
        return self.keys.get(path) or self.values.get(path) or self._parent(path)

    def has(self, path: KeyPath) -> bool:
        """Say whether the file has a value there."""
        return path in self.values

    def _parent(self, path: KeyPath) -> Mark:
        for end in range(len(path) - 1, -1, -1):
            mark = self.keys.get(path[:end]) or self.values.get(path[:end])
            if mark is not None:
                return mark
        return Mark(self.file)
