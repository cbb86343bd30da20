"""Intended differences between a replay and its run: parameters, code, arguments of the robot file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec
import yaml
from msgspec.structs import replace

from dxlrun import InputError
from dxlrun.tooling.files import suggestion
from dxlrun.tooling.plans import ControllerPlan, LoopPlan
from dxlrun.tooling.robots import PlugIns, compile_texts, replan_controller
from dxlrun_analysis.replay.recorded_inputs import RecordedPlan


class Setting(msgspec.Struct, frozen=True):
    """Changed value of one controller parameter for a replay: `--set left_arm.tolerances.path=0.1`."""

    controller: str
    parameter: tuple[str, ...]
    value: object

    @classmethod
    def parse(cls, text: str) -> Setting:
        """Parse `CONTROLLER.PARAMETER=VALUE`; the value has the syntax of the robot file.

        Raises:
            InputError: The text has another form, or its value is not YAML.
        """
        place, sign, value = text.partition("=")
        controller, *parameter = place.strip().split(".")
        if not sign or not parameter or not all((controller, *parameter)):
            raise InputError(f"{text!r} sets nothing; write --set CONTROLLER.PARAMETER=VALUE")
        try:
            return cls(controller, tuple(parameter), yaml.safe_load(value))
        except yaml.YAMLError as error:
            raise InputError(
                f"the value {value!r} of {place} is not YAML ({getattr(error, 'problem', None) or error}); "
                "write it as in the robot file"
            ) from error


def with_settings(loop: LoopPlan, settings: Sequence[Setting], plugins: PlugIns) -> LoopPlan:
    """Return the loop's plan with changed parameters of its controllers.

    Raises:
        InputError: A controller does not exist, or a value does not fit.
    """
    names = tuple(controller.name for controller in loop.controllers)
    joints = {joint.name: joint for joint in loop.joints}
    controllers = {controller.name: controller for controller in loop.controllers}
    for setting in settings:
        if setting.controller not in controllers:
            raise InputError(
                f"--set {setting.controller}: the log has no such controller; "
                f"{suggestion(setting.controller, names)}"
            )
        controllers[setting.controller] = _changed(controllers[setting.controller], setting)
    for name in {setting.controller for setting in settings}:
        controllers[name] = replan_controller(f"--set {name}", controllers[name], joints, plugins, loop.urdf)
    return replace(loop, controllers=tuple(controllers[name] for name in names))


def with_changed_code(loop: LoopPlan, then: LoopPlan, plugins: PlugIns) -> LoopPlan:
    """Return the loop's plan in which controllers from changed files are planned again with the joints and
    interfaces that their code now claims.

    Args:
        loop: Plan with the current code.
        then: Plan of the run.
        plugins: Installed plug-ins.

    Raises:
        InputError: A changed controller does not fit the plan.
    """
    joints = {joint.name: joint for joint in loop.joints}
    return replace(
        loop,
        controllers=tuple(
            now
            if now.distribution == before.distribution
            else replan_controller(f"--code current: {now.name}", now, joints, plugins, loop.urdf)
            for before, now in zip(then.controllers, loop.controllers, strict=True)
        ),
    )


def _changed(plan: ControllerPlan, setting: Setting) -> ControllerPlan:
    parameters = json.loads(plan.parameters)
    place = parameters
    for key in setting.parameter[:-1]:
        place = place.setdefault(key, {})
        if not isinstance(place, dict):
            raise InputError(f"--set {plan.name}.{'.'.join(setting.parameter)}: {key} is not a mapping")
    place[setting.parameter[-1]] = setting.value
    return replace(plan, parameters=json.dumps(parameters, default=str))


def with_arguments(plan: RecordedPlan, loop: LoopPlan, arguments: Mapping[str, str]) -> LoopPlan:
    """Return the loop's plan with joints and controllers compiled again with changed arguments.

    Cycles and commands stay as recorded.

    Raises:
        InputError: The file does not compile with the arguments, or the recorded inputs do not fit the
            resulting loop.
    """
    if not arguments:
        return loop
    same = _compiled(plan, plan.arguments)
    if (same.joints, same.controllers) != (plan.loop.joints, plan.loop.controllers):
        raise InputError(
            "the logged robot file now compiles to a different plan: versions differ, or servo models were "
            "detected at start-up; use --set instead of arguments"
        )
    other = _compiled(plan, {**plan.arguments, **arguments})
    if other.period_ns != loop.period_ns:
        raise InputError(
            f"the arguments change the loop's period from {loop.period_ns} ns to {other.period_ns} ns, but "
            "the recorded inputs have the old one; keep the rate"
        )
    names = [tuple(one.name for one in each) for each in (other.joints, loop.joints)]
    others = [tuple(one.name for one in each) for each in (other.controllers, loop.controllers)]
    if names[0] != names[1] or others[0] != others[1]:
        raise InputError("the arguments change the recorded joints or controllers; change only parameters")
    if other.references != loop.references:
        raise InputError("the arguments change the recorded references; change only parameters")
    if other.source_states != loop.source_states:
        raise InputError("the arguments change recorded devices, sensors or states; change only parameters")
    return replace(loop, joints=other.joints, controllers=other.controllers)


def _compiled(plan: RecordedPlan, arguments: Mapping[str, str]) -> LoopPlan:
    files = {Path(plan.source_file).name: plan.source_text, **plan.included}
    return compile_texts(files, arguments, plan.loop.urdf, plan.omitted).plan.loop
