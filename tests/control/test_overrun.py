"""What becomes of a late cycle: by the robot file, by a plug-in, and by a plug-in that fails at it."""

import numpy as np
import pytest

from dxlrun.channels.answers import Code
from dxlrun.channels.events import EventCode, Severity
from dxlrun.control.controllers.plugins import OverrunHook, load_plugins

PERIOD_NS = 20_000_000


def late_robot(robot, policy, *hooks, late=(1,), by=2.5, cycles=12):
    """Build a robot whose cycles of the numbers `late` take `by` periods."""
    work = iter(range(1000))
    robot.build(end_ns=cycles * PERIOD_NS, overrun=policy)
    robot.hardware.work_ns = lambda: int(by * PERIOD_NS) if next(work) in late else 0
    robot.loop.overrun_hooks = hooks
    robot.loop.__post_init__()
    return robot


def ran(robot):
    robot.loop.run()
    return [cycle["cycle"] for cycle in robot.sink.cycles]


@pytest.mark.parametrize(
    ("policy", "cycles"), [("skip", [0, 1, 4, 5]), ("catch_up", [0, 1, 2, 3, 4, 5]), ("stop", [0, 1])]
)
def test_the_robot_file_decides(robot, policy, cycles):
    assert ran(late_robot(robot, policy, cycles=6)) == cycles


def test_catching_up_is_told_once_and_says_so(robot):
    assert ran(late_robot(robot, "catch_up", cycles=6)) == [0, 1, 2, 3, 4, 5]
    ((source, text),) = robot.events.of(EventCode.OVERRUN)
    assert source == "loop"
    assert text == (
        "cycle 1 ended 50.000 ms after its deadline; 0 periods skipped, the next one follows at once"
    )


def test_a_plug_in_decides_before_the_robot_file(robot):
    asked = []
    hook = OverrunHook("mine", lambda *times: asked.append(times) or "catch_up")
    assert ran(late_robot(robot, "skip", hook, cycles=6)) == [0, 1, 2, 3, 4, 5]
    start_ns = robot.loop.schedule.start_ns
    late_ns = start_ns + int(3.5 * PERIOD_NS)
    assert asked == [
        (2, start_ns + 2 * PERIOD_NS, late_ns),
        (3, start_ns + 3 * PERIOD_NS, late_ns),
    ]


def test_a_plug_in_without_an_answer_leaves_it_to_the_next(robot):
    silent = OverrunHook("silent", lambda *_: None)
    stopper = OverrunHook("stopper", lambda *_: "stop")
    robot = late_robot(robot, "skip", silent, stopper)
    result = robot.loop.run()
    assert (result.reason, result.cycles) == ("fault", 2)
    assert result.detail == "cycle 1 ended after the next deadline; overrun: stop"


def test_plug_ins_that_all_have_no_answer_leave_it_to_the_robot_file(robot):
    assert ran(late_robot(robot, "skip", OverrunHook("silent", lambda *_: None), cycles=6)) == [0, 1, 4, 5]


def raises(*_):
    raise ZeroDivisionError("no time")


def exits(*_):
    raise SystemExit(3)


@pytest.mark.parametrize(
    ("decide", "why"),
    [
        (raises, "raised ZeroDivisionError: no time"),
        (exits, "raised SystemExit: 3"),
        (lambda *_: "later", "returned 'later', which is none of skip, catch_up, stop"),
        (lambda *_: [], "returned [], which is none of skip, catch_up, stop"),
        (lambda *_: np.zeros(2), "returned array([0., 0.]), which is none of skip, catch_up, stop"),
    ],
)
def test_a_plug_in_that_fails_is_an_event_and_not_asked_again(robot, decide, why):
    asked = []
    hook = OverrunHook("mine (x 1)", lambda *times: asked.append(times) or decide(*times))
    assert ran(late_robot(robot, "skip", hook, late=(1, 3))) == [0, 1, 4, 5, 8, 9, 10, 11]
    assert len(asked) == 1
    told = [one for one in robot.events.seen if one[2] == "mine (x 1)"]
    assert told == [
        (
            EventCode.OVERRUN,
            Severity.ERROR,
            "mine (x 1)",
            f"dxlrun_overrun {why}; it is not asked again in this run",
        )
    ]


def test_nobody_is_asked_while_cycles_are_in_time(robot):
    asked = []
    hook = OverrunHook("mine", lambda *times: asked.append(times))
    ran(late_robot(robot, "skip", hook, late=()))
    assert asked == []


def test_another_rate_is_told_to_the_clock_which_polls_before_each_deadline(robot):
    robot.build(end_ns=PERIOD_NS)
    told = []
    robot.loop.pace = told.append
    assert robot.loop.change_rate(100) is None
    assert told == [10_000_000]
    assert robot.loop.change_rate(0).code is Code.RATE_OUT_OF_RANGE
    assert told == [10_000_000]


PLUGIN = """
from dxlrun import hookimpl

@hookimpl
def dxlrun_contract():
    return 1

@hookimpl
def dxlrun_controllers():
    return {}

@hookimpl
def dxlrun_overrun(actual_ns, scheduled_ns):
    return "stop" if actual_ns - scheduled_ns > 1000 else None
"""


def test_an_installed_plug_in_is_gathered_with_the_arguments_it_wants(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "patient_overrun.py").write_text(PLUGIN)
    info = tmp_path / "patient-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: patient\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[dxlrun]\npatient = patient_overrun\n")
    (hook,) = load_plugins().overrun_hooks
    assert hook.plugin == "patient (patient 1.0)"
    assert hook.decide(7, 5_000, 6_000) is None
    assert hook.decide(7, 5_000, 6_001) == "stop"
