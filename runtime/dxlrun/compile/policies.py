"""Policies: compiles `policies` and `poses` of the robot file and checks them against robot and timeout."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

from msgspec.structs import replace

from dxlrun.compile.joints.compiled_joints import CompiledJoint
from dxlrun.compile.joints.limits import Interval, degrees, limits_of
from dxlrun.compile.joints.poses import Poses, WrongPose
from dxlrun.compile.problems import RobotFile
from dxlrun.description.document import KeyPath
from dxlrun.description.mistakes.forms import example_at
from dxlrun.description.robot import PoseStep, TorqueStep, WrittenPolicy, pose_stages
from dxlrun.description.units import Measure
from dxlrun.errors import suggestion
from dxlrun.features.feature import PolicyKey, SolvedPose
from dxlrun.plan.policy_plan import (
    HOLD,
    LIMP,
    Last,
    Policy,
    PolicyPlan,
    PolicyStepPlan,
    longest_pose_ns,
)
from dxlwire.bus_plan import BusPlan
from dxlwire.joint_unit import LINEAR, ROTARY, JointUnit
from dxlwire.plan.planning import torque_off_ns

MARGIN_NS = 100_000_000
"""Part of `exit_timeout` reserved for switching torque off, ns, for CPU delays and one retry."""

_EXAMPLES: Mapping[JointUnit, str] = {ROTARY: "60 deg", LINEAR: "20 mm"}


def compile_poses(file: RobotFile, joints: Mapping[str, CompiledJoint], urdf: str | None) -> Poses:
    """Return all poses, checked, and solved if they are in the form of a feature."""
    plans = {name: joint.plan for name, joint in joints.items()}
    wrong = len(plans) < len(file.robot.joints) or (urdf is None and file.robot.model is not None)
    poses = Poses({}, plans, file.description.omitted, urdf, wrong)
    named = dict.fromkeys([*file.description.omitted_poses, *file.robot.poses], SolvedPose({}))
    mistaken = set[str]()
    for name, written in file.robot.poses.items():
        if isinstance(written, dict):
            errors = file.errors
            _check_pose(file, name, written, joints)
            if file.errors != errors:
                mistaken.add(name)
            else:
                named[name] = SolvedPose({joint: float(at) for joint, at in written.items()})
            continue
        try:
            named[name] = poses.solve_pose(written)
        except WrongPose as error:
            if error.lacking in poses.omitted:
                what = f"pose {name} is omitted, because it needs {error.lacking}"
                file.warning(file.key("poses", name), what, f"run with {error.lacking}")
            else:
                mistaken.add(name)
                for path, what, fix in error.problems:
                    file.error(file.at("poses", name, *path), f"{name}: {what}", fix)
    return replace(poses, named=named, mistaken=mistaken)


def compile_policies(
    file: RobotFile,
    joints: Mapping[str, CompiledJoint],
    buses: Sequence[BusPlan],
    keys: Iterable[PolicyKey[WrittenPolicy]],
    poses: Poses,
) -> PolicyPlan:
    """Compile all policies of a file; add errors if steps do not fit the robot or take too long."""
    robot = file.robot
    limit_ns = robot.policies.exit_timeout - _reserve_ns(buses, robot.loop.rate)
    written = {"on_exit": robot.policies.on_exit, "on_fault": robot.policies.on_fault}
    written |= {each.name: each.value_of(robot.policies) for each in keys}
    found: dict[str, Policy] = {}
    for name, steps in written.items():
        found[name] = _policy(file, name, steps, joints, poses)
        if any(step.levels for step in found[name].steps):
            _check_torque(file, name, steps, buses)
        if found[name].steps and found[name].longest_ns > limit_ns:
            _too_long(file, found[name], name, limit_ns)
        if found[name].last == "hold" and (name in ("on_exit", "on_fault") or not found[name].goes_on):
            _check_stopping(file, name, joints, limit_ns - found[name].longest_ns)
    _check_groups(file, joints)
    return PolicyPlan(found.pop("on_exit"), found.pop("on_fault"), max(0, limit_ns), of_features=found)


def _check_pose(
    file: RobotFile, pose: str, positions: Mapping[str, Measure], joints: Mapping[str, CompiledJoint]
) -> None:
    known = tuple(file.robot.joints)
    for joint, position in positions.items():
        if joint not in known:
            mark = file.key("poses", pose, joint)
            what = f"joint {joint} of pose {pose} is not defined"
            forms = (one for one in pose_stages() if joint in one.form.model_fields)
            meant = [
                f"add `{one.name}: {example_at(one.form, (one.name,))}`, or remove {joint}" for one in forms
            ]
            file.error(mark, what, suggestion(joint, known, *meant[:1]))
        elif joint in joints:
            plan = joints[joint].plan
            allowed, mark = limits_of(plan), file.at("poses", pose, joint)
            if plan.unit is not position.joint_unit:
                what = f"{joint} {plan.unit.verb}, so pose {pose} cannot have it in {position.unit}"
                file.error(mark, what, f"write it as {_EXAMPLES[plan.unit]}")
            elif not allowed.contains(Interval(position, position)):
                at = plan.unit.text(position, trim=True)
                what = f"pose {pose} puts {joint} at {at}, outside its limits {allowed}"
                file.error(mark, what, "change the pose or the limits")


def _policy(
    file: RobotFile,
    name: str,
    written: WrittenPolicy,
    joints: Mapping[str, CompiledJoint],
    poses: Poses,
) -> Policy:
    if isinstance(written, str):
        return HOLD if written == "hold" else LIMP
    last: Last = "limp"
    steps: list[PolicyStepPlan] = []
    for index, step in enumerate(written):
        if isinstance(step, str):
            last = "hold" if step == "hold" else "limp"
            if index + 1 < len(written):
                mark = file.at("policies", name, index)
                file.error(mark, f"{name} has steps after {step}", f"write {step} as the last step")
        elif isinstance(step, PoseStep):
            mark_path = ("policies", name, index, "pose")
            try:
                angles = poses.find_named(step.pose).positions
            except WrongPose as wrong:
                for _, *problem in wrong.problems:
                    file.error(file.at(*mark_path), *problem)
            else:
                linear = [joint for joint in angles if joint in joints and joints[joint].plan.unit is LINEAR]
                if linear and step.linear_speed is None:
                    mark = file.at("policies", name, index)
                    what = f"pose {step.pose} of {name} has no speed for the linear joint {linear[0]}"
                    file.error(mark, what, "add linear_speed: 20 mm/s")
                steps.append(_pose(step, angles, joints))
        else:
            steps.append(_less_torque(step))
    return Policy(tuple(steps), last)


def _pose(
    step: PoseStep, positions: Mapping[str, float], joints: Mapping[str, CompiledJoint]
) -> PolicyStepPlan:
    longest = 0
    for name, position in positions.items():
        if name in joints:
            plan = joints[name].plan
            asked = (step.linear_speed or math.inf) if plan.unit is LINEAR else step.speed
            speed = asked if plan.velocity is None else min(asked, plan.velocity)
            # Assume that the joint starts at its farthest limit.
            way = max(plan.upper - position, position - plan.lower)
            ramps = (math.inf, 0.0) if plan.acceleration is None else (plan.acceleration, plan.highest_speed)
            longest = max(longest, longest_pose_ns(way, speed, *ramps, plan.slow_speed))
    return PolicyStepPlan(
        text=f"pose {step.pose} at {degrees(step.speed)} deg/s",
        longest_ns=longest,
        targets=tuple(float(positions[name]) if name in positions else None for name in joints),
        speed=step.speed,
        linear_speed=step.linear_speed,
    )


def _less_torque(step: TorqueStep) -> PolicyStepPlan:
    text = f"torque down to {step.reduce_torque:.0%} in {step.steps} steps over {step.over * 1e-9:g} s"
    return PolicyStepPlan(text=text, longest_ns=step.over, fraction=step.reduce_torque, levels=step.steps)


def _check_torque(file: RobotFile, name: str, steps: WrittenPolicy, buses: Sequence[BusPlan]) -> None:
    index = next(index for index, step in enumerate(steps) if isinstance(step, TorqueStep))
    for servo in (servo for bus in buses for servo in bus.servos):
        if servo.torque_limit is None:
            file.error(
                file.key("policies", name, index, "reduce_torque"),
                f"{name} reduces torque, but the {servo.model} of {servo.joint} has no torque limit in RAM",
                "remove reduce_torque",
            )


def _check_stopping(file: RobotFile, name: str, joints: Mapping[str, CompiledJoint], left_ns: int) -> None:
    """Add an error if a joint brakes too slowly for a policy that holds it, within the time left (ns)."""
    for joint in (joint.plan for joint in joints.values()):
        stop_s = 0.0 if joint.acceleration is None else joint.highest_speed / joint.acceleration
        if stop_s * 1e9 > left_ns:
            file.error(
                file.at("joints", joint.name, "limits", "acceleration"),
                f"{joint.name} may take {stop_s:.2g} s to stop before {name} holds it, but "
                f"{max(left_ns, 0) * 1e-9:.2g} s of exit_timeout are left",
                "raise exit_timeout, or the acceleration limit",
            )


def _check_groups(file: RobotFile, joints: Mapping[str, CompiledJoint]) -> None:
    """Check the groups in `policies`: known joints, each in one group, coupled joints in the same group."""
    known = tuple(file.robot.joints)
    owner: dict[str, str] = {}
    for name, group in file.robot.policies.groups.items():
        at: KeyPath = ("policies", "groups", name)
        own = group.joints
        if not own:
            fix = "add `joints: [...]`, or define it in groups"
            file.error(file.key(*at), f"group {name} has no joints", fix)
        for index, joint in enumerate(own):
            mark = file.at(*at, "joints", index)
            if joint not in known:
                what = f"joint {joint} of group {name} is not defined"
                file.error(mark, what, suggestion(joint, known))
            elif owner.setdefault(joint, name) != name or own.index(joint) < index:
                file.error(mark, f"{joint} is already in group {owner[joint]}", "name each joint once")
        parted = {
            other
            for joint in own
            if joint in joints
            for other in joints[joint].plan.coupled
            if other not in own
        }
        if parted:
            file.error(
                file.at(*at, "joints"),
                f"group {name} has joints of a transmission, but not {' and '.join(sorted(parted))}",
                f"add {' and '.join(sorted(parted))}",
            )


def _reserve_ns(buses: Sequence[BusPlan], rate: float) -> int:
    """Return the part of `exit_timeout` that steps cannot use, ns: two periods, and torque off."""
    return max(map(torque_off_ns, buses), default=0) + round(2e9 / rate) + MARGIN_NS


def _too_long(file: RobotFile, policy: Policy, name: str, limit_ns: int) -> None:
    timeout_ns = file.robot.policies.exit_timeout
    needed_s = (policy.longest_ns + timeout_ns - limit_ns) * 1e-9
    slowest = max(policy.steps, key=lambda step: step.longest_ns)
    origin = " from the farthest limit" if slowest.targets else ""
    file.error(
        file.at("policies", name),
        f"{name} may take {policy.longest_ns * 1e-9:.2f} s ({slowest.text}: up to "
        f"{slowest.longest_ns * 1e-9:.2f} s{origin}), but exit_timeout {timeout_ns * 1e-9:g} s leaves "
        f"{max(limit_ns, 0) * 1e-9:.2f} s",
        f"raise exit_timeout to {-(-needed_s * 10 // 1) / 10:g} s, or shorten its steps",
    )
