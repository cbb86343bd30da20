"""`dxlrun calibrate`: measures reference, direction and limits of joints by hand, for the robot file."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from dxlrun import InputError
from dxlrun.tooling.verbs import Assignment, DebugFlag, RobotPath, compiled, parse_assignments, read_models

if TYPE_CHECKING:
    from dxlrun.tooling.robots import CompiledJoint, CompiledRobot
    from dxlrun_hand.calibration import HandJoint
    from dxlrun_hand.dialogue import Dialogue
    from dxlrun_hand.lines import Opened

Joints = Annotated[tuple[str, ...], Parameter(negative=(), show_default=False, consume_multiple=True)]
"""Names of joints or groups, one or several after the option."""


def calibrate(
    robot: RobotPath, /, *assignments: Assignment, joint: Joints = (), debug: DebugFlag = False
) -> int:
    """Measure reference, direction and limits of joints by hand: for the robot file.

    The command is a dialogue. The joints become limp. You move all of them to their zero pose, and each of
    them to both of its limits. The changes of the file are shown first. All other content remains, including
    comments.

    Parameters
    ----------
    joint
        Joint or group to calibrate. Can be given several times. Default: all joints.
    """
    from dxlrun.tooling.servos import TunablePort
    from dxlrun_hand.dialogue import Dialogue

    result = compiled(robot, assignments, (), None, read_models)
    return calibrated(result, Dialogue("calibrate"), TunablePort, joint, assignments)


def calibrated(
    result: CompiledRobot,
    dialogue: Dialogue,
    opened: Opened,
    words: Sequence[str],
    assignments: Sequence[str],
) -> int:
    """Calibrate joints in a dialogue, and write the robot file after confirmation; return the exit code.

    0: written or unchanged, 1: refused by the user. An error leaves the file unchanged.

    Args:
        result: The compiled robot file.
        dialogue: Dialogue with the user.
        opened: Function that opens a serial port.
        words: Joints and groups of the command line; empty for all joints.
        assignments: Arguments of the robot file.
    """
    from dxlrun.tooling.robots import compile_robot, read_robot
    from dxlrun_hand.calibration import HandJoint, keys_of, measure_joints, replacements
    from dxlrun_hand.dialogue import ending_with, yes
    from dxlrun_hand.lines import BusLines
    from dxlrun_hand.robot_text import RobotText

    plan, robot = result.plan, Path(result.plan.source_file)
    joints = _joints(result, words, dialogue)
    text = RobotText(robot)
    for name, one in joints.items():
        for path in keys_of(name, continuous=one.plan.continuous):
            text.check_path(path)
    servos = {name: plan.servos_by_joint[name][0] for name in joints}
    ports = {bus.name: bus.port for bus, _ in servos.values()}
    with ending_with(lambda: f"{robot} is unchanged"), ExitStack() as stack:
        lines = BusLines(ports, opened)
        tools = {bus: stack.enter_context(lines.open_line(bus)) for bus in ports}
        hands = [HandJoint(tools[bus.name], bus, servo) for bus, servo in servos.values()]
        with ending_with(lambda: _limp(hands)):
            found = measure_joints(hands, dialogue)
        changes = []
        for each in found:
            written = joints[each.joint].described.limits.position
            limits = None if written is None else (float(written[0]), float(written[1]))
            changes += replacements(text, servos[each.joint][1], limits, each)
        if not changes:
            dialogue.print_lines(f"{robot} has these values already; nothing was written.")
            return 0
        for change in changes:
            text.plan_value(
                change.path, change.value if isinstance(change.value, list) else str(change.value)
            )
        dialogue.print_lines(*text.diff())
        try:
            compile_robot(read_robot(robot, parse_assignments(assignments), changes), [])
        except InputError as error:
            dialogue.print_lines("The robot file with these values has mistakes:", *error.sentences)
        if not yes(dialogue, f"Write this into {robot}?"):
            dialogue.print_lines(f"{robot} is unchanged.")
            return 1
        text.write_files()
    dialogue.print_lines(
        f"{robot} is written; the joints are limp. Check the whole file: `dxlrun check {robot}`."
    )
    return 0


def _limp(hands: Sequence[HandJoint]) -> str:
    names = ", ".join(hand.name for hand in hands if hand.limp)
    return names and f"limp now: {names}"


def _joints(result: CompiledRobot, words: Sequence[str], dialogue: Dialogue) -> dict[str, CompiledJoint]:
    """Return the joints to calibrate: of those chosen, the ones with a servo of their own.

    The user is informed about the others.

    Raises:
        InputError: No joint remains.
    """
    from dxlrun_hand.lines import chosen_names

    every = {one.plan.name: one for one in result.joints}
    names = chosen_names(words, tuple(every), result.plan.groups, result.plan.omitted)
    left = {name: every[name] for name in names if every[name].drive.own}
    if others := ", ".join(name for name in names if name not in left):
        dialogue.print_lines(f"Several servos move {others}: not calibrated; measure these joints yourself.")
    if not left:
        raise InputError("several servos move each of these joints; choose a joint with one servo")
    return left
