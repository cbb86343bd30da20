"""Modes that controllers need against what the models of their joints can do."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from dxlrun.compile.checks.places import joint_mark
from dxlrun.compile.checks.problems import Problems
from dxlrun.compile.controllers import CompiledController
from dxlrun.compile.joint.joints import CompiledJoint
from dxlrun.control.controllers.claims import start_modes
from dxlrun.description import Description
from dxlrun.dynamixel.plan.mode_plan import LACKS, controls_speed, model_modes
from dxlrun.mode import Mode, mode_of

_INTERFACE: Mapping[Mode, str] = {
    Mode.POSITION: "a position",
    Mode.VELOCITY: "a velocity alone",
    Mode.EFFORT: "an effort alone",
    Mode.PWM: "a PWM",
    Mode.EFFORT_POSITION: "a position with an effort",
}


def compile_modes(
    description: Description,
    joints: Mapping[str, CompiledJoint],
    controllers: Mapping[str, CompiledController],
    problems: Problems,
) -> dict[str, Mode]:
    """Return the mode in which each joint begins a run, by its name; it is one that its model has.

    Every controller's joints must have the mode that the controller needs, and every joint one in which it
    rests.
    """
    able = {name: model_modes(joint.table, joint.plan.continuous) for name, joint in joints.items()}
    for name, joint in joints.items():
        if joint.plan.rest not in able[name]:
            problems.error(
                description.marks.value("joints", name, "continuous"),
                f"{joint.table.model} of {name} {LACKS[joint.plan.rest]}, so {name} cannot be continuous",
                "take `continuous` out, or use another model",
            )
    for name, controller in controllers.items():
        _check(description, name, controller, joints, able, problems)
    plans = [joint.plan for joint in joints.values()], [one.plan for one in controllers.values()]
    wanted = start_modes(*plans)
    return {
        name: mode if mode in able[name] else next(iter(able[name]))
        for name, mode in wanted.items()
        if name in able
    }


def _check(  # noqa: PLR0917  one controller against everything that was compiled before
    description: Description,
    name: str,
    controller: CompiledController,
    joints: Mapping[str, CompiledJoint],
    able: Mapping[str, Collection[Mode]],
    problems: Problems,
) -> None:
    if not controller.plan.command:
        return
    mode = mode_of(controller.plan.command)
    for joint in controller.plan.joints:
        if joint not in joints:
            continue
        model, mark = joints[joint].table.model, joint_mark(description, name, joint)
        if mode not in able[joint]:
            *others, last = (_INTERFACE[each] for each in able[joint])
            known = f"use a controller that commands {', '.join(others)}{' or ' * bool(others)}{last}"
            lacks = f"{model} of {joint} {LACKS[mode]}"
            within_a_turn = model_modes(joints[joint].table, continuous=False)
            if mode is Mode.EFFORT_POSITION and mode in within_a_turn:
                lacks = f"{joint} is continuous, for which it is not offered"
                known = f"take `continuous` out, or {known}"
            problems.error(mark, f"{name} commands {_INTERFACE[mode]}, but {lacks}", known)
        elif mode is Mode.VELOCITY and not controls_speed(joints[joint].table):
            problems.warning(
                mark,
                f"{model} of {joint} controls no speed in wheel mode: a velocity of {name} is taken for the "
                "same fraction of full output, and a loaded servo turns slower",
                "command its PWM, or use a model that controls its speed",
            )
