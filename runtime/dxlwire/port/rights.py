"""Rights: finds the shell command that gives a user access to a port."""

from __future__ import annotations

from pathlib import Path

_SERIAL_GROUPS = frozenset({"dialout", "uucp", "plugdev"})
"""Groups that exist for access to ports. Membership in another group, such as root, grants far more than a
port."""


def serial_group(port: Path) -> str | None:
    """Return the group that owns a port if it is one for serial ports and may read and write the port;
    otherwise None."""
    try:
        group = port.group()
        return group if group in _SERIAL_GROUPS and port.stat().st_mode & 0o060 == 0o060 else None
    except (KeyError, OSError):
        return None


def command_for_access(port: Path, shown: str, user: str) -> str:
    """Return the shell command that gives a user access to a port; `shown` is the port's path for the
    user."""
    group = serial_group(port)
    if group is not None:
        return f"sudo usermod -aG {group} {user}  # then log in again"
    kernel = f"{Path(shown).name.rstrip('0123456789')}*"
    rule = f'KERNEL=="{kernel}", GROUP="dialout", MODE="0660"'
    return (
        f"echo '{rule}' | sudo tee /etc/udev/rules.d/60-dxlrun.rules && sudo usermod -aG dialout {user}"
        "  # then plug it in again and log in again"
    )
