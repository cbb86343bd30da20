"""dynamixel_workbench and OP3: lists of joints with items of the control table, in YAML.

Source: ROBOTIS' comments in dynamixel_workbench_controllers/config/basic.yaml (at least the ID, items in
CamelCase with `_`) and in op3_manager/config/dxl_init_OP3.yaml (items by joint, without IDs, which are in the
`.robot` file). 0 is the middle of a servo's travel in both.
"""

from __future__ import annotations

from collections.abc import Mapping

from dxlrun.tooling.files import Conversion, FileContent, FileFormat, ImportOptions
from dxlrun_import.checked_values import list_at, mapping_at, number_at, text_at, value_at, whole_at
from dxlrun_import.motion_text import MotionPoint, motion_conversion
from dxlrun_import.robot_draft import DraftBus, JointDraft, RobotDraft

GAINS = ("position_p_gain", "position_i_gain", "position_d_gain", "velocity_p_gain", "velocity_i_gain")
_FIRST = {"cw_angle_limit", "ccw_angle_limit", "moving_speed"}  # items of Protocol 1.0
_VELOCITY_MODE = 1
_REASONS: Mapping[str, str] = {
    "operating_mode": "dxlrun sets the mode by the controller",
    "profile_velocity": "dxlrun sends the speed with each goal",
    "profile_acceleration": "write `limits: {acceleration: ...}`",
    "led": "write it as a register",
    **dict.fromkeys(_FIRST, "write `limits`; its ticks depend on the model"),
    "moving_speed": "dxlrun sends the speed with each goal",
    "torque_constant": "has no equivalent",
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
    is_first = any(_FIRST & keys.keys() for keys in items.values())
    guessed = "guessed: baud_rate" if is_first else "guessed: protocol and baud_rate"
    draft.buses["main"] = DraftBus(1.0 if is_first else 2.0, 57_600, "", guessed, delay)
    unused: dict[str, list[str]] = {}
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
                continuous=value_at(content, joint, keys.get("operating_mode", "")) == _VELOCITY_MODE,
                registers={item: whole_at(content, joint, keys[item]) for item in GAINS if item in keys},
                comment="guessed: reference and direction",
            )
        )
        for item in sorted(keys.keys() - _USED):
            unused.setdefault(item, []).append(joint)
    for item, joints in sorted(unused.items()):
        name = next(keys[item] for keys in items.values() if item in keys)
        why = _REASONS.get(item, "write it as a register")
        draft.remarks.append(f"{name} of {', '.join(joints)}: {why}")
    draft.remarks.append("models: the file names none, and `model: auto` reads them from the servos")
    return draft.conversion()


def convert_motion(content: FileContent, options: ImportOptions) -> Conversion:
    """Convert the named steps of an operator, in their order; times are from the start, positions rad."""
    joints = [text_at(content, "joint", "names", at) for at in range(len(list_at(content, "joint", "names")))]
    points = []
    for index in range(len(list_at(content, "motion", "names"))):
        place = ("motion", text_at(content, "motion", "names", index))
        positions = [number_at(content, *place, "step", at) for at in range(len(joints))]
        time = number_at(content, *place, "time_from_start")
        points.append(MotionPoint(time, dict(zip(joints, positions, strict=True))))
    return motion_conversion(content, options, MOTION.name, points)


def _is_motion(content: FileContent) -> bool:
    return all(value_at(content, key, "names") for key in ("joint", "motion"))


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
MOTION = FileFormat(
    "a motion of ROBOTIS' dynamixel_workbench",
    _is_motion,
    convert=f"{__name__}:convert_motion",
    makes="motion",
)
