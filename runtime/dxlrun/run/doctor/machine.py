"""Machine: what the doctor reads, from the files under `/` and from the limits of this process."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from dxlrun.control.realtime.rights import (
    IPC_LOCK,
    SYS_NICE,
    UNLIMITED,
    has_capability,
    highest_priority,
    lockable_bytes,
    user,
)
from dxlrun.dynamixel.exchange import kernel

NEEDED = ("memfd_create", "pidfd_open", "sched_setscheduler")
"""Calls of `os` without which no run starts; Linux has them all since 5.3."""

_CAPABILITIES = {SYS_NICE: "CAP_SYS_NICE", IPC_LOCK: "CAP_IPC_LOCK"}


def _open_to_us(path: Path) -> bool:
    return os.access(path, os.R_OK | os.W_OK)


def may_schedule() -> bool:
    """Say whether the kernel really gives a real-time policy: a container's group may have no share of it.

    Takes it for a moment, and gives it back.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    except (AttributeError, OSError):
        return False
    return True


@dataclass(frozen=True, slots=True, kw_only=True)
class Machine:
    """One machine, and the user who asks; the tests make up others."""

    platform: str = sys.platform
    root: Path = Path("/")
    missing_calls: tuple[str, ...] = ()
    user: str = "nobody"
    cores: int = 1
    """On which this process may run."""
    capabilities: tuple[str, ...] = ()
    """Those that matter here: CAP_SYS_NICE, CAP_IPC_LOCK."""
    highest_priority: int = 0
    """99 with the capability; 0: none."""
    lockable: int = 0
    """Bytes; UNLIMITED with the capability."""
    compiled: bool = True
    """dxlrun was installed with the compiled part of its exchange with servos."""
    may_schedule: Callable[[], bool] = field(default=may_schedule)
    may_write: Callable[[Path], bool] = field(default=_open_to_us)

    @classmethod
    def this(cls) -> Machine:
        """Return the machine on which we run; never raises."""
        missing = tuple(name for name in NEEDED if not hasattr(os, name))
        if missing or not sys.platform.startswith("linux"):
            return cls(missing_calls=missing)
        return cls(
            user=user(),
            cores=len(os.sched_getaffinity(0)),
            capabilities=tuple(name for bit, name in _CAPABILITIES.items() if has_capability(bit)),
            highest_priority=highest_priority(),
            lockable=lockable_bytes(),
            compiled=kernel.load() is not None,
        )

    @property
    def locks_all(self) -> bool:
        """True where all memory of a process may be locked."""
        return self.lockable == UNLIMITED

    @property
    def container(self) -> bool:
        """True where the rights come from whoever started a container."""
        return any((self.root / name).exists() for name in (".dockerenv", "run/.containerenv"))

    def read(self, path: str) -> str | None:
        """Return the text of a file under the root, stripped; None when it cannot be read."""
        try:
            return (self.root / path).read_text(errors="replace").strip()
        except OSError:
            return None

    def glob(self, pattern: str) -> list[Path]:
        """Return what there is of a pattern under the root, in order."""
        return sorted(self.root.glob(pattern))
