"""Compiler: runs every check on a robot and its motions, reports all problems at once, makes the plan."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import msgspec

from dxlrun.compile.buses import compile_buses, slowest_period_ns
from dxlrun.compile.contribution import Compilation, CompileStage, check_source_names
from dxlrun.compile.controllers import (
    check_motions,
    check_robot,
    compile_controllers,
    compile_modes,
    compile_registers,
    read_controller_files,
)
from dxlrun.compile.joints.compiled_joints import (
    CompiledJoint,
    check_limp_joints,
    check_tolerances,
    check_twins,
    compile_joints,
)
from dxlrun.compile.joints.compiled_urdf import compile_frames, compile_urdf
from dxlrun.compile.joints.described_servos import AUTO, used_features
from dxlrun.compile.joints.motors import read_motors
from dxlrun.compile.motion_names import is_name
from dxlrun.compile.orientations import check_orientations
from dxlrun.compile.policies import compile_policies, compile_poses
from dxlrun.compile.problems import RobotFile
from dxlrun.compile.simulation import compile_simulation
from dxlrun.control.controllers.plugin_loading import PlugIns, load_plugins
from dxlrun.description.joints.groups import NO_GROUPS, Groups
from dxlrun.description.joints.joint_forms import Joint
from dxlrun.description.reading import Description, Replacement, read_robot
from dxlrun.description.robot import Loop
from dxlrun.errors import InputError, Problem
from dxlrun.features import stages
from dxlrun.features.feature import Feature, PolicyKey
from dxlrun.installed_plugins import PHYSICS_GROUP, distribution_name, installed_plugins
from dxlrun.plan.loop_plan import MOST_SHARE, LoopPlan, SchedulerPlan
from dxlrun.plan.mechanics_plan import MechanicsPlan
from dxlrun.plan.recording_plan import RecordingPlan
from dxlrun.plan.robot_plan import MotionPart, Plan, SimulationPlan
from dxlwire.bus_plan import SIMULATED, BusPlan

if TYPE_CHECKING:
    from dxlrun.compile.check_report import Row
    from dxlrun.description.motion import MotionDescription
    from dxlrun.output.graph import Graph

Ask: TypeAlias = Callable[[Sequence[BusPlan], Sequence[str]], Mapping[str, str]]
"""Function that reads servo models from the buses: takes bus plans and joints, returns models by joint."""
_HIGHEST = 98  # the guardian needs a higher priority, and 99 is the highest one (sched(7))


class CompiledRobot(msgspec.Struct, frozen=True):
    """Result of a compilation: the plan of a run, the compiled joints and motions, and the warnings."""

    plan: Plan
    plugins: PlugIns  # as loaded to compile it, for a run in this process
    warnings: tuple[Problem, ...]
    rate: float  # rate of the loop in the file, Hz
    joints: tuple[CompiledJoint, ...]
    parts: tuple[MotionPart, ...]
    policies: Mapping[str, str]  # actions of the features' policies while the run continues

    @property
    def report(self) -> Row:
        """All results of the compilation, as `dxlrun check --json` prints them."""
        from dxlrun.compile.check_report import (
            check_report,
        )  # imported here, because only `dxlrun check` needs it

        return check_report(self.plan, self.rate, self.joints, self.parts, self.policies)

    @property
    def drawing(self) -> Graph:
        """Picture of the controller graph of the plan."""
        from dxlrun.compile.check_report import graph_of  # as above

        return graph_of(self.plan.loop).drawing(f"{self.plan.robot}: controllers", self.rate)


def compile_files(
    robot: Path,
    arguments: Mapping[str, str],
    motions: Sequence[Path | str],
    duration_ns: int | None = None,
    ask: Ask | None = None,
    *,
    replacements: Sequence[Replacement] = (),
    without: Sequence[str] = (),
) -> CompiledRobot:
    """Read a robot file and motion files and compile them into the plan of a run.

    Args:
        robot: Robot file.
        arguments: Arguments of the robot file.
        motions: Motion files, or names of motions as text.
        duration_ns: Duration of the run; None: until the last motion ends.
        ask: Reads the models of servos on real ports with `model: auto`; called only after all checks passed.
        replacements: Values that replace those of the robot file.
        without: Joints and groups that are omitted.

    Raises:
        InputError: All problems of form of all files; if there are none, all problems that the checks find.
    """
    description: Description | None = None
    groups: Groups = NO_GROUPS
    omitted: tuple[str, ...] = ()
    read: list[MotionDescription | str] = []
    problems: list[Problem] = []
    try:
        description = read_robot(robot, arguments, replacements, without)
        groups, omitted = description.groups, description.omitted
    except InputError as error:
        problems += error.problems
    for path in motions:
        # imported here, because most checks and runs play no motion
        from dxlrun.description.motion import read_motion

        try:
            named = isinstance(path, str) and is_name(path)
            read.append(str(path) if named else read_motion(Path(path), groups, omitted))
        except InputError as error:
            problems += error.problems
    if description is None or problems:
        raise InputError(problems)
    compiled = compile_robot(description, read, duration_ns)
    unknown = _unknown(description)
    if ask is None or not unknown:
        return compiled
    return compile_robot(description, read, duration_ns, ask(compiled.plan.buses, unknown))


def _unknown(description: Description) -> list[str]:
    """Return the joints on real ports with `model: auto`, whose models must be read from the servos."""
    robot = description.robot
    return [
        name
        for name, joint in robot.joints.items()
        if isinstance(joint, Joint) and joint.model == AUTO and robot.buses[joint.bus].port != SIMULATED
    ]


def compile_robot(
    description: Description,
    motions: Sequence[MotionDescription | str],
    duration_ns: int | None = None,
    models: Mapping[str, str] | None = None,
) -> CompiledRobot:
    """Compile a robot that was read from its files, and motions, into the plan of a run.

    Args:
        description: The robot.
        motions: The motions, or their names.
        duration_ns: Duration of the run. None: it ends after the last motion; without motions it runs until
            it is stopped.
        models: Models that were read from the servos of joints with `model: auto`, by joint.

    Raises:
        InputError: All problems of the robot file and the motions.
    """
    file = RobotFile(description)
    code = read_controller_files(file)
    plugins = load_plugins(files=code)  # Load plug-ins first, because they may provide servo models.
    motors = read_motors(file)
    joints = compile_joints(file, models or {}, motors)
    _check_scheduler(file)
    check_twins(file, {name: joint.table for name, joint in joints.items()})
    body = compile_urdf(file, joints)
    urdf = None if body is None else body.text
    features = used_features(description)
    compilation = Compilation(file, plugins, joints, body)
    by_feature = {
        feature.name: stage.contribute(compilation) for feature, stage in stages(CompileStage, features)
    }
    contributions = tuple(by_feature.values())
    sources = tuple(source for each in contributions for source in each.sources)
    devices = (device for each in contributions for device in each.devices)
    simulation = compile_simulation(file, joints, devices, motors)
    poses = compile_poses(file, joints, urdf)
    controllers = compile_controllers(file, plugins, contributions, poses)
    providers = {one.name: one.states for one in sources} | {
        name: one.plan.provides for name, one in controllers.items() if one.plan.provides
    }
    frames = compile_frames(file, body, providers)
    if body is not None:
        check_orientations(file, body.urdf, frames, contributions, controllers)
    check_source_names(file, by_feature, (one.plan for one in controllers.values()))
    check_limp_joints(file, (one.plan for one in controllers.values()))
    check_tolerances(file, joints, (one.plan for one in controllers.values()))
    check_robot(file, joints, poses, controllers)
    check_motions(file, joints, controllers)
    buses = compile_buses(file, joints, contributions, compile_modes(file, joints, controllers))
    mechanics = next((each.mechanics for each in contributions if each.mechanics), MechanicsPlan())
    planned = compile_registers(file, joints, buses, mechanics, controllers)
    policy_keys = [one for _, one in stages(PolicyKey, features) if one.does]
    policies = compile_policies(file, joints, buses, policy_keys, poses)
    parts: list[MotionPart] = []
    played: list[MotionDescription] = []
    if motions:
        from dxlrun.compile.motions import check_times, compile_motions  # as above

        played, parts = compile_motions(motions, controllers, joints, file, poses)
        check_times(parts, duration_ns, file)
    file.raise_errors()
    if duration_ns is None and all(part.points for part in parts):
        # The approach of a controller's own motion takes a time that is not known before the run.
        duration_ns = max((part.end_ns or 0 for part in parts), default=None)
    settings = file.robot.loop
    loop = LoopPlan(
        period_ns=round(1e9 / settings.rate),
        scheduler=_scheduler_plan(settings),
        joints=tuple(joint.plan for joint in joints.values()),
        controllers=planned,
        commands=tuple(
            sorted((each for part in parts for each in part.commands), key=lambda each: each.at_ns)
        ),
        end_ns=duration_ns,
        ends_with_goals=duration_ns is None and bool(parts),
        policies=policies,
        overrun=settings.overrun,
        tolerated_skips=settings.tolerated_skips,
        least_period_ns=_least_period_ns(settings, buses),
        slowest_period_ns=slowest_period_ns(buses),
        sources=sources,
        urdf=urdf,
        features=features,
        feature_plans={name: each.plan for name, each in by_feature.items() if each.plan},
    )
    texts = {**description.included, **motors.texts}
    shown = {one.name: one.does for one in policy_keys}
    for each in contributions:
        texts |= each.texts
        shown |= each.policies
    robot, folder = description.robot, description.path.parent
    plan = Plan(
        robot=robot.name,
        loop=loop,
        buses=tuple(buses),
        exit_timeout_ns=robot.policies.exit_timeout,
        recording=next((each.recording for each in contributions if each.recording), RecordingPlan()),
        source_file=str(description.path),
        source_text=description.text,
        arguments=dict(description.arguments),
        included={os.path.relpath(name, folder): text for name, text in texts.items()} | code,
        played={os.path.relpath(motion.path, folder): motion.text for motion in played},
        frames=frames,
        simulation=simulation,
        groups=description.groups,
        poses=dict(poses.named),
        omitted=description.omitted,
        gateway=robot.processes.gateway.enabled,
        packages=plugins.packages_of(loop.controllers, _models(buses))
        | {package: name for each in contributions for package, name in each.packages.items()}
        | _physics(simulation, buses)
        | _packages(features),
        mechanics=mechanics,
    )
    return CompiledRobot(
        plan, plugins, file.warnings, settings.rate, tuple(joints.values()), tuple(parts), shown
    )


def _models(buses: Iterable[BusPlan]) -> frozenset[str]:
    """Return the models of all servos and devices on the buses."""
    servos = {servo.model for bus in buses for servo in bus.servos}
    return frozenset(servos | {device.model for bus in buses for device in bus.devices})


def _packages(features: Iterable[Feature]) -> dict[str, str]:
    """Return package and distribution of each plug-in whose feature the robot file uses."""
    return {
        each.package.partition(".")[0]: distribution_name(each.distribution)
        for each in features
        if each.distribution
    }


def _physics(simulation: SimulationPlan, buses: Iterable[BusPlan]) -> dict[str, str]:
    """Return package and distribution of the physics simulator; empty if no bus is simulated."""
    if not any(bus.port == SIMULATED for bus in buses):
        return {}
    return {
        each.point.module.partition(".")[0]: distribution_name(each.publisher)
        for each in installed_plugins(PHYSICS_GROUP)
        if each.name == simulation.physics
    }


def _check_scheduler(file: RobotFile) -> None:
    """Check priority, polling and stop latency of the loop in the file, not what this machine grants."""
    loop = file.robot.loop
    scheduler, timeout_ns = loop.scheduler, file.robot.policies.exit_timeout
    if 1e9 / loop.rate >= timeout_ns:
        file.warning(
            file.at("loop", "rate"),
            f"at {loop.rate:g} Hz the loop can stop up to {1 / loop.rate:.3g} s late, but the guardian ends "
            f"it after exit_timeout ({timeout_ns * 1e-9:g} s)",
            "raise policies.exit_timeout, or the rate",
        )
    if scheduler.policy != "other" and scheduler.priority > _HIGHEST:
        file.warning(
            file.at("loop", "scheduler", "priority"),
            f"no priority above {scheduler.priority} is left for the guardian",
            f"write {_HIGHEST} or less",
        )
    if scheduler.polling != "auto" and scheduler.polling * MOST_SHARE > round(1e9 / loop.rate):
        file.error(
            file.at("loop", "scheduler", "polling"),
            f"polling {scheduler.polling / 1e6:g} ms is over half of the period, {1e3 / loop.rate:.3g} ms",
            "write a shorter time, or auto",
        )


def _scheduler_plan(loop: Loop) -> SchedulerPlan:
    """Return the operating system's scheduling settings for the loop's process."""
    scheduler = loop.scheduler
    return SchedulerPlan(
        policy=scheduler.policy,
        priority=scheduler.priority,
        lock_memory=scheduler.lock_memory,
        cores=scheduler.cores or (),
        polling_ns=None if scheduler.polling == "auto" else scheduler.polling,
        reply_polling_ns=None if scheduler.reply_polling == "auto" else scheduler.reply_polling,
        idle_latency=scheduler.idle_latency,
    )


def _least_period_ns(loop: Loop, buses: Sequence[BusPlan]) -> int:
    """Return the shortest possible loop period, ns: the longest cycle of a bus, as buses work in parallel.

    Not more than the file's own period, which was checked against the same budget.
    """
    slowest = max((bus.budget.total_ns for bus in buses), default=0)
    return min(slowest, round(1e9 / loop.rate))
