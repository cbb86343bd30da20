"""The program `dxlrun-ros2`, where the versions fit."""

from __future__ import annotations

import sys

from dxlrun_ros2.versions import other_version


def main() -> int:
    """Run the bridge; return 2 where dxlrun has another version."""
    if (wrong := other_version()) is not None:
        print(f"dxlrun-ros2: {wrong}", file=sys.stderr)
        return 2
    from dxlrun_ros2.command import main as bridge  # not above: another dxlrun may not have what it imports

    return bridge()
