"""Entry point of `dxlrun-ros2`. It checks that the versions of dxlrun and this package match."""

from __future__ import annotations

import sys

from dxlrun_ros2.bridge_version import other_version


def main() -> int:
    """Run the bridge, and return its exit code; print an error and return 2 if dxlrun has another version."""
    if (wrong := other_version()) is not None:
        print(f"dxlrun-ros2: {wrong}", file=sys.stderr)
        return 2
    # This import must follow the check, because it fails with another version of dxlrun.
    from dxlrun_ros2.bridge_command import main as bridge

    return bridge()
