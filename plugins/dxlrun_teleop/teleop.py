"""`dxlrun teleop`: drives a running robot by keyboard or gamepad."""

from __future__ import annotations

import time
from contextlib import closing, suppress
from typing import Annotated

from cyclopts import Parameter

from dxlrun import InputError
from dxlrun.tooling.verbs import DebugFlag, Flag, RobotName, connect_robot, terminated_as_interrupted

Targets = Annotated[str, Parameter(name="target", show_default=False)]
"""Names of controllers, groups or joints"""


def teleop(
    *targets: Targets,
    gamepad: Flag = False,
    device: str | None = None,
    speed: float = 1.0,
    robot: RobotName = None,
    debug: DebugFlag = False,
) -> int:
    """Drive a running robot by hand, from the keyboard or a gamepad.

    The robot moves while a key, or the shoulder button of a gamepad, is held. It holds its position when the
    key is released, the gamepad is disconnected, or this program exits.

    Parameters
    ----------
    targets
        Joints, groups or controllers that the axes move, in this order. Default: all that active controllers
        move by positions, velocities, twists or trajectories.
    gamepad
        Use the connected gamepad.
    device
        Gamepad or keyboard to use, such as /dev/input/event5.
    speed
        Speed factor, 0.1 to 10.
    """
    from dxlrun.tooling.output import show_parts
    from dxlrun_teleop.bank import banks_of
    from dxlrun_teleop.drive import FACTORS, PERIOD_S, Drive
    from dxlrun_teleop.input_devices import chosen
    from dxlrun_teleop.keyboard import TerminalKeyboard
    from dxlrun_teleop.screen import screen
    from dxlrun_teleop.source import InputSource, Press

    lowest, highest = FACTORS
    if not lowest <= speed <= highest:  # also rejects NaN
        raise InputError(f"--speed {speed:g} is out of range; give a factor from {lowest:g} to {highest:g}")
    with connect_robot(robot, "teleop") as running:
        source: InputSource = chosen(device) if gamepad or device else TerminalKeyboard()
        with terminated_as_interrupted(), closing(source):
            drive = Drive(running, banks_of(running, targets, len(source.axes)), speed)
            with screen(running, drive, source) as draw, suppress(KeyboardInterrupt), closing(drive):
                while Press.QUIT not in (given := source.read_input(now := time.monotonic())).presses:
                    drive.apply_input(given, now)
                    draw(now)
                    time.sleep(max(0.0, now + PERIOD_S - time.monotonic()))
        show_parts(f"{running.name} holds")
    return 0
