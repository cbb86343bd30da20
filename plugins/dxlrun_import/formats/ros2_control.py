"""URDF with ros2_control: the servos of a `ros2_control` block, with names and limits of the URDF.

Source: README of ROBOTIS' dynamixel_hardware_interface 1.5: a `gpio` is a servo with its ID and registers, in
the order of the joints unless a transmission matrix says otherwise; 0 is the middle of a servo's travel.
dynamixel_hardware of dynamixel-community has a parameter `id` of the joint. Limits of a URDF are rad, rad/s.
"""

from __future__ import annotations

import math
import os
from contextlib import suppress
from typing import TYPE_CHECKING

from dxlrun.tooling.files import Conversion, FileContent, FileFormat, ImportOptions
from dxlrun_import.checked_values import refused, valid_name
from dxlrun_import.robot_draft import DraftBus, JointDraft, RobotDraft

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

_GAINS = {"Position P Gain", "Position I Gain", "Position D Gain"}
_SILENT = {"ID", "id", "type", "Operating Mode", "Return Delay Time", "Torque Enable", "Baud Rate"} | _GAINS
_SILENT |= {"Min Position Limit", "Max Position Limit"}
_REVERSED = 1  # bit of Drive Mode
_MIDDLE_TICKS, _TICK_DEG = 2048, 360 / 4096


def convert(content: FileContent, options: ImportOptions) -> Conversion:
    """Convert each `ros2_control` block to a bus, and its joints with an ID to joints."""
    draft = RobotDraft(content, FORMAT.name, options.name)
    blocks = [block for block in content.xml.iter("ros2_control") if _servos(block)]
    unused: dict[str, list[str]] = {}
    for block in blocks:
        bus = "main" if len(blocks) == 1 else valid_name(block.get("name", "bus"))
        hardware = _params(block.find("hardware"))
        baud = _number(content, block, hardware.get("baud_rate", "1000000"), "baud_rate")
        port = hardware.get("port_name") or hardware.get("usb_port", "")
        delays = [_params(servo).get("Return Delay Time") for _, servo in _servos(block)]
        delay = None if None in delays else max(2 * float(str(one)) for one in delays)
        draft.buses[bus] = DraftBus(2.0, int(baud), port, "guessed: protocol", delay)
        factors = _factors(content, block, len(_servos(block)))
        for (joint, servo), factor in zip(_servos(block), factors, strict=True):
            if factor is None:
                draft.remarks.append(f"joint {joint.get('name')}: it has several servos, by a matrix")
            else:
                draft.add_joint(_joint(content, joint, servo, factor, draft)._replace(bus=bus))
                for name in {one for one in _params(servo) if not one.startswith("[")} - _SILENT:
                    unused.setdefault(name, []).append(str(joint.get("name")))
        for gpio in block.iter("gpio"):
            if _params(gpio).get("type", "dxl") != "dxl":
                draft.remarks.append(f"gpio {gpio.get('name')}: write it as a device; docs/how-to/devices.md")
    for name, joints in sorted(unused.items()):
        draft.remarks.append(f"{name} of {', '.join(joints)}: {_REASONS.get(name, 'write it as a register')}")
    draft.remarks.append("models: the file names none, and `model: auto` reads them from the servos")
    sliding = {one.get("name") for one in content.xml.iter("joint") if one.get("type") == "prismatic"}
    if not any(joint.get("name") in sliding for block in blocks for joint, _ in _servos(block)):
        draft.urdf = os.path.relpath(content.path, options.folder)
    return draft.conversion(content.text if draft.urdf else None)


_REASONS = {
    "Drive Mode": "its direction is taken over; a run needs 0 in the register",
    "Profile Velocity": "dxlrun sends the speed with each goal",
    "Profile Acceleration": "write `limits: {acceleration: ...}`",
    "Homing Offset": "the reference has it; a run reads the register",
    "Goal Current": "write a controller that commands efforts",
}


