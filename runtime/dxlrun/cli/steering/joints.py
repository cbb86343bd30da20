"""`dxlrun torque`, `reboot`, `get` and `set`: the joints of a running robot and their servos."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from dxlrun.cli.inputs import Flag, pose_text
from dxlrun.cli.steering.steer import ONLY_ONE, RobotChoice, connect_robot, report_done
from dxlrun.errors import InputError
from dxlrun.output.quantity import quantity_text
from dxlrun.output.terminal import show_json, show_parts
from dxlrun.output.text_table import Table
from dxlwire.joint_unit import JointUnit

if TYPE_CHECKING:
    from dxlrun.remote.client import Executed, RemoteRobot

Joints = Annotated[str, Parameter(name="joint", show_default=False)]
"""Words of the command line: names of joints, groups, controllers, or `all`."""
DEGREES = 180 / math.pi
_WRITTEN: Mapping[str, tuple[float, int, str]] = MappingProxyType(
    {
        "deg": (DEGREES, 1, "deg"),
        "deg/s": (DEGREES, 1, "deg/s"),
        "mm": (1e3, 2, "mm"),
        "mm/s": (1e3, 1, "mm/s"),
        "ms": (1e3, 1, "ms"),
        "deg C": (1.0, 0, "deg C"),
        "V": (1.0, 1, "V"),
        "": (100.0, 0, "%"),
    }
)
"""Unit in SI -> factor, digits and unit in the output; `deg` and `mm` values come in rad and m."""


def torque(
    state: Literal["on", "off"], /, *joints: Joints, release: Flag = False, chosen: RobotChoice = ONLY_ONE
) -> int:
    """Enable or disable the torque of joints of a running robot: `dxlrun torque off elbow_joint`.

    With `off`, the joint becomes limp, and remains limp whatever the policies are. With `on`, the servo is
    checked as at the start of a run, and the joint holds its position. A controller that commands the joint
    continues from there. The command returns when the torque state has been read back.

    Parameters
    ----------
    state
        New torque state.
    joints
        Joints, or groups or controllers for all their joints. `all` selects every joint.
    release
        Deactivate the controllers that command the joints. Without this option, `off` is refused if there are
        any.
    """
    names = _named(joints)
    with connect_robot(chosen.robot, f"torque {state}") as robot:
        done = robot.torque(names, state == "on", release=release)
        verb = "has torque" if state == "on" else "is limp"
        return report_done(robot, chosen, done, f"{robot.name}: {', '.join(names)} {verb}{_others(done)}")


def reboot(*joints: Joints, release: Flag = False, chosen: RobotChoice = ONLY_ONE) -> int:
    """Reboot servos of a running robot to clear a hardware error: `dxlrun reboot elbow_joint`.

    Only servos with Protocol 2.0 can be rebooted. The command returns when they are operational again. Torque
    is enabled again if it was enabled before.

    Parameters
    ----------
    joints
        Joints, or groups or controllers for all their joints. `all` selects every joint.
    release
        Deactivate the controllers that command the joints. Without this option, the reboot is refused if
        there are any.
    """
    names = _named(joints)
    with connect_robot(chosen.robot, "reboot") as robot:
        done = robot.reboot(names, release=release)
        text = f"{', '.join(names)} rebooted and ready again{_others(done)}"
        return report_done(robot, chosen, done, f"{robot.name}: {text}")


def show_joint(joint: str, item: str = "", /, *, chosen: RobotChoice = ONLY_ONE) -> int:
    """Print the state of a joint, or an item of its servo's control table.

    For a group, a controller or `all`, the pose is printed in the notation of `dxlrun send`. For a device or
    a sensor, all states are printed, or one of them: `dxlrun get imu/orientation.x`. For a device, commanded
    values are printed as well: `dxlrun get board/led`.

    Parameters
    ----------
    joint
        Name of a joint, group, controller, device or sensor. For an item of one of several servos of a joint,
        name of that servo, such as hip/1.
    item
        Control table item in RAM or EEPROM, such as position_p_gain. `dxlrun models` lists the items.
    """
    with connect_robot(chosen.robot, "get") as robot:
        if not item and (names := _meant(robot.info(), joint)):
            return _show_pose(robot, names, chosen)
        found = robot.get(joint, item)
        if chosen.as_json:
            show_json({"robot": robot.name, **found})
        elif item:
            meaning = f" ({found['is']})" if found["is"] else ""
            show_parts(f"{robot.name}: {found['title']} of {joint} is {found['value']}{meaning}")
        elif "source" in found:
            show_parts(f"{robot.name}: {joint}", Table.facts("", source_facts(found)))
        else:
            show_parts(f"{robot.name}: {joint}", Table.facts("", facts(found)))
    return 0


def _meant(info: Mapping[str, Any], name: str) -> Sequence[str]:
    """Return the joints that a group, a controller or `all` stands for; empty for a joint or an unknown
    name.
    """
    controllers = {one["name"]: one["joints"] for one in info["controllers"]}
    known = {**controllers, **info["groups"], "all": info["joints"]}
    return () if name in info["joints"] else known.get(name, ())


def _show_pose(robot: RemoteRobot, names: Sequence[str], chosen: RobotChoice) -> int:
    """Print the present positions of joints as words for `send`, without joints that were never read;
    return 0.
    """
    states = robot.states()
    ways = {name: JointUnit(unit).shown for name, unit in zip(states.joints, states.units, strict=True)}
    found = {name: states.joint(name)["position"] for name in names}
    pose = {name: position for name, position in found.items() if position is not None}
    if chosen.as_json:
        show_json({"robot": robot.name, "pose": pose})
    else:
        show_parts(pose_text({name: format_number(position, ways[name]) for name, position in pose.items()}))
    return 0


def set_register(joint: str, item: str, value: str, /, *, chosen: RobotChoice = ONLY_ONE) -> int:
    """Write a register of a servo while the robot runs: `dxlrun set elbow_joint position_p_gain 900`.

    Only items in RAM that no controller commands can be written. The command returns when the servo has the
    value.

    Parameters
    ----------
    joint
        Name of the joint for all its servos, or of one servo, such as hip/1.
    item
        Control table item. `dxlrun models` lists the items.
    value
        Integer as in the e-Manual, or quantity with a unit, such as '10 rad/s^2'.
    """
    from dxlrun.description.document import plain_value

    number = plain_value(value)
    given = number if isinstance(number, int) and not isinstance(number, bool) else value
    with connect_robot(chosen.robot, "set") as robot:
        done = robot.set_register(joint, item, given)
        before = "" if done.old is None else f"{done.old} -> "
        meaning = "" if given == done.value else f" ({given})"
        return report_done(
            robot, chosen, done, f"{robot.name}: {item} of {joint} is {before}{done.value}{meaning}"
        )


def source_facts(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return names and texts of a source's states, of their age, and of the commanded values, for a table."""
    states, commands = (
        [(name, quantity_text(value, units.get(name, ""))) for name, value in values.items()]
        for values, units in (
            (found["states"], found.get("units", {})),
            (found["commands"], found.get("command_units", {})),
        )
    )
    age = format_number(found["age"], "ms") or "no states yet"
    of_states = [*states, ("age", age if found["valid"] else f"{age}, not valid")] if states else []
    return [*of_states, *((f"{name}, commanded", value) for name, value in commands)]


