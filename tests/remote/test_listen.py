"""Listening: what the client makes of answers, and a whole run whose messages come live and into the log."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import dxlrun
from dxlrun.log.reader import read_log
from dxlrun.remote.client import RemoteRobot
from dxlrun_analysis.replay import replay_log

ROBOT = """\
name: publisher
buses:
  main:
    port: sim
    protocol: 1.0
    baud_rate: 1_000_000
    return_delay_time: 100 us
    adapter: {latency: 1 ms}
loop: {rate: 100, tolerated_skips: 100 %}
joints:
  pan: {bus: main, id: 3, model: AX-12A, reference: 150 deg, direction: 1}
controllers:
  count: {type: count}
"""
PLUGIN = """\
from dataclasses import dataclass

from dxlrun import CONTRACT_VERSION, Controller, Floats, Interfaces, hookimpl
from dxlrun.messages import Header


@dataclass
class Count:
    header: Header
    number: int
    position: Floats


class Counting(Controller):
    Topics = {"state": Count}
    number = 0

    @classmethod
    def interfaces(cls, parameters, joints):
        return Interfaces(joints)

    def on_activate(self, time_ns):
        self.context.publish("state", Count(Header(), 0, self.context.states.position))

    def on_deactivate(self, time_ns):
        self.context.publish("state", Count(Header(), -1, self.context.states.position))

    def update(self, time_ns, period_ns):
        self.number += 1
        self.context.publish("state", Count(Header(), self.number, self.context.states.position))


@hookimpl
def dxlrun_contract():
    return CONTRACT_VERSION


@hookimpl
def dxlrun_controllers():
    return {"count": Counting}
"""
CODE = "import sys; from dxlrun.cli import main; sys.exit(main())"
DEADLINE_S = 60.0


def answer(*numbers: int, lost: int = 0) -> dict[str, object]:
    messages = [{"number": n, "time": n * 0.1, "message": {"amount": None}} for n in numbers]
    return {
        "topic": "/arm/state", "type": "mine/msg/State", "joints": ["pan"], "messages": messages,
        "last": numbers[-1] if numbers else 0, "lost": lost,
    }  # fmt: skip


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[RemoteRobot, list[str]]]:
    """Return a client whose requests get these answers, and then find no robot any more."""

    def make(*answers: dict[str, object]) -> tuple[RemoteRobot, list[str]]:
        asked: list[str] = []
        rest = list(answers)

        def exchange(_: RemoteRobot, method: str, path: str, content: object) -> tuple[int, bytes]:
            asked.append(path)
            if not rest:
                raise dxlrun.DxlrunError("publisher no longer answers")
            return 200, json.dumps(rest.pop(0)).encode()

        monkeypatch.setattr(RemoteRobot, "_exchange", exchange)
        return RemoteRobot("publisher", tmp_path / "none.sock", "test"), asked

    return make


def test_every_message_comes_once_and_what_is_missing_is_counted(robot: Any) -> None:
    client, asked = robot(answer(7), answer(8, 9), answer(), answer(15, 16, lost=5))
    found = [(one.number, one.lost) for one in client.listen("arm/state")]
    assert found == [(7, 0), (8, 0), (9, 0), (15, 5), (16, 0)]
    last = [7, 9, 9, 16]
    assert asked == ["/topics/arm/state", *(f"/topics/arm/state?after={n}&wait=2" for n in last)]


def test_at_a_rate_the_newest_comes_each_time(robot: Any) -> None:
    client, asked = robot(answer(7), answer(30), answer(30), answer(31, 32))
    found = [(one.number, one.joints, one.message) for one in client.listen("/arm/state", rate=1e6)]
    assert [number for number, *_ in found] == [7, 30, 32]
    assert found[0][1:] == (("pan",), {"amount": None})
    assert asked[:4] == [*["/topics/arm/state"] * 3, "/topics/arm/state?after=30&wait=2"]


def test_the_newest_message_may_be_none(robot: Any) -> None:
    client, _ = robot(answer(), answer(4))
    assert client.newest("/arm/state") is None
    assert client.newest("/arm/state").number == 4


def test_a_gateway_that_fails_while_the_run_goes_on_is_an_error(
    robot: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That of a run that ends removes its socket; of one that is killed it is left."""
    client, _ = robot(answer(7))
    (tmp_path / "none.sock").touch()
    monkeypatch.setattr("dxlrun.remote.client._ENDING_S", 0.05)
    with pytest.raises(dxlrun.DxlrunError, match="no longer answers"):
        list(client.listen("/arm/state"))


@pytest.fixture
def running(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[subprocess.Popen[bytes]]:
    """A robot that publishes, in real time, until it is stopped."""
    (tmp_path / "counting.py").write_text(PLUGIN)
    info = tmp_path / "counting-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-robotics\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[dxlrun]\ncounting = counting\n")
    (tmp_path / "publisher.yaml").write_text(ROBOT)
    (tmp_path / "run").mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "run"))
    with (tmp_path / "stderr").open("wb") as errors:
        process = subprocess.Popen(
            [sys.executable, "-P", "-c", CODE, "publisher.yaml", "--duration", "300"],
            cwd=tmp_path,
            stdout=subprocess.DEVNULL,
            stderr=errors,
            env=os.environ | {"PYTHONPATH": str(tmp_path)},
        )
    yield process
    process.kill()
    process.wait()


def test_messages_come_live_until_the_run_ends_and_are_all_in_the_log(
    running: subprocess.Popen[bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tick, give_up = threading.Event(), time.monotonic() + DEADLINE_S
    while not dxlrun.running():
        assert running.poll() is None
        assert time.monotonic() < give_up
        tick.wait(0.02)
    with dxlrun.connect() as robot:
        (state,) = [one for one in robot.topics() if one.name == "/count/state"]
        assert (state.type, state.joints) == ("my_robotics/msg/Count", ("pan",))
        with pytest.raises(dxlrun.Refused, match="there is no topic /count/states; there are /count/state"):
            robot.newest("/count/states")
        found = []
        for message in robot.listen("/count/state"):
            found.append(message)
            if len(found) == 20:
                with dxlrun.connect() as other:
                    other.stop(wait=False)
    code, said = running.wait(DEADLINE_S), (tmp_path / "stderr").read_text()
    assert code == 0 or "stood still" in said, said  # the machine may have had no processor for it
    (log,) = (tmp_path / "logs").glob("*.mcap")
    topic = read_log(log).topics["/count/state"]
    assert topic.column("number").tolist() == [*range(len(topic.data) - 1), -1]
    numbers = [one.number for one in found]
    assert numbers[-1] - numbers[0] + 1 == len(numbers) + sum(one.lost for one in found)
    assert all(one.message["number"] in (one.number - 1, -1) for one in found)
    seconds = topic.column("header.stamp.sec") + topic.column("header.stamp.nanosec") * 1e-9
    assert abs(seconds[-1] - time.time()) < DEADLINE_S  # wall time
    monkeypatch.syspath_prepend(tmp_path)
    replayed = replay_log(log)
    assert (replayed.sentence, replayed.messages) == (
        f"publisher: {replayed.cycles} cycles replayed, 0 differences", len(topic.data),
    )  # fmt: skip
