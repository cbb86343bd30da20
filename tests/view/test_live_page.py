"""The server of a running robot's page: it follows, steers where it may, and stops; judged by the ledger."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Callable
from functools import partial
from typing import Any, cast

import pytest
from tests.kit.awaited import until
from tests.kit.fuzzed_http import Said, stands
from tests.kit.torso import GOAL_POSITION, JOINT, SERVO, TORQUE_ENABLE, Run, settled, written
from tests.view.served import Served

from dxlrun import Refused, RemoteRobot
from dxlrun_view.actions import stopped
from dxlrun_view.live import LiveRobot
from dxlrun_view.server import HEADER

Serve = Callable[..., Served]


def column(served: Served, name: str) -> Any:
    seen = served.look(shown=True)
    values = seen["moment"]["values"]
    return values[seen["shown"]["columns"].index(name)] if values else None


def test_it_follows_the_robot(live: LiveRobot, serve: Serve) -> None:
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
    begin, end = shown["span"]
    field = "/imu/imu:orientation.w"
    assert field in until(lambda: served.look(shown=True)["shown"]["fields"])
    span = {"names": [field, "loop/cycle"], "begin": begin, "end": end + 60}
    assert until(lambda: served.look(spans=[span])["curves"][0][0]["value"])


def test_a_page_that_may_not_steer_only_stops(live: LiveRobot, serve: Serve, run: Run) -> None:
    with live.asking() as robot:
        robot.torque("all", on=True)
    until(lambda: run.written(TORQUE_ENABLE)[SERVO] == 1)
    served = serve(live)
    for verb in ("halt", "torque", "switch", "goal", "play", "pause", "resume", "set_parameter"):
        status, answer = served.ask("/act", {"verb": verb, "names": [JOINT], "value": 0.2})
        assert (status, b"--control" in answer) == (403, True)
    assert served.ask("/act", {"verb": "parameters", "names": ["left_arm"]})[0] == 200
    status, answer = served.ask("/act", {"verb": "stop"})
    assert (status, b"limp" in answer) == (200, True)
    until(lambda: run.limp)


@pytest.mark.campaign
def test_fuzzed_clicks_without_the_token_or_from_elsewhere_move_nothing(
    live: LiveRobot, serve: Serve, run: Run
) -> None:
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
    clicks = ({"verb": "torque", "names": ["all"]}, {"verb": "stop"}, {"verb": "halt"})
    seeds = [
        Said(method, path, json.dumps(click).encode(), guard)
        for guard in guards
        for click in clicks
        for method, path in (("POST", "/act"), ("POST", "/look"), ("GET", "/urdf"), ("GET", "/mesh?name=x"))
    ]
    reach = partial(socket.create_connection, ("127.0.0.1", served.port))
    stands(reach, reach, seeds, os.getpid())
    assert written(run.ledger) == before


def test_sliders_and_buttons_reach_the_servos(live: LiveRobot, serve: Serve, run: Run) -> None:
    served = serve(live, control=True)
    assert served.ask("/act", {"verb": "torque", "names": ["all"], "on": True})[0] == 200
    arms = ["left_arm", "right_arm", "head"]
    for name in arms:
        served.ask("/act", {"verb": "switch", "names": [name], "on": True})
    until(lambda: run.written(TORQUE_ENABLE)[SERVO] == 1)
    status, answer = served.ask("/act", {"verb": "goal", "names": [JOINT], "value": 0.4})
    assert (status, b"right_arm" in answer) == (200, True)
    # 0.4 rad are 78 ticks of 1023 in 300 deg
    until(lambda: abs(abs(run.written(GOAL_POSITION)[SERVO] - 512) - 78) <= 2)
    assert until(lambda: abs((column(served, f"{JOINT}/position") or 0.0) - 0.4) < 0.03)
    status, answer = served.ask("/act", {"verb": "goal", "names": [JOINT], "value": 9.0})
    assert status == 409
    assert served.ask("/act", {"verb": "play", "names": ["/etc/passwd"]})[0] == 409
    assert served.ask("/act", {"verb": "switch", "names": ["right_arm"], "on": False})[0] == 200
    rows = {row["name"]: row["active"] for row in until(lambda: fresh(served))["info"]["controllers"]}
    assert rows["left_arm"]
    assert not rows["right_arm"]
    assert served.ask("/act", {"verb": "goal", "names": [JOINT], "value": 0.0})[0] == 409
    assert served.ask("/act", {"verb": "halt"})[0] == 200


def fresh(served: Served) -> Any:
    """Return what the page shows once the switch is seen."""
    shown = served.look(shown=True)["shown"]
    row = next(row for row in shown["info"]["controllers"] if row["name"] == "right_arm")
    return None if row["active"] else shown


def test_a_robot_that_ends_and_comes_back(live: LiveRobot, serve: Serve, run: Run) -> None:
    served = serve(live)
    until(lambda: column(served, "loop/cycle"))
    before = until(lambda: served.look(after=0)["events"])
    run.end()
    assert "goes on when it is started" in until(lambda: served.look(shown=True)["shown"]["problem"])
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


def test_a_robot_that_does_not_run_is_waited_for(run: Run) -> None:
    robot = LiveRobot("nowhere")
    shown = robot.shown()
    robot.close()
    assert "nowhere" in shown.problem
    assert shown.columns == ()


@pytest.mark.parametrize("refused", [False, True])
def test_stop_ends_the_run_where_torque_off_is_refused(refused: bool) -> None:
    asked: list[str] = []

    class Robot:
        def torque(self, joints: str, on: bool, release: bool) -> None:
            asked.append(f"torque of {joints}: {on}")
            if refused:
                raise Refused("another client commands this robot")

        def stop(self, wait: bool) -> None:
            asked.append("stop")

    said = stopped(cast("RemoteRobot", Robot()))
    assert asked == ["torque of all: False", *(["stop"] if refused else [])]
    assert ("the run ends" in said) is refused
