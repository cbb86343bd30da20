"""A foreign viewer of a running robot: the log's bytes, and what it may change, judged by log and ledger."""

import random
import re
import signal
import struct
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest
from mcap.reader import make_reader
from tests.foxglove import fuzz
from tests.foxglove.foreign import ForeignViewer
from tests.kit.awaited import DEADLINE_S, until
from tests.kit.campaigns import campaign
from tests.kit.fuzzed_http import memory
from tests.kit.pages import page_text
from tests.kit.torso import JOINT, SERVO, TORQUE_ENABLE, Run
from websockets.exceptions import ConnectionClosed

import dxlrun

COMMANDS = re.findall(r"^    dxlrun (foxglove.*)$", page_text("foxglove.md"), re.MULTILINE)
MAIN = "from dxlrun.cli import main; main()"
ROBOT = "bioloid_torso_imu"
LATCHED = {"/robot_description", "/tf_static"}
EVERY = {"/cycle", "/joint_states", "/joint_commands", "/tf", "/imu/imu", "/diagnostics", *LATCHED}
SPEED = "left_arm.speed"


@pytest.fixture
def run(tmp_path, monkeypatch):
    one = Run(tmp_path, record=True)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    one.start()
    yield one
    one.end()


class Started(NamedTuple):
    url: str
    process: int


@pytest.fixture
def started(run):
    """A server for each command of docs/how-to/foxglove.md; Ctrl-C ends them."""
    processes = [
        subprocess.Popen(
            [sys.executable, "-P", "-c", MAIN, *words.split()], stdout=subprocess.PIPE, text=True
        )
        for words in COMMANDS
    ]
    found = [re.search(r"ws://\S+", (one.stdout or sys.stdin).readline()) for one in processes]
    yield [Started(url[0], process.pid) for url, process in zip(found, processes, strict=True) if url]
    for process in processes:
        process.send_signal(signal.SIGINT)
        assert process.wait(DEADLINE_S) == 0
        assert process.stdout is not None
        process.stdout.close()


@campaign(ci=1000, night=100_000, release=1_000_000)
def test_a_viewer_gets_the_logs_bytes_and_steers_only_with_control(run, started, amount, chance):
    looks, control = started
    with ForeignViewer(looks.url) as only_looks, ForeignViewer(control.url) as steers:
        assert (only_looks.first, steers.first) == ("serverInfo", "serverInfo")
        info = only_looks.words("serverInfo")
        assert "services" not in info["capabilities"]
        assert "clientPublish" not in info["capabilities"]
        assert steers.words("serverInfo")["sessionId"] == info["sessionId"]
        only_looks.until(lambda: only_looks.channels.keys() >= EVERY)
        only_looks.subscribe(*only_looks.channels)
        may_not_change(only_looks, steers)
        check_noise_is_harmless(looks, int(amount), chance)
        assert not written(run, TORQUE_ENABLE, 0)
        changes_parameters(only_looks, steers)
        steers_the_robot(run, steers)
        publishers(steers)
        only_looks.until(lambda: sum(topic == "/cycle" for topic, _, _ in only_looks.messages) > 5)
        only_looks.until(lambda: {topic for topic, _, _ in only_looks.messages} >= EVERY)
        with dxlrun.connect(ROBOT) as robot:
            robot.stop(wait=False)
        with pytest.raises(ConnectionClosed) as caught:
            only_looks.until(lambda: False)
        assert caught.value.rcvd is not None
        assert (caught.value.rcvd.code, "has ended" in caught.value.rcvd.reason) == (1001, True)
        assert run.process is not None
        run.process.wait(DEADLINE_S)
    (log,) = run.place.glob("logs/*.mcap")
    same_as_in_the_log(only_looks, log)
    commands = dxlrun.open_log(log).columns("/commands", "kind", "origin")
    asked = commands["kind"][commands["origin"] == "dxlrun foxglove"].tolist()
    assert asked == ["parameters", "torque", "torque", "switch", "halt"]  # the first torque was refused


def written(run: Run, address: int, value: int) -> set[int]:
    return {servo for servo, one in run.written(address).items() if one == value}


def may_not_change(only_looks: ForeignViewer, steers: ForeignViewer) -> None:
    """Whatever it sends: it is refused, and the robot was asked nothing."""
    steers.until(lambda: steers.services)
    only_looks.services = steers.services
    for number, body in enumerate(({}, {"deactivate": ["head"]}, {"joints": [JOINT], "on": False})):
        only_looks.call(list(steers.services)[number], body, number)
        only_looks.until(lambda number=number: number in only_looks.failures)
        assert "--control" in only_looks.failures[number]
    only_looks.say(op="setParameters", parameters=[{"name": SPEED, "value": 0.25}], id="no")
    assert "--control" in only_looks.words("status")["message"]
    only_looks.say(op="advertise", channels=[{"id": 1, "topic": "/commands", "encoding": "cdr"}])
    assert "invalid frame" in only_looks.words("status")["message"]
    only_looks.socket.send(struct.pack("<BI", 1, 1) + b"x")
    assert "invalid frame" in only_looks.words("status")["message"]


