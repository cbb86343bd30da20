"""A new file or directory that appears whole or not at all, and never in place of another one."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dxlrun.errors import InputError


def check_new(target: Path) -> None:
    """Raise InputError with what is wrong with the place of a new file or directory."""
    if os.path.lexists(target):
        raise InputError(f"{target} exists, and nothing is written over; give another name, or remove it")
    if not target.parent.is_dir():
        raise InputError(f"there is no directory {target.parent} for {target.name}; make it first")


@contextmanager
def new_target(target: Path) -> Iterator[Path]:
    """Give a path beside `target` for a file or a directory, which gets its name when all went well.

    What was made is removed where it did not. Raises InputError as check_new, and when it cannot be written.
    """
    check_new(target)
    beside = target.with_name(f".{target.name}.{os.getpid()}")
    try:
        yield beside
        check_new(target)  # it may have come meanwhile
        beside.rename(target)
    except OSError as error:
        raise InputError(f"{target} cannot be written: {error.strerror or error}") from error
    finally:
        if beside.is_dir():
            shutil.rmtree(beside, ignore_errors=True)
        else:
            beside.unlink(missing_ok=True)
