"""Controllers: compiles `controllers` of the robot file and checks them against all that they depend on."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import TypeVar

import numpy as np
from msgspec.structs import replace
from pydantic import ValidationError

from dxlrun.channels.cycle import MOST_CONTROLLERS
from dxlrun.compile.contribution import Contribution
from dxlrun.compile.controller_entry import (
    CompiledController,
    WrongEntry,
    compile_entry,
    find_offer,
    plan_entry,
    require_fit,
)
from dxlrun.compile.controller_graph import ControllerGraph
from dxlrun.compile.joints.compiled_joints import CompiledJoint
from dxlrun.compile.joints.compiled_servos import SettingsStage
from dxlrun.compile.joints.described_servos import used_features
from dxlrun.compile.joints.limits import report_speed
from dxlrun.compile.joints.poses import Poses
from dxlrun.compile.joints.register_values import UnfitRegister
from dxlrun.compile.problems import RobotFile, into_mark, joint_mark
from dxlrun.contract.controller import NOT_BY_JOINT, SpeedPeak
from dxlrun.control.controllers.claims import claimed_modes, start_modes
from dxlrun.control.controllers.plugin_loading import Offer, PlugIns
from dxlrun.control.controllers.single_files import class_beside, file_of, is_of_file
from dxlrun.control.controllers.update_order import below, rate_divider, rate_fits
from dxlrun.description.base_form import ParametersModel, PlugInEntry
from dxlrun.description.document import KeyPath, read_file
from dxlrun.description.form_problems import errors_between_keys, problems_of
from dxlrun.description.mistakes.ros_types import ros_type
from dxlrun.description.reading import Description
from dxlrun.description.robot import ControllerEntry
from dxlrun.errors import Mark, what_and_fix
from dxlrun.features import stages
from dxlrun.plan.loop_plan import ControllerPlan, RegisterPlan
from dxlrun.plan.mechanics_plan import MechanicsPlan
from dxlwire.bus_plan import BusPlan
from dxlwire.modes import Mode, mode_of
from dxlwire.plan.mode_plan import LACKS, controls_speed, model_modes

Made = TypeVar("Made")
_INTERFACE: Mapping[Mode, str] = {
    Mode.POSITION: "a position",
    Mode.VELOCITY: "a velocity",
    Mode.EFFORT: "an effort",
    Mode.PWM: "a PWM",
    Mode.EFFORT_POSITION: "a position with an effort",
}


def read_controller_files(file: RobotFile) -> dict[str, str]:
    """Read the Python files with controller classes (type `./wave.py:Wave`); return text by file name."""
    folder = file.description.path.parent
    texts: dict[str, str] = {}
    for controller, entry in file.robot.controllers.items():
        if not is_of_file(entry.type) or ros_type(entry.type, ()):
            continue
        mark, name = file.at("controllers", controller, "type"), file_of(entry.type)
        path = folder / (name or "")
        if name is None or path.resolve().parent != folder.resolve():
            what = f"{entry.type} of {controller} is not a class in the folder of the robot file"
            meant = class_beside(folder, entry.type)
            file.error(mark, what, f"write {meant or './wave.py:Wave for the class Wave in wave.py'}")
            continue
        try:
            texts[name] = read_file(path).decode("utf-8")
        except (OSError, UnicodeDecodeError) as error:
            why = error.strerror if isinstance(error, OSError) else "not UTF-8"
            what = f"{name} of controller {controller} cannot be read ({why})"
            file.error(mark, what, f"check the file {path}")
    return texts


def compile_controllers(
    file: RobotFile, plugins: PlugIns, contributions: Collection[Contribution], poses: Poses
) -> dict[str, CompiledController]:
    """Compile all controllers that have no mistake, by name in file order; check the whole graph of them.

    They can read and command the sources in `contributions`, and name `poses`.
    """
    compiled: dict[str, CompiledController] = {}
    plans: list[ControllerPlan] = []
    for name, entry in file.robot.controllers.items():
        plan = plan_entry(name, entry, _every(file, name, entry.rate))
        one = _compiled(file, plan, plugins, entry, poses)
        if one is not None:
            compiled[name] = one
        plans.append(plan if one is None else one.plan)
    _check_graph(file, plans, compiled, contributions)
    for name, joints in file.description.groups.items():
        own = compiled[name].plan if name in compiled else None
        if own is not None and own.command and set(own.joints) != set(joints):
            what = f"group {name} and controller {name} have different joints"
            file.error(file.key("groups", name), what, "rename one of them")
    if len(file.robot.controllers) > MOST_CONTROLLERS:
        file.error(
            file.key("controllers"),
            f"the file has {len(file.robot.controllers)} controllers, more than {MOST_CONTROLLERS}",
            "remove some",
        )
    return compiled


def _compiled(
    file: RobotFile, plan: ControllerPlan, plugins: PlugIns, entry: ControllerEntry, poses: Poses
) -> CompiledController | None:
    """Compile one controller; None if it has mistakes, which are added to the file."""
    name, robot = plan.name, file.robot
    offer = _offer(file, name, plan.type, plugins)
    if offer is None:
        return None
    model = offer.controller.Parameters
    _refuse_uneven(file, name, model)
    parameters, wrong = poses.put_in(entry.parameters, model)
    for path, *problem in wrong:
        file.error(file.at("controllers", name, *path), *problem)
    entry = entry.model_copy(update={"parameters": parameters})
    plan = plan_entry(name, entry, plan.every)
    wrapping = {joint for joint, described in robot.joints.items() if described.wrap}

    def make_compiled() -> CompiledController:
        groups, omitted = file.description.groups, file.description.omitted
        joints = tuple(robot.joints)
        return compile_entry(plan, offer, joints, wrapping=wrapping, groups=groups, omitted=omitted)

    found = report_entry(file, "controller", name, entry, model, make_compiled)
    buses = {f"/bus/{bus}" for bus in robot.buses}
    if found is not None and (taken := buses.intersection(found.plan.topics)):
        mark = file.key("controllers", name)
        file.error(mark, f"{min(taken)} is the topic of a bus", f"rename controller {name}")
    return found


def _refuse_uneven(file: RobotFile, name: str, model: type[ParametersModel]) -> None:
    """Add an error for each list of a controller that may still have values for joints that are omitted."""
    for _, of, *keys in file.description.uneven:
        field = model.model_fields.get(str(keys[0]))
        if of != name or (field is not None and NOT_BY_JOINT in field.metadata):
            continue
        what = (
            f"{keys[-1]} of {name} is as long as its list joints was, so it may have values of omitted joints"
        )
        fix = "write it as a mapping by joint, or let its class declare NOT_BY_JOINT"
        file.error(file.key("controllers", name, *keys), what, fix)


def report_entry(  # noqa: PLR0917  an entry, and what is made of it
    file: RobotFile,
    kind: str,
    name: str,
    entry: PlugInEntry,
    model: type[ParametersModel],
    make: Callable[[], Made],
) -> Made | None:
    """Return what `make` returns for an entry; None if it raises an error, which is added to the file.

    Args:
        file: Robot file; collects the problems.
        kind: Name of the section in the singular, for messages: `sensor`.
        name: Name of the entry.
        entry: Entry of the section.
        model: Form of its parameters.
        make: Checks the entry; may raise ValidationError and WrongEntry.
    """
    try:
        return make()
    except ValidationError as error:
        prefix = (f"{kind}s", name)
        beside = sorted(type(entry).model_fields.keys() - {"parameters"})
        file.extend(
            problems_of(error, file.marks, prefix, model=model, beside=beside, document=type(file.robot))
        )
        between = errors_between_keys(entry.parameters, error, model)
        if between is not None:
            replaced = {(*prefix, *path) for path in between[1]}
            file.extend(problems_of(between[0], file.marks, prefix, model=model, unknown=replaced))
    except WrongEntry as wrong:
        _report(file, wrong)
    return None


def _report(file: RobotFile, wrong: WrongEntry) -> None:
    for mistake in wrong.mistakes:
        file.error(_entry_mark(file.description, mistake.at), mistake.what, mistake.fix)


def _entry_mark(description: Description, at: KeyPath) -> Mark:
    """Return the line and column of an entry, of one of its keys, or of a joint named in its parameters."""
    if not at[2:]:
        return description.marks.key(*at)
    if description.marks.has(at):
        return description.marks.value(*at)
    return joint_mark(description, str(at[1]), ".".join(map(str, at[2:])))


def _check_graph(
    file: RobotFile,
    plans: Sequence[ControllerPlan],
    compiled: Collection[str],
    contributions: Collection[Contribution],
) -> None:
    sources = [source for each in contributions for source in each.sources]
    known = {*compiled, *(source.name for source in sources)}
    named = {*(plan.name for plan in plans), *(name for each in contributions for name in each.names)}
    by_name = {plan.name: plan for plan in plans}
    graph = ControllerGraph(tuple(file.robot.joints), plans, sources, frozenset(named - known))
    for mistake in graph.find_mistakes():
        file.error(_graph_mark(file.description, by_name, mistake.at), mistake.what, mistake.fix)
    for mistake in graph.warnings():
        file.warning(_graph_mark(file.description, by_name, mistake.at), mistake.what, mistake.fix)


def _graph_mark(description: Description, plans: Mapping[str, ControllerPlan], at: KeyPath) -> Mark:
    """Return the line and column of a mistake in the graph; the entry's own if the class chose the name."""
    marks, plan = description.marks, plans[str(at[1])]
    match at[2:]:
        case ("joints", int(index)):
            return joint_mark(description, plan.name, plan.joints[index])
        case ("reads" | "source_commands" | "takeovers" as which, int(index)):
            named: Mapping[str, tuple[str, ...]] = {
                "reads": plan.reads,
                "source_commands": plan.source_commands,
                "takeovers": plan.takeovers,
            }
            interface = named[str(which)][index]
            texts = (interface, interface.rpartition(".")[0], *interface.split("/"))
            places = (joint_mark(description, plan.name, text) for text in texts if text)
            own = marks.key("controllers", plan.name)
            return next((place for place in places if place != own), own)
        case ("into", int(index)):
            return into_mark(description, plan.name, index)
    return marks.value(*at) if at[2:] else marks.key(*at)


