"""Verbs: options that the commands of dxlrun share, and their errors.

A verb is a function that a plug-in registers with the hook `dxlrun_commands`. It returns the exit code: 0
success, 1 the robot or the run failed, 2 wrong input. `InputError` is printed and becomes 2.

    from dxlrun.tooling.verbs import Assignment, RobotPath, compiled

    def joints(robot: RobotPath, *assignments: Assignment) -> int:
        print(*(joint.name for joint in compiled(robot, assignments, (), None).plan.loop.joints))
        return 0
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dxlwire.faces import lazy_face

if TYPE_CHECKING:
    from dxlrun.cli.inputs import Assignment as Assignment
    from dxlrun.cli.inputs import AssignmentOfItsOwn as AssignmentOfItsOwn
    from dxlrun.cli.inputs import DebugFlag as DebugFlag
    from dxlrun.cli.inputs import Flag as Flag
    from dxlrun.cli.inputs import JsonFlag as JsonFlag
    from dxlrun.cli.inputs import JsonOfItsOwn as JsonOfItsOwn
    from dxlrun.cli.inputs import RecordFlag as RecordFlag
    from dxlrun.cli.inputs import RobotName as RobotName
    from dxlrun.cli.inputs import RobotPath as RobotPath
    from dxlrun.cli.inputs import Seconds as Seconds
    from dxlrun.cli.inputs import StressFlag as StressFlag
    from dxlrun.cli.inputs import check_report as check_report
    from dxlrun.cli.inputs import compiled as compiled
    from dxlrun.cli.inputs import examples_directory as examples_directory
    from dxlrun.cli.inputs import known_file as known_file
    from dxlrun.cli.inputs import parse_assignments as parse_assignments
    from dxlrun.cli.inputs import parse_size as parse_size
    from dxlrun.cli.inputs import read_models as read_models
    from dxlrun.cli.inputs import terminated_as_interrupted as terminated_as_interrupted
    from dxlrun.cli.inputs import write_report as write_report
    from dxlrun.cli.steering.goals import cancel_goals as cancel_goals
    from dxlrun.cli.steering.steer import connect_robot as connect_robot
    from dxlrun.description.units import angle as angle
    from dxlrun.description.units import angular_velocity as angular_velocity
    from dxlrun.description.units import duration as duration
    from dxlrun.errors import missing_extra as missing_extra
else:
    __getattr__, __dir__ = lazy_face(__name__, __file__)
