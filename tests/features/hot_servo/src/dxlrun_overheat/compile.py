"""Steps of the policy; the compiler checks them."""

from __future__ import annotations

from dxlrun.tooling.features import Compilation, CompileStage, Contribution, PolicyEntry
from dxlrun_overheat.policy_key import STAGE as ON_OVERHEAT


def compile_overheat(compilation: Compilation) -> Contribution:
    steps = ON_OVERHEAT.of(compilation.file.robot.policies)
    return Contribution(policies=(PolicyEntry("on_overheat", "continue", steps),))


STAGE = CompileStage(compile_overheat)
