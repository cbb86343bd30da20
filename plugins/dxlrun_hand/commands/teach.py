"""`dxlrun teach`: saves a motion that the user shows to a running robot by hand as a motion file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from dxlrun import InputError
from dxlrun.tooling.verbs import DebugFlag, RobotName, connect_robot

Joints = Annotated[str, Parameter(name="joint", show_default=False)]
"""Names of joints, groups or controllers."""


def teach(
    motion: Annotated[Path, Parameter(name="motion")],
    /,
    *joints: Joints,
    velocity: str = "30 deg/s",
    robot: RobotName = None,
    debug: DebugFlag = False,
) -> int:
    """Show a running robot a motion by hand, and save it as a motion file.

    The command is a dialogue. The joints become limp. Enter adds a pose, and r records a motion. Standstill
    at both ends of a motion is cut off, and trembling is smoothed. The robot plays the result with a soft
    start, at once or later with `dxlrun play MOTION.yaml`.

    Parameters
    ----------
    motion
        New motion file, whose name ends in .yaml.
    joints
        Joints that become limp, or groups or controllers for all their joints. Default: all joints for which
        an active controller plays motions.
    velocity
        Speed of the joints from one pose to the next.
    """
    from dxlrun.tooling.output import check_target
    from dxlrun.tooling.verbs import angular_velocity
    from dxlrun_hand.dialogue import Dialogue
    from dxlrun_hand.teaching import taught

    if motion.suffix not in (".yaml", ".yml"):
        raise InputError(f"{motion} does not end in .yaml; give the name of a YAML file")
    check_target(motion)
    try:
        way_speed = angular_velocity(velocity)
    except ValueError as error:
        raise InputError(f"--velocity: {error}") from None
    if way_speed <= 0:
        raise InputError(f"--velocity {velocity}: write a velocity above 0, such as 30 deg/s")
    with connect_robot(robot, "teach") as running:
        return taught(running, Dialogue("teach"), joints, motion, way_speed)