def _joint(
    content: FileContent, joint: Element, servo: Element, factor: float, draft: RobotDraft
) -> JointDraft:
    name, params = str(joint.get("name")), _params(servo)
    same = (one for one in content.xml.iter("joint") if one.get("type") and one.get("name") == name)
    described = next(same, joint)
    kind, limit = described.get("type", ""), described.find("limit")

    def servo_number(key: str, default: str = "") -> float:
        return _number(content, servo, params.get(key, default), f"{key} of {name}")

    def limit_number(key: str) -> float:
        return 0.0 if limit is None else _number(content, limit, limit.get(key, "0"), f"{key} of {name}")

    direction = (-1 if int(servo_number("Drive Mode", "0")) & _REVERSED else 1) * (1 if factor > 0 else -1)
    if abs(abs(factor) - 1) > 1e-9:
        draft.remarks.append(f"joint {name}: its gear of {factor:g}; write `gear_ratio`")
    limits = []
    if kind == "prismatic":
        draft.remarks.append(f"joint {name}: a crank makes it linear in ROS; here it has its servo's angle")
    elif limit_number("lower") < limit_number("upper"):
        limits.append([math.degrees(limit_number("lower")), math.degrees(limit_number("upper"))])
    if {"Min Position Limit", "Max Position Limit"} <= params.keys():
        ticks = [servo_number(f"{end} Position Limit") - _MIDDLE_TICKS for end in ("Min", "Max")]
        limits.append(sorted(direction * tick * _TICK_DEG for tick in ticks))
    return JointDraft(
        name,
        int(servo_number("ID" if "ID" in params else "id")),
        content.mark_of(servo),
        reference=180 - servo_number("Homing Offset", "0") * _TICK_DEG,
        direction=direction,
        limits=(max(low for low, _ in limits), min(high for _, high in limits)) if limits else None,
        velocity=math.degrees(limit_number("velocity")) or None if kind != "prismatic" else None,
        registers={
            item.lower().replace(" ", "_"): int(servo_number(item)) for item in sorted(_GAINS & params.keys())
        },
        continuous=kind == "continuous",
        limp=params.get("Torque Enable") == "0",
    )


def _servos(block: Element) -> list[tuple[Element, Element]]:
    """Return the joints of a block, each with the element that has the ID of its servo."""
    joints = [one for one in block.findall("joint") if "mimic" not in _params(one)]
    gpios = [one for one in block.findall("gpio") if "ID" in _params(one)]
    gpios = [one for one in gpios if _params(one).get("type", "dxl") == "dxl"]
    if gpios:
        return list(zip(joints, gpios, strict=False))
    return [(one, one) for one in joints if "id" in _params(one)]


def _factors(content: FileContent, block: Element, count: int) -> list[float | None]:
    """Return the factor from each servo to its joint; None for a joint that several servos move."""
    hardware = block.find("hardware")
    text = _params(hardware).get("transmission_to_joint_matrix", "").replace(",", " ")
    values = [_number(content, block, word, "transmission_to_joint_matrix") for word in text.split()]
    if len(values) != count * count:
        return [1.0] * count
    rows = [values[row * count : (row + 1) * count] for row in range(count)]
    own = [sum(map(bool, row)) == 1 and row[index] != 0 for index, row in enumerate(rows)]
    return [row[index] if own[index] else None for index, row in enumerate(rows)]


def _params(element: Element | None) -> dict[str, str]:
    params = [] if element is None else element.findall("param")
    return {str(one.get("name")): (one.text or "").strip() for one in params}


def _number(content: FileContent, element: Element, text: str, name: str) -> float:
    with suppress(ValueError):
        if math.isfinite(value := float(text)):
            return value
    raise refused(content.mark_of(element), f"{name} is {text!r}, but must be a number", "correct it")


def _matches(content: FileContent) -> bool:
    return content.top == "robot" and any(_servos(block) for block in content.xml.iter("ros2_control"))


FORMAT = FileFormat("a URDF with servos in ros2_control", _matches, convert=f"{__name__}:convert")
