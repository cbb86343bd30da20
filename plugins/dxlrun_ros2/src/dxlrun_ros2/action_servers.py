"""Action servers FollowJointTrajectory and GripperCommand, which send goals to a running robot."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from control_msgs.action import FollowJointTrajectory, GripperCommand
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node

from dxlrun import DxlrunError, Floats, GoalState, InputError, Refused, RemoteGoal, RemoteRobot, connect
from dxlrun.tooling.live import ControllerInfo
from dxlrun_controllers.laws.spline import SplineSample
from dxlrun_ros2 import CLIENT
from dxlrun_ros2.controller_manager import info_of
from dxlrun_ros2.published_run import PublishedRun
from dxlrun_ros2.trajectories import (
    ValidatedTrajectory,
    goal_fields,
    point,
    wanted,
)

Result = FollowJointTrajectory.Result
FEEDBACK_S = 0.05
"""Period of the feedback of a goal, s"""
STATE_S = 1.0
"""Timeout for the state of a gripper after the end of its goal, s"""
CLIENT_S = 1.0
"""Time without a client of the action after which a goal is cancelled, s"""
_FAR_S = 10.0
"""Duration of the goal that stops joints and is cancelled at once, s"""
_CYCLE_S = 0.01
"""Polling period while the record of a goal's last cycle is awaited, s"""
_MEASURED_S = 5.0
"""Longest wait for the record of the cycle in which a goal ended, s"""
Seen: TypeAlias = tuple[int, float, Floats, Floats]
"""State of a trajectory's joints in one cycle: time (ns since 1970), time since the goal was accepted (s),
desired and measured positions and velocities (shape (2, joints))"""


class Action:
    """ROS 2 action server of a controller. Each action goal of a client becomes one goal of the robot."""

    kind: type
    """ROS 2 type of the action"""
    name: str
    """Last part of the action's name CONTROLLER/NAME"""

    def __init__(self, node: Node, run: PublishedRun, controller: ControllerInfo) -> None:
        self.node, self.run, self.controller = node, run, controller
        name = f"{controller.name}/{self.name}"
        self._server = ActionServer(
            node,
            self.kind,
            name,
            self._run_goal,
            goal_callback=self._respond_to_goal,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
            callback_group=ReentrantCallbackGroup(),
        )
        self._clients = f"{name}/_action/send_goal"

    def check_goal(self, request: FollowJointTrajectory.Goal | GripperCommand.Goal) -> None:
        """Check an action goal before it is accepted. Raises DxlrunError with the reason to reject it."""

    def execute_goal(self, handle: ServerGoalHandle, robot: RemoteRobot) -> object:
        """Execute an accepted action goal on the robot.

        Sets the final state of the handle and returns the action's result. Raises DxlrunError.
        """
        raise NotImplementedError

    def failed(self, why: str, code: int = Result.INVALID_GOAL) -> object:
        """Return the action's result for a goal that failed, with reason and error code."""
        raise NotImplementedError

    def _respond_to_goal(self, request: FollowJointTrajectory.Goal | GripperCommand.Goal) -> GoalResponse:
        try:
            self.check_goal(request)
            # The run is asked, because the newest cycle may precede a switch.
            with connect(self.run.address, CLIENT) as robot:
                active = {one.name for one in info_of(robot).controllers if one.active}
            if self.controller.name not in active:
                raise Refused(f"{self.controller.name} is not active")
        except DxlrunError as error:
            self.node.get_logger().error(f"goal rejected: {error}")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _run_goal(self, handle: ServerGoalHandle) -> object:
        try:
            with connect(self.run.address, f"{CLIENT} action") as robot:
                return self.execute_goal(handle, robot)
        except DxlrunError as error:
            self.node.get_logger().error(str(error))
            handle.abort()
            return self.failed(str(error))

    def wait_for_goal(
        self, handle: ServerGoalHandle, robot: RemoteRobot, goal: RemoteGoal, look: Callable[[GoalState], str]
    ) -> tuple[GoalState, str]:
        """Wait until a goal has ended and the record of its last cycle has arrived.

        If the action's client cancels or has exited, the goal is cancelled. It ends when the joints are at
        rest.

        Args:
            handle: Goal of the action.
            robot: Connection to the robot.
            goal: Goal of the robot.
            look: Called every FEEDBACK_S with the state of the goal. It returns a reason to cancel the goal,
                or an empty text.

        Returns:
            The final state, and the reason why the bridge cancelled the goal (empty if it did not).

        Raises:
            DxlrunError: The run or the bridge ends.
        """
        why, cancelled, seen = "", False, time.monotonic()
        while (state := robot.goal_state(goal.number, FEEDBACK_S)).status == "running":
            if self.run.ended.is_set():
                raise DxlrunError(self.run.why or "the bridge is shutting down")
            why = why or look(state)
            if self.node.count_clients(self._clients):
                seen = time.monotonic()
            elif time.monotonic() > seen + CLIENT_S:
                why = why or "the client of the action has exited"
            if (why or handle.is_cancel_requested) and not cancelled:
                cancelled = True
                try:
                    goal.cancel()
                except Refused as refused:
                    if refused.code not in ("goal_ended", "cancelled_already"):
                        raise
        # The result must report measurements from the end of the goal.
        until = time.monotonic() + _MEASURED_S
        while self.run.time_s < (state.ended or 0.0) and time.monotonic() < until:
            if self.run.ended.is_set():
                break  # there are no more cycles, and the bridge waits only shortly for results
            time.sleep(_CYCLE_S)
        return state, why