def facts(state: Mapping[str, object]) -> list[tuple[str, str]]:
    """Return names and texts of a joint's state, for a table; unknown values are omitted."""
    unit = state["effort_unit"]
    way = JointUnit(str(state["unit"])).shown
    found = [
        ("position", format_number(state["position"], way)),
        ("velocity", format_number(state["velocity"], f"{way}/s")),
        ("effort", format_number(state["effort"], unit)),
        ("goal position", format_number(state["goal_position"], way)),
        ("goal velocity", format_number(state["goal_velocity"], f"{way}/s")),
        ("goal effort", format_number(state["goal_effort"], unit)),
        ("goal pwm", format_number(state["goal_pwm"], "")),
        ("temperature", format_number(state["temperature"], "deg C")),
        ("voltage", format_number(state["voltage"], "V")),
        ("torque", str(state["torque"])),
        ("mode", str(state["mode"]).replace("_", " ")),
        ("hardware error", f"{state['hardware_error']:#04x}" if state["hardware_error"] else ""),
        ("age", format_number(state["age"], "ms")),
    ]
    return [(name, text) for name, text in found if text]


def format_number(value: object, unit: object) -> str:
    """Return an SI number as text in the unit for people; empty when it is None.

    Unit "" is a fraction, shown in %.
    """
    if not isinstance(value, int | float):
        return ""
    factor, digits, shown = _WRITTEN.get(str(unit), (1.0, 3, str(unit)))
    return f"{value * factor:.{digits}f} {shown}"


def _others(done: Executed) -> str:
    """Return clauses for the result: controllers that were deactivated, and the command that activates
    them again.
    """
    found = f"; deactivated {', '.join(done.deactivated)}" if done.deactivated else ""
    back = f"; activate {', '.join(done.offered)} again: `dxlrun switch --activate {' '.join(done.offered)}`"
    return found + (back if done.offered else "")


def _named(joints: Sequence[str]) -> Sequence[str]:
    if not joints:
        raise InputError(
            "the command needs joints; name joints, groups, controllers (for their joints), or all"
        )
    return joints
