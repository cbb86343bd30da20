"""ros2_control: the controllers of a parameter file, as a fragment for a robot file.

Source: the pages of ros2_controllers (control.ros.org): `controller_manager` has `update_rate` and the type
of each controller, whose parameters are in a block of its name. Types with the same name in dxlrun are taken
over with their joints; the others are listed.
"""

from __future__ import annotations

from collections.abc import Mapping

from dxlrun.tooling.files import Conversion, FileContent, FileFormat, ImportOptions, ros_type
from dxlrun.tooling.robots import compile_texts, load_plugins
from dxlrun_import.checked_values import Step, list_at, mapping_at, number_at, text_at, valid_name, value_at
from dxlrun_import.robot_draft import commented, wrapped

_MANAGER, _PARAMETERS = "controller_manager", "ros__parameters"
_SILENT = {
    "joints",
    "joint",
    "type",
    "command_interfaces",
    "state_interfaces",
    "interface_name",
    "use_sim_time",
}
_GROUPS = {
    "position": "joint_group_position_controller",
    "velocity": "joint_group_velocity_controller",
    "effort": "joint_group_effort_controller",
}
_TAKEN = {"joint_trajectory_controller", "joint_state_broadcaster", *_GROUPS.values()}


def convert(content: FileContent, options: ImportOptions) -> Conversion:
    """Convert the controllers that dxlrun has under the same name."""
    top = _manager(content)
    remarks: list[str] = []
    lines: list[str] = []
    joints: dict[str, None] = {}
    known = load_plugins().controllers
    for name, entry in mapping_at(content, *top).items():
        if not isinstance(entry, Mapping):
            continue
        written = text_at(content, *top, name, "type")
        found = ros_type(written, known)
        ours = found[2] if found is not None else ""
        place: tuple[Step, ...] = (*top[:-2], name, _PARAMETERS)
        interface = value_at(content, *place, "interface_name") or "position"
        if "forward_command" in written.lower().replace("forwardcommand", "forward_command"):
            ours = _GROUPS.get(str(interface), "")
        if ours not in _TAKEN:
            why = f"write the keys of {ours}" if ours else "dxlrun has no such controller"
            remarks.append(f"controller {name} ({written}): {why}; docs/reference/standard-controllers.md")
            continue
        lines += [f"  {valid_name(name)}:", f"    type: {ours}"]
        if ours != "joint_state_broadcaster":
            names = [valid_name(str(one)) for one in list_at(content, *place, "joints")]
            joints |= dict.fromkeys(names)
            lines += wrapped("    joints: [", names, "]")
        given = mapping_at(content, *place) if value_at(content, *place) else {}
        for key in sorted(given.keys() - _SILENT):
            remarks.append(f"{key} of {name}: docs/reference/standard-controllers.md has the keys of {ours}")
    if not lines:
        raise content.refusal("dxlrun has none of these controllers", "write controllers of your own")
    text = "\n".join(
        [
            f"# {options.name}: imported from {content.path.name}, {FORMAT.name}.",
            f"# A robot file takes it over with `include: [{options.name}.yaml]`.",
            *(["# Not taken over:"] if remarks else []),
            *(line for remark in remarks for line in commented(f"- {remark}")),
            "loop:",
            f"  rate: {number_at(content, *top, 'update_rate', default=100.0):g}",
            "",
            "controllers:",
            *lines,
            "",
        ]
    )
    trial = [f"  {one}: {{bus: main, id: {number}, {_SERVO}}}" for number, one in enumerate(joints, 1)]
    robot = ["name: trial", _BUS, "joints:", *(trial or [f"  one: {{bus: main, id: 1, {_SERVO}}}"]), text]
    compile_texts({"robot.yaml": "\n".join(robot)}, {}, None)
    return Conversion(text, tuple(remarks))


_BUS = "buses: {main: {port: sim, protocol: 2.0, baud_rate: 4_000_000, return_delay_time: 0 us}}"
_SERVO = "model: XM430-W350, reference: 180 deg, direction: 1"


def _manager(content: FileContent) -> tuple[str, ...]:
    """Return the place of the controller manager's parameters; they may be below `/**` or a namespace."""
    tops = ((), *((key,) for key, value in content.values.items() if isinstance(value, Mapping)))
    for top in tops:
        if isinstance(value_at(content, *top, _MANAGER, _PARAMETERS), Mapping):
            return (*top, _MANAGER, _PARAMETERS)
    raise LookupError


def _matches(content: FileContent) -> bool:
    return bool(_manager(content)) if content.values else False


FORMAT = FileFormat(
    "a parameter file of ROS 2 (ros2_control)",
    _matches,
    "`dxlrun import {path} --output controllers.yaml` converts its controllers to a fragment for a robot "
    "file; docs/how-to/from-ros2-control.md has the rest",
    convert=f"{__name__}:convert",
    makes="fragment",
)
