"""ROBOTIS' `.robot` files: ports and servos of OP3, THORMANG3 and other robots of the ROBOTIS Framework.

Source: the comments in op3_manager/config/OP3.robot: sections in brackets, columns separated by `|`, and the
control cycle in ms. 0 is the middle of a servo's travel.
"""

from __future__ import annotations

from dxlrun.tooling.files import Conversion, FileContent, FileFormat, ImportOptions, Mark
from dxlrun_import.checked_values import refused, valid_name
from dxlrun_import.robot_draft import DraftBus, JointDraft, RobotDraft

_COLUMNS = {"port info": 2, "device info": 6}


def convert(content: FileContent, options: ImportOptions) -> Conversion:
    """Convert ports to buses, and servos to joints."""
    draft = RobotDraft(content, FORMAT.name, options.name)
    rates: dict[str, int] = {}
    section = ""
    for number, line in enumerate(content.text.splitlines(), 1):
        mark = Mark(str(content.path), number, 1)
        text = line.partition("#")[0].strip()
        if text.startswith("["):
            section = text.strip("[] \t").lower()
        elif section == "control info" and text.startswith("control_cycle"):
            draft.rate = 1000 / _whole(text.partition("=")[2], mark)
        elif section in _COLUMNS and text:
            cells = [cell.strip() for cell in text.split("|")]
            if len(cells) < _COLUMNS[section]:
                what = f"this line has {len(cells)} columns, but must have {_COLUMNS[section]}"
                raise refused(mark, what, "the file may be cut off; copy it again")
            if section == "port info":
                rates[cells[0]] = _whole(cells[1], mark)
            else:
                _add_device(draft, cells, rates, mark)
    draft.remarks.append("directions: the file has none; compare them with the robot")
    return draft.conversion()


def _add_device(draft: RobotDraft, cells: list[str], rates: dict[str, int], mark: Mark) -> None:
    kind, port, number, model, protocol, name = cells[:6]
    if kind != "dynamixel":
        draft.remarks.append(f"{kind} {name}: write it as a device; docs/how-to/devices.md")
        return
    if port not in rates:
        raise refused(mark, f"port {port} of {name} is not in the section of ports", "add it there")
    bus = "main" if len(rates) == 1 else valid_name(port.rpartition("/")[2]).lower()
    if protocol not in ("1.0", "2.0"):
        raise refused(mark, f"protocol {protocol} of {name} does not exist", "write 1.0 or 2.0")
    draft.buses.setdefault(bus, DraftBus(float(protocol), rates[port], port))
    if draft.buses[bus].protocol != float(protocol):
        what = f"{name} has Protocol {protocol}, and others on {port} have another one"
        raise refused(mark, what, "give all servos of a port one protocol")
    draft.add_joint(
        JointDraft(name, _whole(number, mark), mark, model, bus=bus, comment="guessed: direction")
    )


def _whole(text: str, mark: Mark) -> int:
    if not text.strip().isdecimal() or not int(text):
        raise refused(mark, f"{text.strip()!r} is not a number above 0", "correct it")
    return int(text)


def _matches(content: FileContent) -> bool:
    return "[ device info ]" in content.text or "[device info]" in content.text


FORMAT = FileFormat("a robot of the ROBOTIS Framework", _matches, convert=f"{__name__}:convert")
