"""Plans: the compiled robot, as executed by a run and stored in each log.

Plans are frozen structs in SI units. `dxlwire.BusPlan` describes the packets of a bus.

    from dxlrun import open_log
    from dxlrun.tooling.plans import Plan, from_json

    plan: Plan = from_json(open_log("run.mcap").attachments["plan.json"])
    print(plan.robot, [joint.name for joint in plan.loop.joints])
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dxlwire.faces import lazy_face

if TYPE_CHECKING:
    from dxlrun.plan.loop_plan import ControllerPlan as ControllerPlan
    from dxlrun.plan.loop_plan import JointPlan as JointPlan
    from dxlrun.plan.loop_plan import LoopPlan as LoopPlan
    from dxlrun.plan.loop_plan import Policy as Policy
    from dxlrun.plan.loop_plan import ScheduledCommand as ScheduledCommand
    from dxlrun.plan.loop_plan import ScheduleName as ScheduleName
    from dxlrun.plan.loop_plan import SchedulerPlan as SchedulerPlan
    from dxlrun.plan.loop_plan import ServoLimit as ServoLimit
    from dxlrun.plan.mechanics_plan import MechanicsPlan as MechanicsPlan
    from dxlrun.plan.played_goals import UnreachedGoal as UnreachedGoal
    from dxlrun.plan.played_goals import find_unreached_goals as find_unreached_goals
    from dxlrun.plan.played_goals import motion_name as motion_name
    from dxlrun.plan.played_goals import played_name as played_name
    from dxlrun.plan.policy_plan import PolicyPlan as PolicyPlan
    from dxlrun.plan.recording_plan import RecordingPlan as RecordingPlan
    from dxlrun.plan.robot_plan import Plan as Plan
    from dxlrun.plan.robot_plan import decode_plan as decode_plan
    from dxlrun.plan.robot_plan import from_json as from_json
else:
    __getattr__, __dir__ = lazy_face(__name__, __file__)