def _every(file: RobotFile, name: str, rate: float | None) -> int:
    """Return the loop cycles per update of a controller; 0 if its rate does not divide the loop's."""
    loop = file.robot.loop.rate
    period_ns = round(1e9 / loop)
    every = rate_divider(rate, period_ns)
    if rate is None or rate_fits(rate, period_ns):
        return every
    problem = "is above" if rate > loop else "does not divide"
    what = f"rate {rate:g} Hz of {name} {problem} the loop's {loop:g} Hz"
    file.error(
        file.at("controllers", name, "rate"), what, f"write the nearest possible rate, {loop / every:.6g}"
    )
    return 0


def _offer(file: RobotFile, name: str, type_name: str, plugins: PlugIns) -> Offer | None:
    ros = ros_type(type_name, plugins.controllers)
    offer = plugins.controllers.get(type_name)
    if offer is None and is_of_file(type_name) and not ros and type_name not in plugins.broken:
        return None  # the unreadable file has been reported
    try:
        return find_offer(name, type_name, plugins)
    except WrongEntry as wrong:
        folder, other = file.description.path.parent, ros or is_of_file(type_name)
        if not other and (meant := class_beside(folder, type_name)):
            wrong = WrongEntry(*(replace(one, fix=f"write {meant}") for one in wrong.mistakes))
        _report(file, wrong)
    # return dxlrun's type, so that the parameters are checked, too
    return plugins.controllers.get(ros[2]) if ros else None