class FollowTrajectory(Action):
    """control_msgs/FollowJointTrajectory of a trajectory controller, also for a subset of its joints"""

    kind, name = FollowJointTrajectory, "follow_joint_trajectory"

    def check_goal(self, request: FollowJointTrajectory.Goal) -> None:
        """Check trajectory and tolerances before a goal is accepted. Raises InputError with the reason."""
        if request.multi_dof_trajectory.points:
            raise InputError(
                "the controller has no joints with several degrees of freedom; omit multi_dof_trajectory"
            )
        goal_fields(request, self.controller.joints)
        if request.trajectory.points:
            self._wanted(request)

    def _wanted(self, request: FollowJointTrajectory.Goal) -> ValidatedTrajectory:
        now = self.node.get_clock().now().nanoseconds * 1e-9
        return wanted(request.trajectory, self.controller.joints, now)

    def failed(self, why: str, code: int = Result.INVALID_GOAL) -> object:
        """Return the FollowJointTrajectory result of a goal that failed, with reason and error code."""
        return Result(error_code=code, error_string=why)

    def execute_goal(self, handle: ServerGoalHandle, robot: RemoteRobot) -> object:
        """Follow the trajectory of an action goal. A trajectory without points stops the joints."""
        request = handle.request
        if not request.trajectory.points:
            state, _ = self.wait_for_goal(
                handle, robot, stopped(robot, self.run, self.controller), lambda _: ""
            )
            handle.succeed()
            return Result(error_string=f"stopped in place: {state.status}")
        try:
            plan = self._wanted(request)
            fields = goal_fields(request, plan.joints)
        except InputError as error:  # the last point has passed since the goal was accepted
            handle.abort()
            return self.failed(str(error), Result.OLD_HEADER_TIMESTAMP)
        watch = Watch(self.run, plan)
        self.run.seen.add(watch.update_states)
        try:
            goal = _sent(robot, self.controller, "trajectory", plan.build_command() | fields)

            def publish_feedback(state: GoalState) -> str:
                watch.start_timing(state)
                if watch.newest is not None:
                    handle.publish_feedback(watch.feedback(watch.newest))
                return ""

            state, why = self.wait_for_goal(handle, robot, goal, publish_feedback)
            if why:
                handle.abort()
                return self.failed(why)
            if state.reached:
                handle.succeed()
                return Result(error_string=state.text)
            if handle.is_cancel_requested:
                handle.canceled()
                return Result(error_string=f"{state.status}, the joints are at rest")
            handle.abort()
            return self.failed(state.text or state.status, self._code(state))
        finally:
            self.run.seen.discard(watch.update_states)

    def _code(self, state: GoalState) -> int:
        """Return the error code of FollowJointTrajectory for a goal that was not reached."""
        if state.status == "missed":
            return int(Result.GOAL_TOLERANCE_VIOLATED)
        left = state.status == "aborted" and state.error is not None  # one that never began has no error
        return int(Result.PATH_TOLERANCE_VIOLATED if left else Result.INVALID_GOAL)


def stopped(robot: RemoteRobot, run: PublishedRun, controller: ControllerInfo) -> RemoteGoal:
    """Stop the joints of a trajectory controller; return the goal of the robot that ends when they rest."""
    try:
        if goal := robot.cancel(controller.name).goal:
            return goal
    except Refused as refused:
        if refused.code not in ("no_goal", "cancelled_already"):
            raise
    # A stream of chunks has no goal. A new goal replaces it with the present velocity, and is cancelled at
    # once.
    rows = run.rows(controller.joints)
    place = [{"time": _FAR_S, "positions": run.desired[rows].tolist()}]
    goal = _sent(robot, controller, "trajectory", {"points": place})
    goal.cancel()
    return goal


