"""Requests of controllers: who takes over in the same cycle, what is refused, and how a run is ended."""

from __future__ import annotations

import numpy as np

from dxlrun.channels.cycle import Torque
from dxlrun.channels.events import EventCode
from dxlrun.description.modes import Mode

PERIOD_NS = 20_000_000


class Stage:
    """Controllers that command a number of their own, and a watch that makes its request in one cycle."""

    def __init__(self, robot, at=3):
        self.robot = robot
        self.at = at
        self.updated = []

    def add(self, name, value, request=None, **options):
        """`request` is called with the controller in cycle `at`."""

        def act(controller, step, time_ns, _):
            if step != "update":
                return
            self.updated.append((round(time_ns / PERIOD_NS), name))
            context = controller.context
            if value is not None:
                given = context.references.position
                context.commands.position[:] = value
                if np.isfinite(given).all() and len(given):
                    context.commands.position[:] = given
            if request and round(time_ns / PERIOD_NS) == self.at:
                request(context)

        options.setdefault("command", ("position",))
        self.robot.script(name, act, **options)
        return self

    def watch(self, request, takeovers=("safe",), **options):
        return self.add("watch", None, request, joints=(), command=(), takeovers=takeovers, **options)

    def run(self, cycles=8):
        self.robot.build(end_ns=cycles * PERIOD_NS)
        self.result = self.robot.loop.run()
        return self

    def active(self, cycle):
        mask = self.robot.sink.cycles[cycle]["active"]
        return {plan.name for bit, plan in enumerate(self.robot.plan.controllers) if mask >> bit & 1}

    def commanded(self, cycle):
        return self.robot.sink.cycles[cycle]["position"].tolist()

    def events(self, code):
        return self.robot.events.of(code)


def falls(context):
    context.take_over(["safe"], "it falls")


def test_a_controller_takes_over_in_the_cycle_of_the_request_wherever_it_stands(robot):
    stage = Stage(robot).add("safe", 0.5, active=False).add("walk", 0.1).watch(falls).run()
    assert stage.active(2) == {"walk", "watch"}
    assert stage.commanded(2) == [0.1, 0.1]
    assert stage.active(3) == {"safe", "watch"}
    assert stage.commanded(3) == [0.5, 0.5]
    assert stage.updated.count((3, "safe")) == stage.updated.count((3, "watch")) == 1
    assert stage.updated.count((4, "safe")) == 1
    assert (4, "walk") not in stage.updated
    assert stage.events(EventCode.TAKEOVER) == [("watch", "safe takes over from walk: it falls")]
    assert stage.result.reason == "ended"


def test_only_those_that_command_the_same_leave_and_all_above_them(robot):
    stage = Stage(robot)
    stage.add("head", 0.2, joints=("j1",))
    stage.add("upper", 0.3, joints=("j0",), into=("lower",))
    stage.add("lower", 0.0, joints=("j0",), reference=("position",))
    stage.add("safe", 0.5, joints=("j0",), active=False).watch(falls).run()
    assert stage.commanded(2) == [0.3, 0.2]
    assert stage.active(3) == {"head", "safe", "watch"}
    assert stage.commanded(3) == [0.5, 0.2]


def test_one_above_enters_with_those_below_it(robot):
    stage = Stage(robot).add("walk", 0.1)
    stage.add("safe", 0.5, into=("soft",), active=False)
    stage.add("soft", 0.0, reference=("position",), active=False)
    stage.watch(falls).run()
    assert stage.active(3) == {"safe", "soft", "watch"}
    assert stage.commanded(3) == [0.5, 0.5]


def test_one_above_takes_the_references_and_those_below_stay(robot):
    stage = Stage(robot).add("arm", 0.1, into=("soft",)).add("safe", 0.5, into=("soft",), active=False)
    stage.add("soft", 0.0, reference=("position",)).watch(falls).run()
    assert stage.active(3) == {"safe", "soft", "watch"}
    assert stage.commanded(4) == [0.5, 0.5]  # a cycle later: the one below was updated in this one already


def test_what_is_active_already_is_left_alone(robot):
    stage = Stage(robot).add("safe", 0.5).watch(falls).run()
    assert not stage.events(EventCode.TAKEOVER)
    assert not stage.events(EventCode.COMMAND_REFUSED)
    assert len(stage.events(EventCode.CONTROLLER_ACTIVATED)) == 2


def test_a_joint_without_torque_refuses_it_and_all_stays(robot):
    def limp(context):
        robot.record.states.torque[1] = Torque.OFF
        falls(context)

    stage = Stage(robot).add("safe", 0.5, active=False).add("walk", 0.1).watch(limp).run()
    ((source, text),) = stage.events(EventCode.COMMAND_REFUSED)
    assert source == "watch"
    assert "takeover by safe refused" in text
    assert "j1" in text
    assert "it falls" in text
    assert stage.active(7) == {"walk", "watch"}


def test_a_controller_that_was_not_declared_is_a_fault_of_the_one_that_requests_it(robot):
    stage = Stage(robot).add("safe", 0.5, active=False).watch(falls, takeovers=("other",)).run()
    assert stage.result.reason == "fault"
    assert "watch requested that safe takes over, which is none of its takeovers" in stage.result.detail


def test_one_that_was_unloaded_is_refused(robot):
    stage = Stage(robot).add("walk", 0.1).watch(falls).run()
    ((_, text),) = stage.events(EventCode.COMMAND_REFUSED)
    assert "safe" in text
    assert stage.active(7) == {"walk", "watch"}


def test_the_one_that_requests_leaves_where_it_commands_the_same(robot):
    stage = Stage(robot).add("walk", 0.1, falls, takeovers=("safe",)).add("safe", 0.5, active=False).run()
    assert stage.active(3) == {"safe"}
    assert stage.commanded(3) == [0.5, 0.5]


def test_a_request_of_one_that_entered_counts_in_the_same_cycle_and_a_circle_ends(robot):
    def back(context):
        context.take_over(["walk"], "back")

    stage = Stage(robot).add("walk", 0.1, falls, takeovers=("safe",))
    stage.add("safe", 0.5, back, takeovers=("walk",), active=False).run()
    texts = [text for _, text in stage.events(EventCode.TAKEOVER)]
    assert texts[:2] == ["safe takes over from walk: it falls", "walk takes over from safe: back"]
    assert stage.result.reason == "ended"


def test_a_fault_in_the_same_update_takes_the_request_along(robot):
    def broken(context):
        falls(context)
        raise RuntimeError("broken")

    stage = Stage(robot).add("safe", 0.5, active=False).add("walk", 0.1).watch(broken).run()
    assert not stage.events(EventCode.TAKEOVER)
    assert "broken" in stage.result.detail


def test_joints_in_another_mode_come_first(robot):
    stage = Stage(robot).add("safe", 0.5, active=False, command=("effort",)).add("walk", 0.1)
    stage.watch(falls).run()
    assert stage.active(3) == {"watch"}
    assert stage.active(4) == {"safe", "watch"}  # the double's servos change their modes at once
    assert robot.hardware.asked[-1] == [Mode.EFFORT] * 2


def test_a_controller_ends_the_run_by_the_policy_for_faults(robot):
    def empty(context):
        context.end_run("the battery is empty")

    stage = Stage(robot).add("walk", 0.1).watch(empty).run()
    assert stage.result.reason == "fault"
    assert stage.result.detail == "controller watch ended the run: the battery is empty"
    assert len(stage.robot.sink.cycles) == 4
