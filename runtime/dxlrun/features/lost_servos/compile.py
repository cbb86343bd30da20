"""Policies for lost servos, of the robot and of its groups."""

from __future__ import annotations

from dxlrun.compile.contribution import Compilation, CompileStage, Contribution, PolicyEntry
from dxlrun.features.lost_servos.policy_key import OF_GROUP
from dxlrun.features.lost_servos.policy_key import STAGE as ON_LOST_SERVO
from dxlrun.plan.policy_plan import GroupPolicy

_GROUP_ACTIONS = {
    "hold": "hold their controllers until it answers, the others go on",
    "limp": "the group goes limp, the others go on",
    "stop": "end the run by on_fault",
}


def compile_lost_servos(compilation: Compilation) -> Contribution:
    """Return the policy of the robot, and the policies of groups with their own."""
    policies = compilation.file.robot.policies
    rows = {name: row for row, name in enumerate(compilation.joints)}
    groups = tuple(
        GroupPolicy(name, frozenset(rows[joint] for joint in group.joints if joint in rows), action)
        for name, group in policies.groups.items()
        if (action := OF_GROUP.of(group)) is not None
    )
    held = "hold its controllers until it answers, the others go on"
    return Contribution(
        policies=(
            PolicyEntry("on_lost_servo", held, ON_LOST_SERVO.of(policies)),
            *(
                PolicyEntry(f"on_lost_servo of {one.name}", _GROUP_ACTIONS[one.on_lost_servo])
                for one in groups
            ),
        ),
        group_policies=groups,
    )


STAGE = CompileStage(compile_lost_servos)
