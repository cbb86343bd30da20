"""What becomes of a late cycle, by the robot file and by plug-ins, and the page on real time."""

import re
from types import ModuleType
from typing import get_args

import numpy as np
import pluggy
import pytest
from tests.kit.loops import PERIOD_NS
from tests.kit.packages import plugin_folder
from tests.kit.pages import page_text

from dxlrun.channels.answers import Code
from dxlrun.channels.event_records import EventCode, Severity
from dxlrun.contract.hookspecs import GROUP, HookSpecs
from dxlrun.control.controllers.plugin_loading import OverrunHook, load_plugins
from dxlrun.control.schedule import MOST_CAUGHT_UP
from dxlrun.description.robot import Scheduler
from dxlrun.plan.loop_plan import OverrunPolicy

CAUGHT_UP, SKIPPED = [0, 1, 2, 3, 4, 5], [0, 1, 4, 5]


def ran(robot, policy, *hooks, late=(1,), periods=6):
    """Run a robot whose cycles at these places take 2.5 periods; return the numbers of its cycles."""
    robot.build(end_ns=periods * PERIOD_NS, overrun=policy, overrun_hooks=hooks)
    robot.run(work=dict.fromkeys(late, 2.5))
    return robot.column("cycle")


@pytest.mark.parametrize(("policy", "cycles"), [("skip", SKIPPED), ("catch_up", CAUGHT_UP), ("stop", [0, 1])])
@pytest.mark.parametrize("hooks", [(), (OverrunHook("silent", lambda *_: None),)], ids=["alone", "silent"])
def test_the_robot_file_decides_where_no_plug_in_has_an_answer(robot, policy, cycles, hooks):
    assert ran(robot, policy, *hooks) == cycles
    caught_up = (
        "cycle 1 ended 50.000 ms after its deadline; 0 periods skipped, the next cycle follows at once"
    )
    assert policy != "catch_up" or robot.events.of(EventCode.OVERRUN) == [("loop", caught_up)]


def test_five_late_cycles_at_most_follow_at_once(robot):
    robot.run(work={1: 7.5}, end_ns=12 * PERIOD_NS, overrun="catch_up")
    assert robot.column("cycle") == [0, 1, *range(4, 12)]


def test_a_plug_in_decides_before_the_robot_file(robot):
    asked = []
    hook = OverrunHook("mine", lambda *times: asked.append(times) or "catch_up")
    assert ran(robot, "skip", hook) == CAUGHT_UP
    start_ns = robot.column("scheduled_ns")[0]
    late_ns = start_ns + int(3.5 * PERIOD_NS)
    assert asked == [(cycle, start_ns + cycle * PERIOD_NS, late_ns) for cycle in (2, 3)]


def test_a_plug_in_without_an_answer_leaves_it_to_the_next_and_none_is_asked_in_time(robot):
    asked = []
    silent = OverrunHook("silent", lambda *times: asked.append(times))
    assert ran(robot, "skip", silent, OverrunHook("stopper", lambda *_: "stop")) == [0, 1]
    assert len(asked) == 1
    assert robot.result.detail == "cycle 1 ended after the next deadline (`overrun: stop` in the robot file)"


def raises(*_):
    raise ZeroDivisionError("no time")


def exits(*_):
    raise SystemExit(3)


@pytest.mark.parametrize(
    ("decide", "why"),
    [
        (raises, "raised ZeroDivisionError: no time"),
        (exits, "raised SystemExit: 3"),
        (lambda *_: "later", "returned 'later', not one of skip, catch_up, stop"),
        (lambda *_: [], "returned [], not one of skip, catch_up, stop"),
        (lambda *_: np.zeros(2), "returned array([0., 0.]), not one of skip, catch_up, stop"),
    ],
)
def test_a_plug_in_that_fails_is_an_event_and_not_asked_again(robot, decide, why):
    asked = []
    hook = OverrunHook("mine (x 1)", lambda *times: asked.append(times) or decide(*times))
    assert ran(robot, "skip", hook, late=(1, 3), periods=12) == [0, 1, 4, 5, 8, 9, 10, 11]
    assert len(asked) == 1
    told = [(*one[:2], one[3]) for one in robot.events.list if one[2] == "mine (x 1)"]
    assert told == [
        (
            EventCode.OVERRUN,
            Severity.ERROR,
            f"the hook dxlrun_overrun {why}; it is not called again in this run",
        )
    ]


def test_another_rate_is_told_to_the_clock_which_polls_before_each_deadline(robot):
    robot.build()
    assert robot.loop.steering.change_rate(100) is None
    assert robot.loop.steering.change_rate(0).code is Code.RATE_OUT_OF_RANGE
    assert robot.periods == [10_000_000]


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
    monkeypatch.syspath_prepend(plugin_folder(tmp_path, "patient_overrun", PLUGIN, "patient"))
    (hook,) = load_plugins().overrun_hooks
    assert hook.plugin == "patient_overrun (patient 1.0)"
    assert [hook.decide(7, 5_000, late_ns) for late_ns in (6_000, 6_001)] == [None, "stop"]


PAGE = page_text("real-time.md")


def test_the_hook_of_the_page_is_one():
    (source,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    module = ModuleType("page")
    exec(source, module.__dict__)  # noqa: S102 (it is our own page)
    manager = pluggy.PluginManager(GROUP)
    manager.add_hookspecs(HookSpecs)
    manager.register(module)  # raises for what is no hook
    manager.check_pending()
    assert module.dxlrun_overrun(0, 50_000_001) == "stop"
    assert module.dxlrun_overrun(0, 50_000_000) is None


def test_every_policy_for_late_cycles_and_every_request_is_on_the_page():
    assert set(re.findall(r"^\| `(\w+)` \| [a-z]", PAGE, re.MULTILINE)) >= set(get_args(OverrunPolicy))
    assert f"up to {MOST_CAUGHT_UP} late cycles follow at once" in PAGE
    assert Scheduler.model_fields
    assert [key for key in Scheduler.model_fields if f"`{key}`" not in PAGE] == []
