"""Target: writes files and directories that a user names, completely or not at all.

A target appears completely or not at all. It never replaces a directory, a pipe, a device, or a file that
dxlrun did not write.
"""

from __future__ import annotations

import errno
import os
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from mmap import ACCESS_READ, mmap
from pathlib import Path

from dxlrun.errors import InputError

_FLAGS = os.O_WRONLY | os.O_CREAT | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0)


def unwritable(target: Path, reason: OSError | str) -> InputError:
    """Return the InputError that a target cannot be written, with the reason."""
    text = reason if isinstance(reason, str) else reason.strerror or str(reason)
    return InputError(f"{target} cannot be written ({text}); choose another name")


def make_folder_of(target: Path) -> None:
    """Create the directory in which a target will be. Raises InputError on failure."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise unwritable(target, f"{target.parent} is not a directory") from None
    except OSError as error:
        raise unwritable(target, error) from error


def check_target(target: Path, replaces: str | None = None) -> None:
    """Check, before any work is done for it, that a file or directory can be written.

    An empty file may always be replaced.

    Args:
        target: The file or directory that the user named.
        replaces: A text in every older file of this kind, which may be replaced. None: no file is replaced.

    Raises:
        InputError: The target cannot be written.
    """
    try:
        status = target.stat()
    except OSError as error:
        if os.path.lexists(target):
            raise unwritable(target, "it is a broken link") from None
        folder = target.parent
        if not isinstance(error, FileNotFoundError):
            raise unwritable(target, error) from None
        if not folder.is_dir():
            raise unwritable(target, f"directory {folder} not found") from None
        if not os.access(folder, os.W_OK | os.X_OK):
            raise unwritable(target, f"the directory {folder} is read-only") from None
        return
    if not stat.S_ISREG(status.st_mode):
        kind = "a directory" if stat.S_ISDIR(status.st_mode) else "not a regular file"
        raise unwritable(target, f"it exists and is {kind}")
    if not os.access(target, os.W_OK):
        raise unwritable(target, "it is read-only")
    if status.st_size and not (replaces and _contains(target, replaces.encode())):
        raise unwritable(
            target, "it exists" if replaces is None else "it exists and was not written by dxlrun"
        )


@contextmanager
def new_target(target: Path, replaces: str | None = None) -> Iterator[Path]:
    """Context manager with a temporary path next to the target, which is renamed to it on success.

    On failure, the file or directory is removed.

    Args:
        target: The file or directory that the user named.
        replaces: As of `check_target`.

    Raises:
        InputError: The target cannot be written.
    """
    check_target(target, replaces)
    # A link to a replaced file remains a link.
    place = target.resolve()
    beside = place.with_name(f".{place.name}.{os.getpid()}")
    try:
        yield beside
        # The user may have created one in the meantime of the work.
        check_target(target, replaces)
        if target.is_file():
            shutil.copymode(place, beside)
        beside.rename(place)
    except OSError as error:
        raise unwritable(target, error) from error
    finally:
        if beside.is_dir():
            shutil.rmtree(beside, ignore_errors=True)
        else:
            beside.unlink(missing_ok=True)


def write_target(target: Path, content: str | bytes, replaces: str | None = None) -> None:
    """Write a file that the user named, completely or not at all.

    Args:
        target: The file that the user named.
        content: Its content; a text is written as UTF-8.
        replaces: As of `check_target`.

    Raises:
        InputError: The file cannot be written.
    """
    with new_target(target, replaces) as beside:
        beside.write_bytes(content.encode() if isinstance(content, str) else content)


def open_empty(path: str | Path, mode: int) -> int:
    """Open a file for writing that is read while it grows, such as a log; it must be new or empty.

    Args:
        path: The file.
        mode: Permissions of a new file.

    Returns:
        A file descriptor for writing.

    Raises:
        OSError: It cannot be opened, has content, or is a pipe.
    """
    descriptor = os.open(path, _FLAGS, mode)
    if os.fstat(descriptor).st_size:
        os.close(descriptor)
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
    return descriptor


def _contains(path: Path, text: bytes) -> bool:
    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as data:
        return data.find(text) >= 0