def check_robot(
    file: RobotFile,
    joints: Mapping[str, CompiledJoint],
    poses: Poses,
    controllers: Mapping[str, CompiledController],
) -> None:
    """Add an error for each controller that does not suit the motors, servos, URDF or poses of the robot."""
    robot = file.robot
    plans = {name: joint.plan for name, joint in joints.items()}
    for controller in controllers.values():
        own = [plans[joint] for joint in controller.plan.joints if joint in plans]
        # An unusable motor file, joint or URDF has been reported.
        unread = [one for one in own if one.motor is None and _names_motor(joints[one.name])]
        if unread or len(own) < len(controller.plan.joints) or (poses.urdf is None and robot.model):
            continue
        try:
            require_fit(controller, own, robot.joints, poses.urdf, poses.named)
        except WrongEntry as wrong:
            _report(file, wrong)


def check_motions(
    file: RobotFile, joints: Mapping[str, CompiledJoint], controllers: Mapping[str, CompiledController]
) -> None:
    """Check the speeds of motions in controllers' parameters against those that the joints can reach."""
    for name, controller in controllers.items():
        cls, parameters = controller.offer.controller, controller.parameters
        seen: set[SpeedPeak] = set()  # a motion that follows others is contained in each of them
        try:
            for motion in cls.motions(parameters):
                command = cls.Commands["play"].model_validate({"motion": motion})
                data = np.ascontiguousarray(cls.prepare("play", command, parameters), dtype="<f8")
                seen.update(cls.speed_peaks("play", data, parameters))
        except Exception as error:  # foreign code; nothing else depends on these speeds
            what = f"the speeds of its motions cannot be checked: {type(error).__name__}: {error}"
            text = f"controller {name} ({controller.offer.distribution}): {' '.join(what.split())}"
            file.warning(file.key("controllers", name), text, "correct the parameters, or the plug-in")
            continue
        told: set[tuple[str, str]] = set()
        for peak in sorted(seen, key=lambda peak: -abs(peak.speed)):
            if peak.joint in joints and (peak.joint, peak.at) not in told:
                told.add((peak.joint, peak.at))
                mark = _entry_mark(file.description, ("controllers", name, *peak.at.split(".")))
                where = f" at {peak.time:.3f} s, {peak.where}"
                report_speed(joints[peak.joint].plan, peak.speed, where, mark, file)


