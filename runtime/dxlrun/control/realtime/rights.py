"""Rights: what this process may ask of the operating system, and the command that allows what it may not."""

from __future__ import annotations

import os
import sys
from pathlib import Path

IPC_LOCK, SYS_NICE = 14, 23
"""Capabilities, by their bit (linux/capability.h)."""
LIMITS = Path("/etc/security/limits.d/dxlrun.conf")
UNLIMITED = -1
_STATUS = Path("/proc/self/status")


def has_capability(bit: int, status: Path = _STATUS) -> bool:
    """Say whether this process has an effective capability; False where the system has none."""
    try:
        text = status.read_text()
    except OSError:
        return False
    masks = (line.split()[1] for line in text.splitlines() if line.startswith("CapEff:"))
    return any(int(mask, 16) >> bit & 1 for mask in masks)


def highest_priority() -> int:
    """Return the highest real-time priority that this process may take by its limit (RLIMIT_RTPRIO).

    99 with CAP_SYS_NICE. 0: none, or the system has no such limit.
    """
    import resource

    if has_capability(SYS_NICE):
        return 99
    limit = getattr(resource, "RLIMIT_RTPRIO", None)
    return 0 if limit is None else _finite(resource.getrlimit(limit)[0], 99)


def lockable_bytes() -> int:
    """Return how much memory this process may lock (RLIMIT_MEMLOCK); UNLIMITED, also with CAP_IPC_LOCK."""
    import resource

    if has_capability(IPC_LOCK):
        return UNLIMITED
    return _finite(resource.getrlimit(resource.RLIMIT_MEMLOCK)[0], UNLIMITED)


def allow(limit: str, value: int | str, who: str = "") -> str:
    """Return the command that raises a limit of a user (this one) from the next log-in on, limits.conf(5)."""
    return f"echo '{who or user()} - {limit} {value}' | sudo tee -a {LIMITS}"


def user() -> str:
    """Return this user as limits.conf(5) names one."""
    if not hasattr(os, "getuid"):
        return sys.platform
    import pwd

    number = os.getuid()
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return f"{number}:{number}"


def _finite(limit: int, unlimited: int) -> int:
    import resource

    return unlimited if limit == resource.RLIM_INFINITY else limit
