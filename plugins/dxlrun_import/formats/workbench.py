"""dynamixel_workbench and OP3: lists of joints with items of the control table, in YAML.

Source: ROBOTIS' comments in dynamixel_workbench_controllers/config/basic.yaml (at least the ID, items in
CamelCase with `_`) and in op3_manager/config/dxl_init_OP3.yaml (items by joint, without IDs, which are in the
`.robot` file). 0 is the middle of a servo's travel in both.
"""

from __future__ import annotations

from collections.abc import Mapping

from dxlrun.tooling.files import Conversion, FileContent, FileFormat, ImportOptions
from dxlrun_import.checked_values import mapping_at, whole_at
from dxlrun_import.robot_draft import DraftBus, JointDraft, RobotDraft

GAINS = ("position_p_gain", "position_i_gain", "position_d_gain", "velocity_p_gain", "velocity_i_gain")
_REASONS: Mapping[str, str] = {
    "operating_mode": "dxlrun sets the mode by the controller",
    "profile_velocity": "dxlrun sends the speed with each goal",
    "profile_acceleration": "write `limits: {acceleration: ...}`",
    "led": "write it as a register",
}
_USED = {"id", "return_delay_time", "min_position_limit", "max_position_limit", "homing_offset", *GAINS}
_TICK_DEG, _MIDDLE = 360 / 4096, 2048


def convert(content: FileContent, options: ImportOptions) -> Conversion:
    """Convert a list of joints with IDs: models are read from the servos at the start."""
    draft = RobotDraft(content, FORMAT.name, options.name)
    items = {joint: {key.lower(): key for key in mapping_at(content, joint)} for joint in content.values}
    delays = [
        2 * whole_at(content, joint, keys["return_delay_time"])
        for joint, keys in items.items()
        if "return_delay_time" in keys
    ]
    delay = max(delays) if len(delays) == len(items) else None
    draft.buses["main"] = DraftBus(2.0, 57_600, "", "guessed: protocol and baud_rate", delay)
    for joint, keys in items.items():
        offset = whole_at(content, joint, keys.get("homing_offset", "homing_offset"), default=0)
        limits = None
        if {"min_position_limit", "max_position_limit"} <= keys.keys():
            low, high = (whole_at(content, joint, keys[f"{end}_position_limit"]) for end in ("min", "max"))
            limits = (low - _MIDDLE) * _TICK_DEG, (high - _MIDDLE) * _TICK_DEG
        draft.add_joint(
            JointDraft(
                joint,
                whole_at(content, joint, keys["id"]),
                content.mark(joint),
                reference=180 - offset * _TICK_DEG,
                limits=limits,
                registers={item: whole_at(content, joint, keys[item]) for item in GAINS if item in keys},
                comment="guessed: reference and direction",
            )
        )
        for item in sorted(keys.keys() - _USED):
            draft.remarks.append(f"{keys[item]} of {joint}: {_REASONS.get(item, 'write it as a register')}")
    draft.remarks.append("models: the file names none, and `model: auto` reads them from the servos")
    return draft.conversion()


def _matches(content: FileContent) -> bool:
    values = content.values.values()
    return bool(values) and all(isinstance(one, dict) and "ID" in one for one in values)


def _is_init(content: FileContent) -> bool:
    values = content.values.values()
    return bool(values) and all(isinstance(one, dict) and "return_delay_time" in one for one in values)


FORMAT = FileFormat(
    "a configuration of ROBOTIS' dynamixel_workbench", _matches, convert=f"{__name__}:convert"
)
INIT = FileFormat(
    "a list of registers of ROBOTIS' robots (dxl_init), without IDs",
    _is_init,
    "import the `.robot` file, and write these items as `registers` of its joints",
)
