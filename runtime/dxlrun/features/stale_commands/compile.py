"""Policy for stale commands."""

from __future__ import annotations

from dxlrun.compile.contribution import Compilation, CompileStage, Contribution, PolicyEntry
from dxlrun.features.stale_commands.policy_key import STAGE as ON_STALE_COMMAND


def compile_stale_commands(compilation: Compilation) -> Contribution:
    """Return the policy of the robot."""
    steps = ON_STALE_COMMAND.of(compilation.file.robot.policies)
    entry = PolicyEntry("on_stale_command", "hold its joints until the next command", steps)
    return Contribution(policies=(entry,))


STAGE = CompileStage(compile_stale_commands)