def _names_motor(joint: CompiledJoint) -> bool:
    return any(servo.described.motor is not None for servo in joint.servos)


def compile_registers(
    file: RobotFile,
    joints: Mapping[str, CompiledJoint],
    buses: Sequence[BusPlan],
    mechanics: MechanicsPlan,
    controllers: Mapping[str, CompiledController],
) -> tuple[ControllerPlan, ...]:
    """Return the plans of the controllers with the register writes of each servo.

    A register that a servo lacks, or that must not change during a run, is a problem of the file.
    """
    rows = {servo.own_name: servo.row for bus in buses for servo in bus.servos}
    first = len(joints) if mechanics.coupled else 0  # rows of servos follow those of joints
    stages_of_settings = stages(SettingsStage, used_features(file.description))
    change = next(stage.change for _, stage in stages_of_settings if stage.change)
    plans: list[ControllerPlan] = []
    for name, controller in controllers.items():
        writes: dict[RegisterPlan, dict[int, int]] = {}
        for one in controller.registers:
            mark = _entry_mark(file.description, ("controllers", name, *one.at))
            found = writes.setdefault(RegisterPlan(one.joint, one.item, one.value), {})
            if one.joint not in controller.plan.joints:
                what = f"{name} sets registers of {one.joint}, which is not one of its joints"
                file.error(mark, what, f"add {one.joint} to its joints")
            for servo in joints[one.joint].servos if one.joint in joints else ():
                try:
                    raw = change(servo.table, one.item, one.value).value
                    found[first + rows.get(servo.described.name, 0)] = raw
                except UnfitRegister as error:
                    if servo.certain:
                        file.error(mark, f"{servo.described.title}: {error.what}", error.fix)
                except ValueError as error:
                    what, fix = what_and_fix(error)
                    file.error(mark, f"{one.item} of {servo.described.title}: {what}", fix)
        registers = (replace(plan, writes=tuple(found.items())) for plan, found in writes.items())
        plans.append(replace(controller.plan, registers=tuple(registers)))
    return tuple(plans)


