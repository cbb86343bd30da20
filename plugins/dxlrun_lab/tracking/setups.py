"""Set-ups of the tracking experiment: how the motion is sent, and the operating system's scheduling policy.

The thesis (M. A. Araujo, UFU 2017, section 5.3.3) measures three of them. It does not measure the fourth, a
sequential sender on the real-time scheduler.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
from msgspec.structs import replace

from dxlrun import InputError
from dxlrun.tooling.files import suggestion
from dxlrun.tooling.plans import Plan, ScheduleName
from dxlrun.tooling.realtime import missing_priority


class Setup(msgspec.Struct, frozen=True):
    """Schedule and scheduling policy of a run. All other settings are those of an ordinary run."""

    name: str
    title: str
    schedule: ScheduleName
    """`absolute`: the loop by the clock; `sequential`: a sender that counts poses instead of time"""
    real_time: bool
    """True for the real-time scheduler of the robot file, false for the ordinary one"""
    thesis: str
    """Figures of the thesis that show it"""

    def plan(self, plan: Plan) -> Plan:
        """Return a robot's plan with the schedule and the scheduling policy of this set-up."""
        scheduler = plan.loop.scheduler
        if not self.real_time:
            scheduler = replace(scheduler, policy="other")
        elif scheduler.policy == "other":
            scheduler = replace(scheduler, policy="round_robin")
        return replace(plan, loop=replace(plan.loop, schedule=self.schedule, scheduler=scheduler))


SETUPS = (
    Setup(
        "sequential-normal", "sequential sender, normal scheduler", "sequential", False, "Figures 31 and 32"
    ),
    Setup("loop-normal", "loop, normal scheduler", "absolute", False, "Figure 33"),
    Setup("loop-realtime", "loop, real-time scheduler", "absolute", True, "Figure 34"),
    Setup("sequential-realtime", "sequential sender, real-time scheduler", "sequential", True, "no figure"),
)
_BY_NAME = {setup.name: setup for setup in SETUPS}


def chosen(names: Sequence[str]) -> tuple[Setup, ...]:
    """Return the set-ups with these names, in the order of SETUPS. Raises InputError for an unknown name."""
    for name in names:
        if name not in _BY_NAME:
            raise InputError(f"unknown set-up {name!r}; {suggestion(name, tuple(_BY_NAME))}")
    return tuple(setup for setup in SETUPS if setup.name in names)


def require_right(setups: Sequence[Setup], plan: Plan) -> None:
    """Raise InputError if a set-up needs a real-time priority that the operating system denies this user."""
    real_time = [one for one in setups if one.real_time]
    missing = [line for one in real_time if (line := missing_priority(one.plan(plan).loop.scheduler))]
    if not missing:
        return
    refused = " and ".join(one.name for one in real_time)
    normal = ",".join(one.name for one in SETUPS if not one.real_time)
    raise InputError(
        f"this user may not use real-time priority, required by {refused}; run `{missing[0]}` and log in "
        f"again, or omit {refused} with --setups {normal}"
    )
