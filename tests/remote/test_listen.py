"""Listening: what the client makes of answers, and a whole run whose messages come live and into the log."""

import asyncio
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.kit.awaited import DEADLINE_S, until
from tests.kit.live_run import LiveRuns, Running
from tests.kit.packages import plugin_folder

import dxlrun
from dxlrun.log.log_reader import read_log
from dxlrun.messages.cdr import Codec
from dxlrun.messages.definition import MessageType
from dxlrun.remote.client import RemoteRobot
from dxlrun.remote.live.listening import MessageIterator
from dxlrun.remote.live.live_topics import framed
from dxlrun.remote.requests.replies import RunEnded, StreamMessage, StreamTopic
from dxlrun_analysis.replay import replay_log

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
LISTENER = "import dxlrun; [print(one.number, flush=True) for one in dxlrun.connect().listen('/cycle')]"


class Link:
    """A link whose streams have what the test writes; its robot may have ended."""

    alive = True

    def __init__(self, first: bytes = b"", status: int = 200) -> None:
        self.first, self.status = first, status
        self.asked: list[str] = []
        self.ended = False

    def exchange(self, method: str, path: str, body: bytes | None) -> tuple[int, bytes]:
        raise NotImplementedError

    def stream(self, path: str) -> tuple[int, bytes, socket.socket]:
        self.asked.append(path)
        self.gateway, end = socket.socketpair()
        return self.status, self.first, end

    def ends(self) -> bool:
        return self.ended

    def close(self) -> None:
        self.gateway.close()


KIND = MessageType("mine/msg/State", "float64 amount\n")
CODEC = Codec(KIND)
OPENED = framed(StreamTopic(0, "/arm/state", KIND.name, KIND.text, ("pan",), 10**9))
OTHER = framed(StreamTopic(1, "/leg/state", KIND.name, KIND.text, (), 10**9))


def sent(*numbers: int, place: int = 0) -> bytes:
    return b"".join(framed(StreamMessage(place, n, n * 1000, CODEC.pack(float(n)))) for n in numbers)


@pytest.fixture
def robot() -> Iterator[Callable[[Link], RemoteRobot]]:
    used: list[Link] = []

    def make(link: Link) -> RemoteRobot:
        used.append(link)
        return RemoteRobot("publisher", link)

    yield make
    for link in used:
        link.close()


def test_every_message_comes_once_and_what_is_missing_is_counted_for_each_topic(robot: Any) -> None:
    link = Link(OPENED + OTHER + sent(7) + sent(100, place=1)[:5])
    listening = iter(robot(link).listen("arm/state", "/leg/state"))
    first = next(listening)
    assert (first.topic, first.type, first.number, first.lost) == ("/arm/state", "mine/msg/State", 7, 0)
    assert (first.time_ns, first.wall_ns, first.joints) == (7000, 10**9 + 7000, ("pan",))
    assert first.message == {"amount": 7.0}
    rest = sent(100, place=1)[5:] + framed_nothing() + sent(8, 9, 15) + sent(103, place=1) + sent(16)
    link.gateway.sendall(rest + framed(RunEnded()))
    assert [(one.topic[1:4], one.number, one.lost) for one in listening] == [
        ("leg", 100, 0), ("arm", 8, 0), ("arm", 9, 0), ("arm", 15, 5), ("leg", 103, 2), ("arm", 16, 0),
    ]  # fmt: skip
    assert link.asked == ["/stream?topic=/arm/state&topic=/leg/state"]


def framed_nothing() -> bytes:
    """Return what shows that the gateway is alive."""
    return bytes(4)


def test_of_the_newest_what_has_come_meanwhile_is_left_out_and_counted(robot: Any) -> None:
    link = Link(OPENED + sent(7))
    listening = iter(robot(link).listen("/arm/state", rate=100.0))
    assert next(listening).number == 7
    link.gateway.sendall(sent(*range(8, 20)))
    link.gateway.sendall(sent(20))
    assert [(one.number, one.lost) for one in (next(listening),)] == [(20, 12)]
    assert link.asked == ["/stream?topic=/arm/state&newest=true&rate=100"]


def test_the_newest_message_may_be_none(robot: Any) -> None:
    assert robot(Link(OPENED + framed(RunEnded()))).newest("/arm/state") is None
    assert robot(Link(OPENED + sent(4) + framed(RunEnded()))).newest("/arm/state").number == 4


def test_async_programs_get_the_same_beside_other_work(robot: Any) -> None:
    link = Link(OPENED)

    async def listen() -> list[int]:
        found, other = [], asyncio.ensure_future(publish())
        async for message in robot(link).listen("/arm/state"):
            found.append(message.number)
        await other
        return found

    async def publish() -> None:
        for number in range(1, 4):
            await asyncio.sleep(0)
            link.gateway.sendall(sent(number))
        link.gateway.sendall(framed(RunEnded()))

    assert asyncio.run(listen()) == [1, 2, 3]