def compile_modes(
    file: RobotFile, joints: Mapping[str, CompiledJoint], controllers: Mapping[str, CompiledController]
) -> dict[str, Mode]:
    """Return the operating mode of each joint at start: of its first active controller, else its rest mode.

    A problem is added to the file if the model of a joint lacks a mode that its controllers need, or its rest
    mode.
    """
    able = {name: joint.modes for name, joint in joints.items()}
    for name, joint in joints.items():
        if joint.plan.rest_mode not in able[name]:
            file.error(
                file.at("joints", name, "continuous"),
                f"{joint.table.model} of {name} {LACKS[joint.plan.rest_mode]}, "
                f"so {name} cannot be continuous",
                "remove `continuous`, or use another model",
            )
    for name, controller in controllers.items():
        _check(file, name, controller, joints, able)
    plans = [joint.plan for joint in joints.values()], [one.plan for one in controllers.values()]
    modes = start_modes(*plans)
    _warn_of_slow_takeovers(file, [one.plan for one in controllers.values()], modes)
    return {
        name: mode if mode in able[name] else next(iter(able[name]))
        for name, mode in modes.items()
        if name in able
    }


def _warn_of_slow_takeovers(
    file: RobotFile, plans: Sequence[ControllerPlan], modes: Mapping[str, Mode]
) -> None:
    """Warn if activating others makes a joint change its mode at run time, which takes several cycles."""
    named = {plan.name: plan for plan in plans}
    for plan in plans:
        for index, name in enumerate(plan.takeovers):
            entering = [named[one] for one in (name, *below(plans, name)) if one in named]
            needed = claimed_modes(entering)
            if others := [joint for joint, mode in needed.items() if modes.get(joint, mode) != mode]:
                joint, more = others[0], f" and {len(others) - 1} more" * (len(others) > 1)
                before, after = (one[joint].name.lower().replace("_", " ") for one in (modes, needed))
                file.warning(
                    _graph_mark(file.description, named, ("controllers", plan.name, "takeovers", index)),
                    f"when {plan.name} activates {name}, torque of {joint}{more} is off for some cycles "
                    f"to change from {before} to {after} mode",
                    "give all controllers of these joints the same interfaces",
                )


def _check(
    file: RobotFile,
    name: str,
    controller: CompiledController,
    joints: Mapping[str, CompiledJoint],
    able: Mapping[str, Collection[Mode]],
) -> None:
    if not controller.plan.command or controller.plan.into:
        return
    mode = mode_of(controller.plan.command)
    if (parted := controller.plan.split_group(joint.plan for joint in joints.values())) is not None:
        at, rest = parted
        file.error(
            joint_mark(file.description, name, at),
            f"{name} commands {_INTERFACE[mode]} of {at} only, but the same servos move {' and '.join(rest)}",
            f"command {' and '.join(rest)} in {name} too, or command positions",
        )
        return
    for joint in controller.plan.joints:
        if joint not in joints:
            continue
        model, mark = joints[joint].table.model, joint_mark(file.description, name, joint)
        if mode not in able[joint]:
            *others, last = (_INTERFACE[each] for each in able[joint])
            known = f"command {', '.join(others)}{' or ' * bool(others)}{last}"
            lacks = joints[joint].drive.excluded.get(mode, f"{model} of {joint} {LACKS[mode]}")
            within_a_turn = model_modes(joints[joint].table, continuous=False)
            if mode is Mode.EFFORT_POSITION and mode in within_a_turn:
                lacks = f"this is not possible for the continuous joint {joint}"
                known = f"remove `continuous`, or {known}"
            elif mode is Mode.EFFORT_POSITION and (key := controller.asked_by.get("effort")):
                mark = file.key("controllers", name, *key)
                known = f"remove {key[-1]}, or use another model"
            file.error(mark, f"{name} commands {_INTERFACE[mode]}, but {lacks}", known)
        elif mode is Mode.VELOCITY and not controls_speed(joints[joint].table):
            file.warning(
                mark,
                f"{model} of {joint} does not control speed in wheel mode: a velocity of {name} becomes a "
                "share of full output, and load slows the servo down",
                "command a PWM, or use a model with speed control",
            )
