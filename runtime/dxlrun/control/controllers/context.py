"""Context: what a controller gets when it is configured, made from its plan."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from dxlrun.control.controllers.controller import Context, JointLimits
from dxlrun.control.controllers.gathering import Gathering
from dxlrun.control.loop_plan import ControllerPlan, JointPlan
from dxlrun.run.channels.cycle import Commands, Floats


def new_context(
    plan: ControllerPlan,
    joints: Sequence[JointPlan],
    gathering: Gathering,
    *,
    period_ns: int,
    say: Callable[[str], None],
    publish: Callable[[], None],
) -> Context:
    """Return a controller's arrays and limits, in the order of its joints; `period_ns` is the loop's."""
    return Context(
        name=plan.name,
        joints=plan.joints,
        period_ns=plan.every * period_ns,
        limits=JointLimits(
            lower=_row([joint.lower if joint.bounded else -np.inf for joint in joints]),
            upper=_row([joint.upper if joint.bounded else np.inf for joint in joints]),
            velocity=_row([joint.velocity for joint in joints]),
            effort=_row([joint.effort for joint in joints]),
        ),
        states=gathering.states,
        goals=gathering.goals,
        commands=Commands.empty(len(joints)),
        say=say,
        publish=publish,
    )


def _row(values: Sequence[float | None]) -> Floats:
    """Return the values of the joints; NaN where there is none."""
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)
