"""A symbolic link that leads to a device wherever it is now, as udev's do."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path


class Link:
    """Points at one path after the other; never replaces anything that is not a link."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._target: str | None = None

    def point(self, target: str) -> None:
        """Lead to `target`, in one step; raises OSError when it cannot, FileExistsError for another file."""
        if os.path.lexists(self._path) and not self._path.is_symlink():
            raise FileExistsError(f"{self._path} is no link; it is not replaced")
        new = self._path.with_name(f"{self._path.name}.{os.getpid()}")
        new.symlink_to(target)
        try:
            new.replace(self._path)
        except OSError:
            new.unlink()
            raise
        self._target = target

    def remove(self) -> None:
        """Take the link away, if it still leads where it was pointed."""
        with suppress(OSError):
            if self._target is not None and os.readlink(self._path) == self._target:
                self._path.unlink()
        self._target = None