def check_noise_is_harmless(looks: Started, frames: int, draw: random.Random) -> None:
    """Send fuzzed frames and handshakes without the token: a viewer still gets in, memory stays bounded."""
    fuzz.fuzz(looks.url, frames // 10, draw)
    fuzz.knock(looks.url, frames // 100, draw)
    before = memory(looks.process)
    fuzz.fuzz(looks.url, frames, draw)
    fuzz.knock(looks.url, frames // 20, draw)
    with ForeignViewer(looks.url) as viewer:
        viewer.words("serverInfo")
    assert memory(looks.process) < before + 20.0, f"{before} MB before"


def changes_parameters(only_looks: ForeignViewer, steers: ForeignViewer) -> None:
    """Each viewer sees what one has changed; what is wrong with a value it is told."""
    only_looks.say(op="subscribeParameterUpdates", parameterNames=[SPEED])
    steers.say(op="getParameters", parameterNames=[SPEED], id="one")
    assert steers.words("parameterValues") == {
        "op": "parameterValues", "id": "one", "parameters": [{"name": SPEED, "value": 1.0}]
    }  # fmt: skip
    steers.say(op="getParameters", parameterNames=[])
    every = steers.words("parameterValues")
    assert "id" not in every
    assert {one["name"].partition(".")[0] for one in every["parameters"]} >= {"left_arm", "right_arm"}
    only_looks.say(op="getParameters", parameterNames=[SPEED], id="subscribed")  # so that it is
    only_looks.words("parameterValues")
    steers.say(op="setParameters", parameters=[{"name": SPEED, "value": 0.5}], id="two")
    assert steers.words("parameterValues")["parameters"] == [{"name": SPEED, "value": 0.5}]
    assert only_looks.words("parameterValues")["parameters"] == [{"name": SPEED, "value": 0.5}]
    for name, value in ((SPEED, -1), (SPEED, "fast"), ("left_arm.joints", "x")):
        steers.say(op="setParameters", parameters=[{"name": name, "value": value}])
        assert name.partition(".")[2] in steers.words("status")["message"]


def steers_the_robot(run: Run, steers: ForeignViewer) -> None:
    """Services do what they say; a refusal has the reason."""
    steers.call("/torque", {"joints": [JOINT], "on": False}, 1)
    steers.until(lambda: 1 in steers.failures)
    assert "release" in steers.failures[1]
    assert not written(run, TORQUE_ENABLE, 0)
    steers.call("/torque", {"joints": [JOINT], "on": False, "release": True}, 2)
    steers.until(lambda: 2 in steers.responses)
    assert steers.responses[2]["joints"] == [JOINT]
    assert until(lambda: written(run, TORQUE_ENABLE, 0)) == {SERVO}
    steers.call("/switch", {"deactivate": ["head"]}, 3)
    steers.until(lambda: 3 in steers.responses)
    steers.call("/halt", {}, 4)
    steers.until(lambda: 4 in steers.responses)
    assert "halted" in steers.responses[4]
    for number, body in enumerate(({"activate": ["nose"]}, {"activat": []}, [], {"activate": "head"}), 5):
        steers.call("/switch", body, number)
        steers.until(lambda number=number: number in steers.failures)
    steers.call("/halt", {}, 9, encoding=b"cdr")
    steers.until(lambda: 9 in steers.failures)


def publishers(viewer: ForeignViewer) -> None:
    viewer.say(op="subscribeConnectionGraph")
    rows = viewer.words("connectionGraphUpdate")["publishedTopics"]
    found = {one["name"]: one["publisherIds"] for one in rows}
    assert found["/joint_states"] == ["joint_state_broadcaster"]
    assert found["/imu/imu"] == ["imu"]
    assert found["/tf"] == [ROBOT]


def same_as_in_the_log(viewer: ForeignViewer, log: Path) -> None:
    """The messages of a topic are those of the log, with their times, one after the other."""
    logged: dict[str, list[tuple[int, bytes]]] = {}
    with log.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            logged.setdefault(channel.topic, []).append((message.log_time, message.data))
            if (shown := viewer.channels.get(channel.topic)) is not None:
                assert shown["schema"] == schema.data.decode()
                assert (shown["schemaName"], shown["schemaEncoding"]) == (schema.name, schema.encoding)
                assert shown["encoding"] == channel.message_encoding
    for topic in {topic for topic, _, _ in viewer.messages}:
        seen = [(time_ns, data) for name, time_ns, data in viewer.messages if name == topic]
        if topic in LATCHED:  # of the time when the run, or the server, began
            assert {without_stamp(*one) for one in seen} == {without_stamp(*one) for one in logged[topic]}
        elif topic != "/diagnostics":  # once a second, from the first cycle that each has seen
            first = logged[topic].index(seen[0])
            assert logged[topic][first : first + len(seen)] == seen, topic


def without_stamp(time_ns: int, data: bytes) -> bytes:
    return data.replace(struct.pack("<iI", *divmod(time_ns, 10**9)), bytes(8))
