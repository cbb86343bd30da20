"""Registry: all formats that this package knows, in the order in which a file is compared with them."""

from __future__ import annotations

from dxlrun_import.formats import (
    csv_positions,
    keyframes,
    pypot,
    pypot_move,
    roboplus,
    ros2_control,
    signatures,
    trajectory,
)

FORMATS = (
    *signatures.FIRST,
    pypot.FORMAT,
    roboplus.FORMAT,
    ros2_control.FORMAT,
    trajectory.FORMAT,
    keyframes.FORMAT,
    pypot_move.FORMAT,
    csv_positions.FORMAT,
    *signatures.LAST,
)
"""The first format whose predicate is true is the one of a file."""
