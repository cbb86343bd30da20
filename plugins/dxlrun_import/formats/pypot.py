"""pypot: the JSON configuration of a robot.

Source: pypot's documentation ("Configuration file") and what its code does with a file: positions are degrees
from the middle of a servo's travel. Goal of the servo = direction * (joint position + offset). `angle_limit`
is written to the servos as it is, so it counts for the servo, before offset and orientation.
"""

from __future__ import annotations

from collections.abc import Iterator

from dxlrun.tooling.files import Conversion, FileContent, FileFormat, ImportOptions
from dxlrun_import.checked_values import (
    list_at,
    mapping_at,
    number_at,
    text_at,
    valid_name,
    value_at,
    whole_at,
)
from dxlrun_import.robot_draft import DraftBus, JointDraft, RobotDraft, middle

BAUD_RATE = 1_000_000  # of pypot's DxlIO; the files do not name it
_SIGNS = {"direct": 1, "indirect": -1}
_USED = {"id", "type", "offset", "angle_limit", "orientation", "wheel_mode", "broken"}


def convert(content: FileContent, options: ImportOptions) -> Conversion:
    """Convert a configuration: controllers are buses, motors are joints, motorgroups are groups."""
    draft = RobotDraft(content, FORMAT.name, options.name)
    motors = mapping_at(content, "motors")
    lines = mapping_at(content, "controllers")
    attached: dict[str, str] = {}
    for line in lines:
        bus = "main" if len(lines) == 1 else valid_name(line)
        protocol = number_at(content, "controllers", line, "protocol", default=1.0)
        port = text_at(content, "controllers", line, "port", default="auto")
        draft.buses[bus] = DraftBus(
            protocol,
            BAUD_RATE,
            "" if port == "auto" else port,
            comment="guessed: baud_rate, pypot's default",
            return_delay_us=0,
        )
        for index, name in enumerate(list_at(content, "controllers", line, "attached_motors")):
            for motor in _members(content, str(name), ("controllers", line, "attached_motors", index)):
                attached[motor] = bus
    for motor in motors:
        if motor not in attached:
            draft.remarks.append(f"motor {motor}: no controller of the file has it attached")
            continue
        draft.add_joint(_joint(content, motor, attached[motor], draft))
    for group in mapping_at(content, "motorgroups"):
        joints = dict.fromkeys(_members(content, group, ("motorgroups", group)))
        names = [name for name in map(valid_name, joints) if name in draft.joints]
        # `all` is every joint in a robot file anyway.
        if names and valid_name(group) not in {"all", *draft.joints}:
            draft.groups[valid_name(group)] = names
    for key in content.values.keys() - {"controllers", "motorgroups", "motors"}:
        draft.remarks.append(f"{key}: sensors and primitives of pypot have no equivalent in the file")
    return draft.conversion()


def _joint(content: FileContent, motor: str, bus: str, draft: RobotDraft) -> JointDraft:
    at = ("motors", motor)
    orientation = text_at(content, *at, "orientation")
    if orientation not in _SIGNS:
        raise content.refusal(
            f"orientation of {motor} is {orientation!r}", "write direct or indirect", *at, "orientation"
        )
    sign, offset = _SIGNS[orientation], number_at(content, *at, "offset")
    low, high = (number_at(content, *at, "angle_limit", index, default=0.0) for index in (0, 1))
    wheel = value_at(content, *at, "wheel_mode") is True or low == high == 0
    if not wheel and max(abs(low), abs(high)) <= 3.2 and abs(offset) <= 3.2:
        draft.remarks.append(f"angle_limit of {motor} is read in degrees, and looks like radians; check it")
    limits = sorted((sign * low - offset, sign * high - offset))
    others = sorted(mapping_at(content, *at).keys() - _USED)
    draft.remarks += [f"{key} of motor {motor}: has no equivalent" for key in others]
    if value_at(content, *at, "broken") is True:
        draft.remarks.append(f"motor {motor} is marked as broken, and is a joint like the others here")
    model = text_at(content, *at, "type")
    joint = JointDraft(
        motor,
        whole_at(content, *at, "id"),
        content.mark(*at),
        model,
        direction=sign,
        limits=(limits[0], limits[1]),
        bus=bus,
        continuous=wheel,
        comment=f"pypot: offset {offset:g}, {orientation}, angle_limit {low:g} to {high:g}",
    )
    table = draft.control_table(joint)
    if table is None:
        raise content.refusal(f"type of {motor} is {model!r}", "write the model of the servo", *at, "type")
    return joint._replace(reference=middle(table) + sign * offset)


def _members(content: FileContent, name: str, place: tuple[str | int, ...], levels: int = 8) -> Iterator[str]:
    """Yield the motors of a group, whose members may be groups, or the motor itself."""
    groups = mapping_at(content, "motorgroups")
    if name not in groups:
        if name not in mapping_at(content, "motors"):
            raise content.refusal(f"{name} is neither a motor nor a group of the file", "define it", *place)
        yield name
        return
    if not levels:
        raise content.refusal(f"group {name} contains itself", "remove it from its members", *place)
    for index, member in enumerate(list_at(content, "motorgroups", name)):
        yield from _members(content, str(member), ("motorgroups", name, index), levels - 1)


def _matches(content: FileContent) -> bool:
    return {"motorgroups", "motors"} <= content.values.keys()


FORMAT = FileFormat("a configuration of pypot", _matches, convert=f"{__name__}:convert")