def _sent(
    robot: RemoteRobot, controller: ControllerInfo, kind: str, command: dict[str, object]
) -> RemoteGoal:
    goal = robot.send(controller.name, kind, command).goal
    if goal is None:
        raise DxlrunError(f"{controller.name} does not accept {kind} as a goal")
    return goal


class Watch:
    """Feedback of a FollowJointTrajectory goal: desired and measured joint states, updated in each cycle"""

    def __init__(self, run: PublishedRun, plan: ValidatedTrajectory) -> None:
        self.plan = plan
        self._rows = run.rows(plan.joints)
        self._spline = plan.spline(run.desired[self._rows])
        self._sample = SplineSample(len(plan.joints))
        self._begin_ns: int | None = None
        self._offset_ns = run.header.epoch_offset_ns
        self.newest: Seen | None = None

    def start_timing(self, state: GoalState) -> None:
        """Set the time from which the trajectory is counted: the acceptance of the goal by the robot."""
        self._begin_ns = round(state.accepted * 1e9)

    def update_states(self, record: np.void) -> None:
        """Update `newest` from the record of a cycle; ignored before `start_timing`."""
        if self._begin_ns is None:
            return
        t_ns = int(record["read_ns"])
        seconds = (t_ns - self._begin_ns) * 1e-9
        self._spline.sample(seconds, self._sample)
        actual = np.array([record["position"][self._rows], record["velocity"][self._rows]])
        self.newest = t_ns + self._offset_ns, seconds, self._sample.rows[:2].copy(), actual

    def feedback(self, newest: Seen) -> FollowJointTrajectory.Feedback:
        """Return the feedback message with the joint states of a cycle."""
        wall_ns, seconds, desired, actual = newest
        message = FollowJointTrajectory.Feedback(joint_names=list(self.plan.joints))
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(wall_ns, 1_000_000_000)
        message.desired, message.actual = point(desired, seconds), point(actual, seconds)
        message.error, message.index = point(desired - actual, seconds), self.plan.index(seconds)
        return message


class Gripper(Action):
    """control_msgs/GripperCommand of a gripper_controller; the position is that of the joint, rad or m"""

    kind, name = GripperCommand, "gripper_cmd"

    def failed(self, why: str, code: int = Result.INVALID_GOAL) -> object:
        """Return the GripperCommand result of a goal that failed, which has no field for the reason."""
        return self._fill_message(GripperCommand.Result())

    def execute_goal(self, handle: ServerGoalHandle, robot: RemoteRobot) -> object:
        """Move the gripper to a position. The action also succeeds if it stops early at an object."""
        command = handle.request.command
        wish: dict[str, object] = {"position": command.position}
        if command.max_effort > 0:
            wish["effort"] = command.max_effort
        goal = _sent(robot, self.controller, "grip", wish)
        state, why = self.wait_for_goal(
            handle,
            robot,
            goal,
            lambda _: handle.publish_feedback(self._fill_message(GripperCommand.Feedback())) or "",
        )
        result = self._fill_message(GripperCommand.Result())
        result.stalled = state.reached and self._stalled(robot, state)
        result.reached_goal = state.reached and not result.stalled
        if state.reached:
            handle.succeed()
        elif state.status == "cancelled" and handle.is_cancel_requested:
            handle.canceled()
        else:
            self.node.get_logger().error(why or state.text or state.status)
            handle.abort()
        return result

    def _fill_message(
        self, message: GripperCommand.Feedback | GripperCommand.Result
    ) -> GripperCommand.Feedback | GripperCommand.Result:
        row = self.run.rows(self.controller.joints[:1])[0]
        if (record := self.run.newest) is not None:
            message.position, message.effort = float(record["position"][row]), float(record["effort"][row])
        return message

    def _stalled(self, robot: RemoteRobot, state: GoalState) -> bool:
        """Return True if the gripper's first state message after the goal's end says that it stalled. False
        if none arrives within STATE_S."""
        until = time.monotonic() + STATE_S
        while time.monotonic() < until:
            found = robot.newest(f"/{self.controller.name}/state")
            if found is not None and found.time_ns * 1e-9 >= (state.ended or 0.0):
                return bool(found.message["stalled"])
            time.sleep(FEEDBACK_S)
        return False
