"""The compiler: every check in turn, all problems at once, then the plan."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from dxlrun.compile.buses import SIMULATED, compile_buses
from dxlrun.compile.checks.left_out import left_out_names, still_true
from dxlrun.compile.checks.problems import Problems
from dxlrun.compile.controllers import compile_controllers
from dxlrun.compile.health import slowest_period_ns
from dxlrun.compile.joint.joints import AUTO, compile_joints
from dxlrun.compile.joint.modes import compile_modes
from dxlrun.compile.joint.twins import check_twins
from dxlrun.compile.joint.urdf import compile_urdf
from dxlrun.compile.motion.motions import compile_motion
from dxlrun.compile.plan import Plan, SimulationPlan
from dxlrun.compile.policies import compile_policies
from dxlrun.compile.report import Checked, CheckReport, check_report
from dxlrun.compile.scheduler import check_scheduler, least_period_ns, scheduler_plan
from dxlrun.compile.simulation import compile_simulation
from dxlrun.control.controllers.plugins import load_plugins
from dxlrun.control.loop_plan import LoopPlan
from dxlrun.description import Description, MotionDescription, Survey, read_motion, survey_robot
from dxlrun.dynamixel.plan.bus_plan import BusPlan
from dxlrun.errors import InputError, Problem

Ask: TypeAlias = Callable[[Sequence[BusPlan], Sequence[str]], Mapping[str, str]]
"""Asks the servos of joints for their models: takes the buses and the joints, returns models by joint."""


@dataclass(frozen=True, slots=True)
class Compiled:
    """A plan that can be run, and what a person should know about it."""

    plan: Plan
    warnings: tuple[Problem, ...]
    report: CheckReport


def compile_files(
    robot: Path,
    arguments: Mapping[str, str],
    motions: Sequence[Path],
    duration_ns: int | None = None,
    ask: Ask | None = None,
) -> Compiled:
    """Read robot file and motion files and compile them; raises InputError with the problems of all files.

    Only when nothing is wrong, servos on real ports whose joints say `model: auto` are asked, if `ask` is
    given; what it raises goes on.
    """
    read: list[MotionDescription] = []
    survey = Survey(None, ())
    problems: list[Problem] = []
    try:
        survey = survey_robot(robot, arguments)
        problems += survey.problems
    except InputError as error:
        problems += _placed(error)
    for path in motions:
        try:
            read.append(read_motion(path))
        except InputError as error:
            problems += _placed(error)
    description = survey.description
    if not problems and description is not None:
        compiled = compile_robot(description, read, duration_ns)
        unknown = _unknown(description)
        if ask is None or not unknown:
            return compiled
        return compile_robot(description, read, duration_ns, ask(compiled.plan.buses, unknown))
    if description is not None:
        found = _problems_of(description, read, duration_ns)
        if survey.otherwise is not None:
            also = {(one.mark, one.what) for one in _problems_of(survey.otherwise, read, duration_ns)}
            found = [problem for problem in found if (problem.mark, problem.what) in also]
        problems += found
    raise InputError(sorted(problems, key=lambda problem: (problem.severity, problem.mark)))


def _problems_of(
    description: Description, motions: Sequence[MotionDescription], duration_ns: int | None
) -> list[Problem]:
    """Return the errors of a survey's description that have nothing to do with what was left out of it."""
    try:
        compile_robot(description, motions, duration_ns)
    except InputError as error:
        return [*still_true(description, _placed(error))]
    return []


def _unknown(description: Description) -> list[str]:
    """Return the joints whose servos must be asked for their models, and can be."""
    robot = description.robot
    return [
        name
        for name, joint in robot.joints.items()
        if joint.model == AUTO and robot.buses[joint.bus].port != SIMULATED
    ]


def _placed(error: InputError) -> tuple[Problem, ...]:
    """Return the problems of an error; an error that names no place cannot be listed and is raised again."""
    if not error.problems:
        raise error
    return error.problems


def compile_robot(
    description: Description,
    motions: Sequence[MotionDescription],
    duration_ns: int | None = None,
    models: Mapping[str, str] | None = None,
) -> Compiled:
    """Turn a description and motions into a plan.

    The run ends by itself after `duration_ns`, else when the last motion has ended, else when it is told to.
    `models` are those that the servos of joints with `model: auto` gave when they were asked, by joint.
    Raises InputError with every problem of the robot file and the motions.
    """
    problems = Problems()
    plugins = load_plugins()  # first, as they may bring the servo models of joints along
    joints = compile_joints(description, problems, models or {})
    check_scheduler(description, problems)
    check_twins(description, {name: joint.table for name, joint in joints.items()}, problems)
    urdf = compile_urdf(description, joints, problems)
    simulation = compile_simulation(description, joints, problems)
    controllers = compile_controllers(description, plugins, problems)
    modes = compile_modes(description, joints, controllers, problems)
    buses = compile_buses(description, joints, modes, problems)
    policies = compile_policies(description, joints, buses, problems)
    names = (*description.robot.controllers, *left_out_names(description, "controllers"))
    parts = [
        part for motion in motions for part in compile_motion(motion, controllers, names, joints, problems)
    ]
    problems.refuse()
    end_ns = duration_ns
    if end_ns is None and parts:
        end_ns = max(part.end_ns for part in parts)
    checked = Checked(description, joints, buses, controllers, parts, end_ns, policies)
    return Compiled(_plan(checked, urdf, simulation), problems.warnings, check_report(checked))


def _plan(checked: Checked, urdf: str | None, simulation: SimulationPlan) -> Plan:
    description, robot = checked.description, checked.description.robot
    commands = [command for part in checked.parts for command in part.commands]
    loop = LoopPlan(
        period_ns=round(1e9 / robot.loop.rate),
        scheduler=scheduler_plan(robot.loop),
        joints=tuple(joint.plan for joint in checked.joints.values()),
        controllers=tuple(controller.plan for controller in checked.controllers.values()),
        commands=tuple(sorted(commands, key=lambda command: command.at_ns)),
        end_ns=checked.end_ns,
        policies=checked.policies,
        overrun=robot.loop.overrun,
        tolerated_skips=robot.loop.tolerated_skips,
        least_period_ns=least_period_ns(robot.loop, checked.buses),
        slowest_period_ns=slowest_period_ns(checked.buses),
    )
    return Plan(
        robot=robot.name,
        loop=loop,
        buses=tuple(checked.buses),
        exit_timeout_ns=robot.policies.exit_timeout,
        recording_directory=robot.recording.directory,
        source_file=str(description.path),
        source_text=description.text,
        arguments=dict(description.arguments),
        included={
            os.path.relpath(file, description.path.parent): text
            for file, text in description.included.items()
        },
        urdf=urdf,
        simulation=simulation,
        gateway=robot.processes.gateway.enabled,
    )
