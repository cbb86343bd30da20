"""The server of a running robot's page: it follows, steers where it may, and stops; judged by the ledger."""

import json
import os
import socket
from functools import partial
from pathlib import Path
from typing import Any, cast

import pytest
from tests.kit.awaited import until
from tests.kit.campaigns import campaign
from tests.kit.fuzzed_http import Said, check_port_survives_fuzzing
from tests.kit.torso import GOAL_POSITION, JOINT, SERVO, TORQUE_ENABLE, settled, written
from tests.view.served import Served

from dxlrun import Refused, RemoteRobot
from dxlrun_view.actions import StopAction
from dxlrun_view.live_robot import LiveRobot, offered_motions
from dxlrun_view.page_server import HEADER
from dxlrun_view.shown import ViewedController, ViewedRobot

ACTIONS: tuple[dict[str, object], ...] = (
    {"verb": "halt"},
    {"verb": "pause"},
    {"verb": "resume"},
    {"verb": "torque", "joints": [JOINT], "on": True},
    {"verb": "switch", "controller": "left_arm", "on": True},
    {"verb": "goal", "joint": JOINT, "position": 0.2},
    {"verb": "plan", "controller": "left_arm", "position": [0.1, 0.0, 0.1]},
    {"verb": "pose", "controller": "left_arm", "position": [0.1, 0.0, 0.1]},
    {"verb": "play", "motion": "three_parts.yaml"},
    {"verb": "set_parameter", "controller": "left_arm", "parameter": "p", "value": 0.2},
)
"""A message of each action that steers."""
WRONG = Path(__file__).with_name("wrong_messages.jsonl").read_text().splitlines()
LONG = {"verb": "set_parameter", "controller": "nobody", "parameter": "p", "value": "x" * 9000}


def column(served: Served, name: str) -> Any:
    seen = served.look(shown=True)
    values = seen["moment"]["values"]
    return values[seen["shown"]["columns"].index(name)] if values else None


def test_it_offers_motions_of_controllers():
    pages = ViewedController("pages", "keyframe_player", True, motions={"march": None, "bow": 1.0})
    robot = ViewedRobot("two", controllers=(pages,), file="/nowhere/two.yaml")
    assert [*offered_motions(robot)] == ["pages/march", "pages/bow"]


def test_it_follows_the_robot(live, serve):
    served = serve(live)
    first = until(lambda: column(served, "loop/cycle"))
    assert until(lambda: (column(served, "loop/cycle") or 0) > first + 5)
    shown = served.look(shown=True)["shown"]
    assert shown["live"]
    assert not shown["control"]
    assert len(shown["info"]["joints"]) == 8
    assert all(lower < upper for lower, upper in shown["info"]["limits"].values())
    assert any(path.endswith("three_parts.yaml") for path in shown["motions"])
    assert not any(path.endswith("effort_arm_lift.yaml") for path in shown["motions"])
    assert until(lambda: served.look(after=0)["events"])
    with live.asking() as robot:
        states, info = robot.states(), robot.info()
    began = info["began"]
    assert abs(states.time_ns * 1e-9 - states.cycle / info["rate"] - began) < 2.0 + info["skipped"]
    for event in served.look(after=0)["events"]:  # seconds of the run, not of the machine's clock
        assert abs(event["run_time"] - (event["time"] - began)) < 1e-6
    begin, end = shown["span"]
    field = "/imu/imu:orientation.w"
    assert field in until(lambda: served.look(shown=True)["shown"]["fields"])
    span = {"names": [field, "loop/cycle"], "begin": begin, "end": end + 60}
    assert until(lambda: served.look(spans=[span])["curves"][0][0]["value"])


def test_a_page_that_may_not_steer_only_stops(live, serve, run):
    with live.asking() as robot:
        robot.torque("all", on=True)
    until(lambda: run.written(TORQUE_ENABLE)[SERVO] == 1)
    served = serve(live)
    for action in ACTIONS:
        status, answer = served.ask("/act", action)
        assert (status, b"--control" in answer) == (403, True), action
    assert served.ask("/act", {"verb": "parameters", "controller": "left_arm"})[0] == 200
    status, answer = served.ask("/act", {"verb": "stop"})
    assert (status, b"limp" in answer) == (200, True)
    until(lambda: run.limp)


def test_a_wrong_message_is_refused_with_a_sentence(live, serve):
    served = serve(live, control=True)
    for message in (*WRONG, json.dumps(LONG)):
        status, answer = served.ask("/act", message.encode())
        assert status == 409, (message, answer)
        assert json.loads(answer)["refused"], message
    for raw in (b"", b"{", b"\xff\xfe", b'{"verb": "goal", "joint": "\xed\xa0\x80"}', b"[" * 60_000):
        for path in ("/act", "/look"):
            status, answer = served.ask(path, raw)
            assert (status, b"invalid request" in answer) == (409, True), raw[:20]
    for look in ({"time": "now"}, {"spans": [{"names": ["x"]}]}, {"after": 1.5}, {"spans": {}}):
        assert served.ask("/look", look)[0] == 409, look
    for span in ({"points": -1}, {"points": 0}, {"begin": 9.0, "end": -9.0}, {"begin": -1e308, "end": 1e308}):
        whole = {"names": ["loop/cycle", "nothing", ":", "/x:y[9]"], "begin": 0.0, "end": 1.0} | span
        assert served.ask("/look", {"spans": [whole]})[0] == 200, span
    for path in ("/mesh", "/mesh?name=..%2F..%2Fetc%2Fpasswd", "/mesh?name=%00"):
        assert served.ask(path)[0] == 404, path


