"""Registry: all formats that this package knows, in the order in which a file is compared with them."""

from __future__ import annotations

from dxlrun_import.formats import (
    csv_positions,
    interbotix,
    keyframes,
    lerobot_calibration,
    pypot,
    pypot_move,
    roboplus,
    robotis_robot,
    ros2_control,
    ros2_controllers,
    rplus_motion,
    signatures,
    trajectory,
    workbench,
)

FORMATS = (
    *signatures.FIRST,
    pypot.FORMAT,
    roboplus.FORMAT,
    rplus_motion.FORMAT,
    ros2_control.FORMAT,
    lerobot_calibration.FORMAT,
    interbotix.FORMAT,
    robotis_robot.FORMAT,
    workbench.FORMAT,
    workbench.INIT,
    workbench.MOTION,
    ros2_controllers.FORMAT,
    trajectory.FORMAT,
    keyframes.FORMAT,
    pypot_move.FORMAT,
    csv_positions.FORMAT,
    *signatures.LAST,
)
"""The first format whose predicate is true is the one of a file."""
