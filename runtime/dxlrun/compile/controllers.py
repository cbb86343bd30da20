"""Controllers of the robot file against plug-ins, joints, claims, modes and the loop's rate."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass

from pydantic import ValidationError

from dxlrun.compile.joints import CompiledJoint
from dxlrun.compile.problems import Problems, joint_mark
from dxlrun.control.controllers.claims import conflicts, start_modes
from dxlrun.control.controllers.controller import Interfaces, ParametersModel
from dxlrun.control.controllers.plugins import Offer, PlugIns, interfaces_breach
from dxlrun.control.loop_plan import ControllerPlan
from dxlrun.description import Description, problems_of
from dxlrun.description.modes import Mode, mode_of
from dxlrun.dynamixel.plan.mode_plan import LACKS, controls_speed, model_modes
from dxlrun.errors import suggestion
from dxlrun.run.channels.cycle import MOST_CONTROLLERS

_RATE_TOLERANCE = 1e-6
"""Relative; a loop rate of 33.3 Hz is three times 11.1 Hz."""
_INTERFACE: Mapping[Mode, str] = {
    Mode.POSITION: "a position",
    Mode.VELOCITY: "a velocity alone",
    Mode.EFFORT: "an effort alone",
    Mode.PWM: "a PWM",
    Mode.EFFORT_POSITION: "a position with an effort",
}


@dataclass(frozen=True, slots=True)
class CompiledController:
    """A controller whose type is known and whose parameters are valid."""

    plan: ControllerPlan
    offer: Offer
    parameters: ParametersModel


def compile_controllers(
    description: Description, plugins: PlugIns, problems: Problems
) -> dict[str, CompiledController]:
    """Return the controllers that could be compiled, by name, in the order of the file."""
    compiled: dict[str, CompiledController] = {}
    for name, entry in description.robot.controllers.items():
        every = _every(description, name, entry.rate, problems)
        offer = _offer(description, name, entry.type, plugins, problems)
        if offer is None:
            continue
        parameters = _parameters(description, name, offer, problems)
        if parameters is None:
            continue
        interfaces = _interfaces(description, name, offer, parameters, problems)
        if interfaces is None:
            continue
        plan = ControllerPlan(
            name=name,
            type=entry.type,
            distribution=offer.distribution,
            parameters=json.dumps(entry.parameters),  # as written: `60 deg` is what the model accepts
            joints=interfaces.joints,
            command=interfaces.command,
            publishes=offer.controller.publishes,
            active=entry.active,
            every=every,
            rate=entry.rate,
            fallback=entry.fallback or "",
            into=entry.into,
            reference=interfaces.reference,
            reads=interfaces.reads,
            topics=tuple(f"/{name}/{topic}" for topic in offer.controller.Topics),
        )
        buses = (f"/bus/{bus}" for bus in description.robot.buses)
        if taken := set(plan.topics).intersection(buses):
            mark = description.marks.key("controllers", name)
            problems.error(mark, f"{min(taken)} is the topic of a bus", f"call {name} otherwise")
        compiled[name] = CompiledController(plan, offer, parameters)
    _exclusive_claims(description, compiled, problems)
    _fallbacks(description, compiled, problems)
    if len(description.robot.controllers) > MOST_CONTROLLERS:
        problems.error(
            description.marks.key("controllers"),
            f"the file has {len(description.robot.controllers)} controllers, the most are {MOST_CONTROLLERS}",
            "take some out",
        )
    return compiled


def _every(description: Description, name: str, rate: float | None, problems: Problems) -> int:
    """Return of how many cycles the controller is updated in one."""
    loop = description.robot.loop.rate
    if rate is None:
        return 1
    mark = description.marks.value("controllers", name, "rate")
    if rate > loop * (1 + _RATE_TOLERANCE):
        problems.error(
            mark,
            f"rate {rate:g} Hz of {name} is above the loop's {loop:g} Hz",
            f"the nearest possible is {loop:g}",
        )
        return 1
    every = max(1, round(loop / rate))
    if abs(every * rate - loop) > _RATE_TOLERANCE * loop:
        problems.error(
            mark,
            f"rate {rate:g} Hz of {name} does not divide the loop's {loop:g} Hz",
            f"the nearest possible is {loop / every:.6g}",
        )
    return every


def _offer(
    description: Description, name: str, type_name: str, plugins: PlugIns, problems: Problems
) -> Offer | None:
    offer = plugins.controllers.get(type_name)
    if offer is None:
        what = f"no plug-in offers the controller type {type_name} of {name}"
        problems.error(
            description.marks.value("controllers", name, "type"), what, _where_to_get(type_name, plugins)
        )
    return offer


def _where_to_get(type_name: str, plugins: PlugIns) -> str:
    """Return how to get a type: another spelling, another package, or the repair of a broken one."""
    if type_name in plugins.broken:  # two plug-ins offer it
        return plugins.broken[type_name]
    known = tuple(plugins.controllers)
    close = suggestion(type_name, known)
    if not plugins.broken:
        return (
            close if close.endswith("?") else f"install the package that offers it, or take another ({close})"
        )
    broken = "; ".join(plugins.broken.values())
    return f"{close} If not: {broken}" if close.endswith("?") else broken


def _parameters(
    description: Description, name: str, offer: Offer, problems: Problems
) -> ParametersModel | None:
    entry = description.robot.controllers[name]
    model = offer.controller.Parameters
    try:
        return model.model_validate(entry.parameters)
    except ValidationError as error:
        problems.extend(problems_of(error, description.marks, ("controllers", name), model=model))
    except Exception as error:  # a validator of the model is foreign code
        _at_fault(description, name, offer, _raised("check its parameters", error), problems)
    return None


def _at_fault(
    description: Description, name: str, offer: Offer, breach: tuple[str, str], problems: Problems
) -> None:
    """Add what the plug-in of a controller did wrong, and how to fix it."""
    what, fix = breach
    text = f"controller {name} ({offer.distribution}) {what}"
    problems.error(description.marks.key("controllers", name), text, fix)


def _raised(what: str, error: Exception) -> tuple[str, str]:
    raised = " ".join(f"{type(error).__name__}: {error}".split())
    return f"cannot {what}: {raised}", "correct its parameters, or its plug-in"


def _interfaces(
    description: Description, name: str, offer: Offer, parameters: ParametersModel, problems: Problems
) -> Interfaces | None:
    """Return the interfaces that a controller claims; what its code raises is a problem of the file."""
    joints = tuple(description.robot.joints)
    try:
        interfaces = offer.controller.interfaces(parameters, joints)
    except Exception as error:
        _at_fault(description, name, offer, _raised("name its interfaces", error), problems)
        return None
    breach = interfaces_breach(interfaces)
    if breach is not None:
        what, fix = breach
        _at_fault(description, name, offer, (what, f"report it to its author: {fix}"), problems)
        return None
    seen: set[str] = set()
    good = True
    for joint in interfaces.joints:
        mark = joint_mark(description, name, joint)
        if joint not in joints:
            problems.error(
                mark, f"{name} claims joint {joint}, which is not defined", suggestion(joint, joints)
            )
            good = False
        elif joint in seen:
            problems.error(mark, f"{name} names joint {joint} twice", "name it once")
            good = False
        seen.add(joint)
    return interfaces if good else None


def _fallbacks(description: Description, compiled: dict[str, CompiledController], problems: Problems) -> None:
    """Check that each fallback can take over when it is needed."""
    robot = description.robot
    for name, entry in robot.controllers.items():
        if entry.fallback is None:
            continue
        mark = description.marks.value("controllers", name, "fallback")
        other = robot.controllers.get(entry.fallback)
        if other is None:
            what = f"the fallback {entry.fallback} of {name} is no controller of the file"
            problems.error(mark, what, suggestion(entry.fallback, tuple(robot.controllers)))
        elif entry.fallback == name:
            problems.error(mark, f"{name} is its own fallback", "name another controller, or take it out")
        elif not entry.active:
            continue  # which are active when it fails depends on what is switched
        elif other.active:
            what = f"the fallback {entry.fallback} of {name} is active from the start"
            problems.error(mark, what, f"write active: false in {entry.fallback}: it takes over later")
        elif name in compiled and entry.fallback in compiled:
            staying = [one.plan for one in compiled.values() if one.plan.active and one.plan.name != name]
            after = [*staying, compiled[entry.fallback].plan]
            for holder in sorted({c.holder for c in conflicts(after) if entry.fallback == c.other}):
                what = f"fallback {entry.fallback} of {name} claims joints of {holder}, which stays active"
                problems.error(mark, what, "take these joints out of it, or name another controller")


def _exclusive_claims(
    description: Description, compiled: dict[str, CompiledController], problems: Problems
) -> None:
    taken: dict[tuple[str, str], list[str]] = {}
    for conflict in conflicts(c.plan for c in compiled.values() if c.plan.active):
        taken.setdefault((conflict.holder, conflict.other), []).append(conflict.joint)
    for (holder, other), joints in taken.items():
        problems.error(
            joint_mark(description, other, joints[0]),
            f"{other} and {holder} are both active and both claim {', '.join(joints)}",
            f"write active: false in one of the two, or take the joint{'s' * (len(joints) > 1)} out",
        )


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
    modes = start_modes(*plans)
    return {
        name: mode if mode in able[name] else next(iter(able[name]))
        for name, mode in modes.items()
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
