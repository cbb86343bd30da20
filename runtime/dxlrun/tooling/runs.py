"""Runs: a robot in its own processes or on virtual time, or its controllers on a recorded run.

`dxlrun.testing.simulated_robot` makes a virtual run of a robot file in one call.

    from pathlib import Path

    from dxlrun import open_log
    from dxlrun.tooling.plans import from_json
    from dxlrun.tooling.runs import VirtualRobot

    plan = from_json(open_log("run.mcap").attachments["plan.json"])
    robot = VirtualRobot(plan, log=Path("again.mcap"))
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dxlwire.faces import lazy_face

if TYPE_CHECKING:
    from dxlrun.control.recorded_run import RecordedRun as RecordedRun
    from dxlrun.control.recorded_run import RunInputs as RunInputs
    from dxlrun.control.recorded_run import kept_states_of as kept_states_of
    from dxlrun.run.run_log import discard_log as discard_log
    from dxlrun.run.run_log import new_log as new_log
    from dxlrun.run.run_summary import RunOptions as RunOptions
    from dxlrun.run.supervisor import run_robot as run_robot
    from dxlrun.run.virtual_run import VirtualRobot as VirtualRobot
    from dxlrun.testing.virtual_link import VirtualLink as VirtualLink
else:
    __getattr__, __dir__ = lazy_face(__name__, __file__)
