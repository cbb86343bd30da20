"""Interbotix: the motor configuration of an X-series arm, with its modes.

Source: comments of Interbotix's motor configurations, and the e-Manual of the X series: registers by motor.
Baud_Rate is an index, Return_Delay_Time has 2 us, Velocity_Limit 0.229 rpm, and 0 rad is tick 2048. Bit 0 of
Drive_Mode reverses a servo; a shadow gets the goals of its motor through Secondary_ID.
"""

from __future__ import annotations

from dxlrun.tooling.files import Conversion, FileContent, FileFormat, ImportOptions
from dxlrun_import.checked_values import list_at, mapping_at, text_at, valid_name, value_at, whole_at
from dxlrun_import.robot_draft import DraftBus, JointDraft, RobotDraft

BAUD_RATES = (9600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
MODEL = "XM430-W350"
SHADOWED = {"viperx": "XM540-W270", "widowx": MODEL, "reactorx": MODEL}
"""Models of the joints with two servos, by type of arm; a joint with two servos cannot be `model: auto`"""
_TICK_DEG, _MIDDLE, _VELOCITY_DEG = 360 / 4096, 2048, 0.229 * 6
_USED = {
    *("ID", "Baud_Rate", "Return_Delay_Time", "Drive_Mode", "Velocity_Limit", "Secondary_ID"),
    *("Min_Position_Limit", "Max_Position_Limit"),
}
_REASONS = {
    "sleep_positions": "write a pose and `policies: {on_exit: ...}`",
    "joint_state_publisher": "the joint_state_broadcaster publishes them",
    "grippers": "the gripper has the angle of its servo here, not the distance of its fingers",
    "sisters": "each sister is a joint of its own here",
}


def convert(content: FileContent, options: ImportOptions) -> Conversion:
    """Convert motors to joints; shadows become servos of the joint that they follow."""
    draft = RobotDraft(content, FORMAT.name, options.name)
    motors = mapping_at(content, "motors")
    rates = {whole_at(content, "motors", motor, "Baud_Rate", default=3) for motor in motors}
    if len(rates) > 1 or not 0 <= max(rates, default=0) < len(BAUD_RATES):
        raise content.refusal(
            "the motors have different or unknown values of Baud_Rate", "give them one", "motors"
        )
    delays = [2 * whole_at(content, "motors", motor, "Return_Delay_Time", default=250) for motor in motors]
    port = text_at(content, "port", default="")
    draft.buses["main"] = DraftBus(2.0, BAUD_RATES[max(rates, default=3)], port, "", max(delays, default=500))
    shadows = _shadows(content)
    limp = _limp(content, options, draft)
    for motor in motors:
        if motor not in {one for followers in shadows.values() for one in followers}:
            joint = _joint(content, motor, motor in limp)
            servos = [_joint(content, one, False) for one in shadows.get(motor, ())]
            if servos:
                model, more = SHADOWED.get(options.type, MODEL), [(one.id, one.direction) for one in servos]
                joint = joint._replace(model=model, more=more, comment="guessed: model")
            draft.add_joint(joint)
        for key in sorted(mapping_at(content, "motors", motor).keys() - _USED):
            draft.remarks.append(f"{key} of {motor}: write it as a register")
    for group in mapping_at(content, "groups") if value_at(content, "groups") else ():
        names = [valid_name(str(one)) for one in list_at(content, "groups", group)]
        draft.groups[f"{valid_name(group)}_joints"] = [name for name in names if name in draft.joints]
    draft.remarks += [f"{key}: {why}" for key, why in _REASONS.items() if value_at(content, key)]
    if any(whole_at(content, "motors", motor, "Drive_Mode", default=0) for motor in motors) or shadows:
        draft.remarks.append("Drive_Mode and Secondary_ID: a run needs 0 and 255 in these registers")
    draft.remarks.append("models: the file names none, and `model: auto` reads them from the servos")
    return draft.conversion()


def _joint(content: FileContent, motor: str, limp: bool) -> JointDraft:
    at = ("motors", motor)
    low = whole_at(content, *at, "Min_Position_Limit", default=0)
    high = whole_at(content, *at, "Max_Position_Limit", default=4095)
    speed = whole_at(content, *at, "Velocity_Limit", default=0)
    return JointDraft(
        motor,
        whole_at(content, *at, "ID"),
        content.mark(*at),
        direction=-1 if whole_at(content, *at, "Drive_Mode", default=0) & 1 else 1,
        reference=180.0,
        limits=((low - _MIDDLE) * _TICK_DEG, (high - _MIDDLE) * _TICK_DEG),
        velocity=speed * _VELOCITY_DEG or None,
        limp=limp,
        comment="modes: torque_enable false" if limp else "",
    )


def _shadows(content: FileContent) -> dict[str, list[str]]:
    found = {}
    for motor in mapping_at(content, "shadows") if value_at(content, "shadows") else ():
        place = ("shadows", motor, "shadow_list")
        found[motor] = [str(one) for one in list_at(content, *place)]
        for one in (motor, *found[motor]):
            if one not in mapping_at(content, "motors"):
                raise content.refusal(f"{one} is not one of the motors", "correct its name", *place)
    return found


def _limp(content: FileContent, options: ImportOptions, draft: RobotDraft) -> set[str]:
    """Return the motors whose torque the modes leave off."""
    modes = options.modes
    found: set[str] = set()
    if modes is None:
        return found
    for kind in ("groups", "singles"):
        for name in mapping_at(modes, kind) if value_at(modes, kind) else ():
            members = list_at(content, "groups", name) if kind == "groups" else [name]
            if value_at(modes, kind, name, "torque_enable") is False:
                found |= set(map(str, members))
            mode = text_at(modes, kind, name, "operating_mode", default="position")
            if mode not in ("position", "ext_position"):
                draft.remarks.append(f"operating_mode {mode} of {name}: write a controller that commands it")
    return found


def _matches(content: FileContent) -> bool:
    motors = content.values.get("motors")
    values = list(motors.values()) if isinstance(motors, dict) else []
    return bool(values) and all(isinstance(one, dict) and "ID" in one for one in values)


FORMAT = FileFormat("a motor configuration of Interbotix", _matches, convert=f"{__name__}:convert")
