"""Rights: what gives a user a port that may not be opened."""

from __future__ import annotations

from pathlib import Path

_SERIAL_GROUPS = frozenset({"dialout", "uucp", "plugdev"})
"""Groups that exist for ports; membership in another one, such as root, gives far more than a port."""


def serial_group(port: Path) -> str | None:
    """Return the group for ports whose members may read and write this one."""
    try:
        group = port.group()
        return group if group in _SERIAL_GROUPS and port.stat().st_mode & 0o060 == 0o060 else None
    except (KeyError, OSError):
        return None


def command_for_access(port: Path, shown: str, user: str) -> str:
    """Return the command by which a user gets a port; `shown` is the port's path for the user."""
    group = serial_group(port)
    if group is not None:
        return f"sudo usermod -aG {group} {user}  # then log in again"
    kernel = f"{Path(shown).name.rstrip('0123456789')}*"
    rule = f'KERNEL=="{kernel}", GROUP="dialout", MODE="0660"'
    return (
        f"echo '{rule}' | sudo tee /etc/udev/rules.d/60-dxlrun.rules && sudo usermod -aG dialout {user}"
        "  # then plug it in again and log in again"
    )