async def collect(listening: MessageIterator) -> list[int]:
    return [message.number async for message in listening]


def numbers(listening: MessageIterator, way: str) -> list[int]:
    """Return the numbers of all messages, by an iterator or by an asynchronous one."""
    return [one.number for one in listening] if way == "for" else asyncio.run(collect(listening))


@pytest.mark.parametrize("way", ["for", "async for"])
def test_a_gateway_that_fails_or_hangs_in_a_run_is_an_error_and_else_an_end(
    robot: Any, way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That of a run that ends removes its socket; of one that is killed it is left."""

    def listen(link: Link) -> list[int]:
        listening = robot(link).listen("/arm/state")
        link.gateway.close()
        return numbers(listening, way)

    with pytest.raises(dxlrun.DxlrunError, match="publisher no longer answers: the connection was closed"):
        listen(Link(OPENED + sent(7)))
    link = Link(OPENED + sent(8))
    link.ended = True
    assert listen(link) == [8]
    monkeypatch.setattr("dxlrun.remote.live.listening.TIMEOUT_S", 0.05)
    with pytest.raises(dxlrun.DxlrunError, match=r"no longer answers: no data for 0\.05 s"):
        numbers(robot(Link(OPENED)).listen("/arm/state"), way)


def test_a_connection_that_is_reset_while_an_async_program_waits_is_an_error(robot: Any) -> None:
    link = Link(OPENED)
    listening = robot(link).listen("/arm/state")
    listening._end.send(b"unread")  # so Linux resets it

    async def wait() -> None:
        asyncio.get_running_loop().call_later(0.02, link.gateway.close)
        await collect(listening)

    with pytest.raises(dxlrun.DxlrunError, match="publisher no longer answers: the connection was closed"):
        asyncio.run(wait())


def test_a_refusal_is_that_of_each_request(robot: Any) -> None:
    answer = b'{"refused": "there is no topic /arm", "code": "unknown_topic", "fields": {}}'
    with pytest.raises(dxlrun.Refused, match="there is no topic /arm") as refused:
        robot(Link(answer, 404)).listen("/arm")
    assert (refused.value.code, refused.value.exit_code) == ("unknown_topic", 2)


@pytest.fixture
def running(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Running]:
    """A robot that publishes, in real time, until it is stopped."""
    plugin_folder(tmp_path, "counting", PLUGIN, "my-robotics")
    (tmp_path / "run").mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "run"))
    runs = LiveRuns(tmp_path)
    yield runs.start("type:=count", "--duration", "300", plugins=tmp_path, gateway=True)
    runs.end()


def test_messages_come_live_until_the_run_ends_and_are_all_in_the_log(
    running: Running,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
) -> None:
    until(dxlrun.running, check=running.lives)
    with dxlrun.connect() as robot:
        (state,) = [one for one in robot.topics() if one.name == "/states/state"]
        assert (state.type, state.joints) == ("my_robotics/msg/Count", ("pan", "tilt"))
        with pytest.raises(dxlrun.Refused, match="no topic /states/states; there are /states/state"):
            robot.newest("/states/states")
        found = []
        sleeper = robot.listen("/states/state", "/joint_states")  # takes nothing before the end
        request.addfinalizer(sleeper.close)
        killed = subprocess.Popen([sys.executable, "-c", LISTENER], stdout=subprocess.PIPE)
        assert killed.stdout is not None
        killed.stdout.readline()
        for message in robot.listen("/states/state"):
            found.append(message)
            if len(found) == 10:
                killed.send_signal(signal.SIGKILL)
                killed.communicate()
            if len(found) == 30:
                with dxlrun.connect() as other:
                    other.stop(wait=False)
    code, _, said = running.finish()
    assert code == 0 or "did not respond" in said, said  # the machine may have had no processor for it
    log = running.log_path()
    assert log is not None
    topic = read_log(log).topics["/states/state"]
    assert topic.column("number").tolist() == [*range(len(topic.data) - 1), -1]
    late = list(sleeper)
    states = [one for one in late if one.topic == "/joint_states"]
    for each in (found, [one for one in late if one.topic == "/states/state"], states):
        numbers = [one.number for one in each]
        assert numbers[-1] - numbers[0] + 1 == len(numbers) + sum(one.lost for one in each)
    assert found[-1].number == len(topic.data)
    assert [one.data for one in found] == [topic.data[one.number - 1] for one in found]
    woken_ns = read_log(log).cycles["woken_ns"]
    assert [one.time_ns for one in states] == [int(woken_ns[one.number - 1]) for one in states]
    seconds = topic.column("header.stamp.sec") + topic.column("header.stamp.nanosec") * 1e-9
    assert abs(seconds[-1] - time.time()) < DEADLINE_S  # wall time
    monkeypatch.syspath_prepend(tmp_path)
    replayed = replay_log(log)
    assert (replayed.sentence, replayed.messages) == (
        f"pair: {replayed.cycles} cycles replayed, 0 differences", len(topic.data),
    )  # fmt: skip
