"""Policies for hot servos against the robot."""

from __future__ import annotations

import msgspec

from dxlrun.tooling.features import Compilation, CompileStage, Contribution, PolicyEntry
from dxlrun_hot.policy_key import HotServo

MOST = 100.0  # degC


def compile_hot_servo(compilation: Compilation) -> Contribution:
    file, plan = compilation.file, {}
    policies = file.robot.policies
    for joint in compilation.joints:
        hot = policies.of_joint("on_hot_servo", joint)
        if isinstance(hot, HotServo):
            plan[joint] = hot.above, hot.do
            if hot.above > MOST:
                place = file.at("policies", "on_hot_servo", "above")
                file.error(place, f"no servo works at {hot.above:g} degC", f"write {MOST:g} degC at most")
    if not plan:
        return Contribution()
    does = ", ".join(f"{joint} above {above:g} degC: {do}" for joint, (above, do) in plan.items())
    return Contribution(policies=(PolicyEntry("on_hot_servo", does),), plan=msgspec.json.encode(plan))


STAGE = CompileStage(compile_hot_servo)