@campaign(ci=300, night=100_000, release=1_000_000)
def test_fuzzed_clicks_without_the_token_or_from_elsewhere_move_nothing(live, serve, run, amount, chance):
    served = serve(live, control=True)
    with live.asking() as robot:
        before = settled(run.ledger, lambda: robot.info()["cycles"], 20)
    host, token = f"Host: 127.0.0.1:{served.port}\r\n", f"{HEADER}: {served.page.token}\r\n"
    guards = (
        host,
        host + token.swapcase(),
        f"{host}{token}Origin: http://evil.example\r\n",
        f"Host: evil.example:{served.port}\r\n{token}",
    )
    clicks = ({"verb": "torque", "joints": ["all"], "on": True}, {"verb": "stop"}, {"verb": "halt"})
    seeds = [
        Said(method, path, json.dumps(click).encode(), guard)
        for guard in guards
        for click in clicks
        for method, path in (("POST", "/act"), ("POST", "/look"), ("GET", "/urdf"), ("GET", "/mesh?name=x"))
    ]
    reach = partial(socket.create_connection, ("127.0.0.1", served.port))
    check_port_survives_fuzzing(reach, reach, seeds, os.getpid(), frames=int(amount), draw=chance)
    assert written(run.ledger) == before


def test_sliders_and_buttons_reach_the_servos(live, serve, run):
    served = serve(live, control=True)
    assert served.ask("/act", {"verb": "torque", "joints": ["all"], "on": True})[0] == 200
    arms = ["left_arm", "right_arm", "head"]
    for name in arms:
        served.ask("/act", {"verb": "switch", "controller": name, "on": True})
    until(lambda: run.written(TORQUE_ENABLE)[SERVO] == 1)
    status, answer = served.ask("/act", {"verb": "goal", "joint": JOINT, "position": 0.4})
    assert (status, b"right_arm" in answer) == (200, True)
    # 0.4 rad are 78 ticks of 1023 in 300 deg
    until(lambda: abs(abs(run.written(GOAL_POSITION)[SERVO] - 512) - 78) <= 2)
    assert until(lambda: abs((column(served, f"{JOINT}/position") or 0.0) - 0.4) < 0.03)
    status, answer = served.ask("/act", {"verb": "goal", "joint": JOINT, "position": 9.0})
    assert status == 409
    assert served.ask("/act", {"verb": "play", "motion": "/etc/passwd"})[0] == 409
    assert served.ask("/act", {"verb": "switch", "controller": "right_arm", "on": False})[0] == 200
    rows = {row["name"]: row["active"] for row in until(lambda: fresh(served))["info"]["controllers"]}
    assert rows["left_arm"]
    assert not rows["right_arm"]
    assert served.ask("/act", {"verb": "goal", "joint": JOINT, "position": 0.0})[0] == 409
    status, answer = served.ask("/act", {"verb": "torque", "joints": ["all"], "on": False})
    assert status == 200, answer
    assert served.ask("/act", {"verb": "halt"})[0] == 200


def fresh(served: Served) -> Any:
    """Return what the page shows once the switch is seen."""
    shown = served.look(shown=True)["shown"]
    row = next(row for row in shown["info"]["controllers"] if row["name"] == "right_arm")
    return None if row["active"] else shown


def test_a_robot_that_ends_and_comes_back(live, serve, run):
    served = serve(live)
    until(lambda: column(served, "loop/cycle"))
    before = until(lambda: served.look(after=0)["events"])
    run.end()
    assert "is not running; start it again" in until(lambda: served.look(shown=True)["shown"]["problem"])
    assert served.ask("/act", {"verb": "stop"})[0] == 409
    assert served.ask("/urdf")[1].startswith(b"<?xml")  # its last state is still shown
    run.start()
    until(lambda: served.look(shown=True)["shown"]["run"] == 2)
    first = until(lambda: column(served, "loop/cycle"))
    assert until(lambda: (column(served, "loop/cycle") or 0) > first)
    shown = served.look(shown=True)["shown"]
    assert not shown["problem"]
    begin, end = shown["span"]
    (curve,) = served.look(spans=[{"names": ["loop/cycle"], "begin": begin, "end": end + 60}])["curves"][0]
    assert None in curve["value"]  # no line joins the two runs
    after = until(lambda: served.look(after=before[-1]["number"])["events"])
    numbers = [event["number"] for event in before + after]
    assert numbers == [*range(1, len(numbers) + 1)]
    assert after[-1]["time"] > before[-1]["time"]


def test_a_robot_that_does_not_run_is_waited_for():
    robot = LiveRobot("nowhere")
    shown = robot.describe_page()
    robot.close()
    assert "nowhere" in shown.problem
    assert shown.columns == ()


@pytest.mark.parametrize("refused", [False, True])
def test_stop_ends_the_run_where_torque_off_is_refused(refused):
    asked: list[str] = []

    class Robot:
        def torque(self, joints: str, on: bool, release: bool) -> None:
            asked.append(f"torque of {joints}: {on}")
            if refused:
                raise Refused("another client commands this robot")

        def stop(self, wait: bool) -> None:
            asked.append("stop")

    said = StopAction().perform_on(cast("RemoteRobot", Robot())).said
    assert asked == ["torque of all: False", *(["stop"] if refused else [])]
    assert ("the run ends" in said) is refused
