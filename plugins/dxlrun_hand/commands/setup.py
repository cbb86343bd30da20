"""`dxlrun setup`: configures new servos with the IDs, baud rates and registers of a robot file."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

from dxlrun import InputError
from dxlrun.tooling.verbs import Assignment, DebugFlag, Flag, RobotPath, known_file, parse_assignments
from dxlrun_hand.commands.calibrate import Joints

if TYPE_CHECKING:
    from dxlrun_hand.lines import Devices, Opened
    from dxlrun_hand.servo_setup import ServoSetup
    from dxlwire import BusPlan


def setup(
    robot: RobotPath,
    /,
    *assignments: Assignment,
    joint: Joints = (),
    find_port: Flag = False,
    debug: DebugFlag = False,
) -> int:
    """Write IDs, baud rates and registers of a robot file to new servos.

    The command is a dialogue. You connect each servo alone, and its settings are written. At the end you
    connect all servos, which are read back and compared with the file. If a port does not exist, the dialogue
    finds it while you unplug and plug in its adapter.

    Parameters
    ----------
    joint
        Joint or group to set up. Can be given several times. Default: all joints.
    find_port
        Find the port of each bus by unplugging its adapter, even if the port in the file exists.
    """
    from dxlrun.tooling.robots import load_plugins, read_robot
    from dxlrun.tooling.servos import TunablePort
    from dxlrun_hand.dialogue import Dialogue
    from dxlrun_hand.servo_setup import ServoSetup
    from dxlwire import serial_devices

    known_file(robot)
    load_plugins()  # they can add servo models
    task = ServoSetup(read_robot(robot, parse_assignments(assignments)), Dialogue("setup"))
    return set_up(task, TunablePort, serial_devices, joint, search=find_port)


def set_up(
    task: ServoSetup, opened: Opened, devices: Devices, words: Sequence[str] = (), *, search: bool = False
) -> int:
    """Set up the chosen servos of a robot file in a dialogue, and compare all of them with the file.

    Args:
        task: Dialogue and robot file.
        opened: Function that opens a serial port.
        devices: Function that returns the available serial ports.
        words: Joints and groups of the command line; empty for all.
        search: Find each bus's port by unplugging its adapter, even if the port in the file exists.

    Returns:
        Exit code: 0 if all chosen servos match the file, else 1.

    Raises:
        InputError: A word is unknown, or a file cannot be written.
        PortError: A port cannot be opened or found.
    """
    from dxlrun_hand.dialogue import ending_with
    from dxlrun_hand.lines import BusLines, chosen_names

    servos = [servo.own_name for plan in task.plans for servo in plan.servos]
    # Names of joints and transmissions.
    moved = tuple(dict.fromkeys(name.partition("/")[0] for name in servos))
    names = chosen_names(words, moved, task.description.groups, task.description.omitted)
    chosen = [name for name in servos if name.partition("/")[0] in names]
    ports = {}
    with ending_with(lambda: _left(task)):
        for plan in task.plans:
            if any(servo.own_name in chosen for servo in plan.servos):
                ports[plan.name] = _port(task, plan, devices, search=search)
        lines = BusLines(ports, opened)
        task.connect_each(lines, chosen)
        equal = task.compare_all(lines, chosen)
    return 0 if equal else 1


def _left(task: ServoSetup) -> str:
    """Return a sentence for an early end of the dialogue: servos that were set up, and one half-changed."""
    done = f"set up: {', '.join(task.done)}" if task.done else "no servo was set up"
    if not task.changing:
        return f"{done}; no other servo was changed" if task.done else "no servo was changed"
    return f"{done}; the servo of {task.changing} may have its new ID or rate already; set it up again"


def _port(task: ServoSetup, plan: BusPlan, devices: Devices, *, search: bool) -> str:
    """Return the port of a bus: the one in the robot file if it exists, else the one that the user plugs in.
    The new port is written to the robot file after confirmation. `search` skips the port in the file."""
    from dxlrun.tooling.robots import SIMULATED
    from dxlrun_hand.dialogue import yes
    from dxlrun_hand.lines import find_port
    from dxlrun_hand.robot_text import RobotText

    robot, dialogue = task.description.path, task.dialogue
    if not search:
        if plan.port == SIMULATED or os.path.exists(plan.port) or plan.port in devices():
            return plan.port
        dialogue.print_lines(f"Bus {plan.name}: port {plan.port} not found.")
    found = find_port(plan.name, dialogue, devices)
    text = RobotText(robot)
    try:
        text.plan_value(("buses", plan.name, "port"), found)
    except InputError:  # The port comes from an argument
        dialogue.print_lines(f"{robot} is unchanged; give other commands this port as an argument: {found}")
        return found
    dialogue.print_lines(*text.diff())
    if yes(dialogue, f"Write this into {robot}?"):
        text.write_files()
    return found
