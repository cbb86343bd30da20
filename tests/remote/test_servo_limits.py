"""Commands beyond a register of a servo are refused once the loop has reported the register."""

import json

import msgspec
from msgspec.structs import replace
from tests.remote.conftest import PLAN, Desk

from dxlrun.channels.event_records import EventBody, EventCode, Severity
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.plan.loop_plan import ControllerPlan, ServoLimit

CURRENT = ServoLimit("effort", 0.0538, "Current Limit (38) = 20, 0.0538 A")
PWM = ServoLimit("pwm", 0.2, "PWM Limit (36) = 177, 20 %")


def push(kind: str, interface: str) -> Desk:
    """Return a desk whose joint pan has a group controller of this kind."""
    name = f"joint_group_{kind}_controller"
    one = ControllerPlan(
        "push",
        name,
        "tests 1",
        json.dumps({"joints": ["pan"]}),
        ("pan",),
        (interface,),
        (),
        active=True,
        every=1,
    )
    loop = replace(PLAN.loop, controllers=(one,))
    desk = Desk(replace(PLAN, loop=loop, groups={}), load_plugins())
    desk.record.active = 0b1
    desk.finish_cycle()
    return desk


def report(desk: Desk, *limits: ServoLimit) -> None:
    desk.events.emit_event(
        "pan", EventBody(EventCode.SERVO_LIMITS, Severity.INFO, ""), msgspec.json.encode(limits)
    )
    desk.link.collect_messages()


def test_an_effort_beyond_the_servos_current_limit_is_refused_with_the_register():
    desk = push("effort", "effort")
    assert desk.ask("POST", "/controllers/push/commands/efforts", {"efforts": [0.3]})[0] == 200
    report(desk, CURRENT, PWM)
    status, content = desk.ask("POST", "/controllers/push/commands/efforts", {"efforts": [0.3]})
    assert (status, content["code"]) == (422, "beyond_limits")
    assert (
        "pan is commanded to 0.3, more than 0.0538, servo register Current Limit (38) = 20, 0.0538 A"
        in content["refused"]
    )
    assert desk.ask("POST", "/controllers/push/commands/efforts", {"efforts": [-0.05]})[0] == 200


def test_a_pwm_beyond_the_servos_pwm_limit_is_refused():
    desk = push("pwm", "pwm")
    report(desk, PWM)
    status, content = desk.ask("POST", "/controllers/push/commands/pwm", {"pwm": [0.3]})
    assert (status, "PWM Limit (36) = 177, 20 %" in content["refused"]) == (422, True)
    assert desk.ask("POST", "/controllers/push/commands/pwm", {"pwm": [0.2]})[0] == 200
