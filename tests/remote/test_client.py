"""The client: what it sends, what it never sends twice, and its errors when a robot is gone."""

import socket
import threading

import numpy as np
import pytest

import dxlrun
from dxlrun.remote import client as module
from dxlrun.remote.sockets import MOST_BYTES, SocketLink, create_listener


def answer(body, status=b"200 OK"):
    return b"HTTP/1.1 %s\r\nContent-Length: %d\r\n\r\n%s" % (status, len(body), body)


OK = answer(b'{"done": true}')


class Peer:
    """A gateway that gives one answer after the other: bytes, or None to hang up."""

    def __init__(self, answers):
        self.listener, self.path = create_listener("pair")
        self.answers = list(answers)
        self.heard = []
        self.connections = 0
        self.thread = threading.Thread(target=self._serve)
        self.thread.start()

    def _serve(self):
        while self.answers:
            with self.listener.accept()[0] as end:
                self.connections += 1
                while self.answers and (request := self._request(end)):
                    self.heard.append(request)
                    said = self.answers.pop(0)
                    if said is None:
                        if not self.answers:
                            self.listener.close()  # as a process that dies: no client can come any more
                        break
                    end.sendall(said)
        self.listener.close()

    def _request(self, end):
        data = b""
        while b"\r\n\r\n" not in data:
            data += (more := end.recv(65536))
            if not more:
                return b""
        head, _, body = data.partition(b"\r\n\r\n")
        length = int(
            next((line[16:] for line in head.split(b"\r\n") if line.startswith(b"Content-Length: ")), 0)
        )
        while len(body) < length:
            body += end.recv(65536)
        return head + b"\r\n\r\n" + body


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path / "dxlrun"


@pytest.fixture
def peer(place):
    """Return how to start a gateway with some answers, and a client of it."""
    peers = []

    def make(*answers):
        peers.append(Peer(answers))
        robot = module.RemoteRobot("pair", SocketLink(peers[-1].path, "anna"))
        peers[-1].robot = robot
        return peers[-1]

    yield make
    for one in peers:
        one.robot.close()
        while one.thread.is_alive() and one.answers:
            one.answers.clear()
            with socket.socket(socket.AF_UNIX) as last:
                last.connect_ex(str(one.path))
        one.thread.join()


def test_arrays_of_numpy_are_sent_as_lists_and_names_cannot_leave_their_place(peer):
    one = peer(OK)
    one.robot.send("a/../b?", "go", {"positions": np.array([1.0, 2.0]), "count": np.int64(3)})
    head, _, body = one.heard[0].partition(b"\r\n\r\n")
    assert head.startswith(b"POST /controllers/a%2F..%2Fb%3F/commands/go HTTP/1.1\r\n")
    assert body == b'{"positions": [1.0, 2.0], "count": 3}'
    assert b"X-Dxlrun-Client: anna" in head


def test_a_clients_name_may_be_any_text(place):
    with create_listener("pair")[0]:
        robot = dxlrun.connect(client="Jürgen 机器\r\nX-Evil: 1")
    assert robot.link.client == "Jürgen 机器X-Evil: 1"


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        (
            {"positions": [0.0, float("nan")]},
            r"positions\[1\] is nan, but must be a finite number; correct it",
        ),
        ({"points": [{"time": float("inf")}]}, r"points\[0\].time is inf, but must be a finite number"),
        ({"positions": np.array([1.0, np.inf])}, r"positions\[1\] is inf, but must be"),
        ({"positions": {1, 2}}, "the request cannot be sent: set cannot be written as JSON"),
        ({"positions": "a" * MOST_BYTES}, "the request has 10485.. bytes, more than 1048576"),
    ],
)
def test_what_cannot_be_sent_is_refused_here(peer, command, sentence):
    one = peer(OK)
    with pytest.raises(dxlrun.Refused, match=sentence):
        one.robot.send("head", "go", command)
    one.robot.pause()
    assert len(one.heard) == 1  # the pause


def test_a_refusal_is_raised_with_its_sentence(peer):
    one = peer(
        answer(b'{"refused": "it is paused already"}', b"409 Conflict"), answer(b"{}", b"418 Teapot"), OK
    )
    with pytest.raises(dxlrun.Refused, match="it is paused already"):
        one.robot.pause()
    with pytest.raises(dxlrun.Refused, match="HTTP status 418"):
        one.robot.pause()
    one.robot.resume()
    assert one.connections == 1


@pytest.mark.parametrize(
    "said",
    [None, b"rubbish\r\n\r\n", answer(b"Service Unavailable", b"503 no"), answer(b"[]"), OK[:-3]],
    ids=["hang up", "rubbish", "no JSON", "a list", "cut off"],
)
def test_what_may_have_been_received_is_never_sent_again(peer, said, monkeypatch):
    monkeypatch.setattr("dxlrun.remote.sockets.TIMEOUT_S", 0.2)
    one = peer(said, OK)
    with pytest.raises(dxlrun.DxlrunError, match=r"pair (no longer answers|sent an unknown reply)") as caught:
        one.robot.send("head", "go", {})
    assert not isinstance(caught.value, dxlrun.Refused)
    assert len(one.heard) == 1


def interrupt(end):
    """Be interrupted when the answer has come."""
    end.recv(65536)
    raise KeyboardInterrupt


@pytest.mark.parametrize("why", ["interrupted", "will be closed", "was closed while idle", "idle for long"])
def test_a_connection_that_may_not_serve_is_not_used_again(peer, monkeypatch, why):
    closing = OK.replace(b"\r\n\r\n", b"\r\nConnection: close\r\n\r\n")
    one = peer(closing if why == "will be closed" else OK, OK)
    if why == "interrupted":  # its answer must not meet the next question
        with monkeypatch.context() as patch:
            patch.setattr("dxlrun.remote.sockets._answer", interrupt)
            with pytest.raises(KeyboardInterrupt):
                one.robot.pause()
    else:
        one.robot.pause()
    if why == "was closed while idle":
        one.robot.link._end.shutdown(socket.SHUT_RDWR)  # as when the gateway closes it
    elif why == "idle for long":
        monkeypatch.setattr("dxlrun.remote.sockets._IDLE_S", -1.0)
    one.robot.resume()
    assert (len(one.heard), one.connections) == (2, 2)


def test_the_choice_of_a_robot_must_be_clear():
    with pytest.raises(dxlrun.DxlrunError, match="no running robot found; start one"):
        dxlrun.connect()
    with create_listener("torso")[0]:
        assert dxlrun.connect().name == "torso"
        with pytest.raises(dxlrun.DxlrunError, match="robot pair is not running; choose one of: torso"):
            dxlrun.connect("pair")
        with pytest.raises(dxlrun.DxlrunError, match=r"torso\.yaml is a robot file; give the robot's `name`"):
            dxlrun.connect("torso.yaml")
        with create_listener("pair")[0]:
            assert dxlrun.connect("pair").name == "pair"
            with pytest.raises(dxlrun.DxlrunError, match="several robots run: pair, torso; name one"):
                dxlrun.connect()


def test_motion_file_that_is_missing_is_refused_without_a_request(peer):
    with pytest.raises(dxlrun.InputError, match=r"nosuch\.yaml:1:1: file not found; check the path"):
        peer(None).robot.play("nosuch.yaml")


def test_a_stop_without_an_answer_of_a_robot_that_ended_is_a_stop(peer):
    one = peer(None)
    one.robot.stop()
    assert one.heard[0].startswith(b"POST /stop ")


def test_a_stop_is_sent_again_when_a_running_robot_closed_the_connection(peer):
    one = peer(None, OK)
    one.robot.stop()
    assert [request[:11] for request in one.heard] == [b"POST /stop "] * 2


def test_a_stop_that_a_living_robot_never_answers_is_an_error(peer, monkeypatch):
    monkeypatch.setattr(module, "_STOP_S", 0.0)
    one = peer(None, None, OK)
    with pytest.raises(dxlrun.DxlrunError, match="pair closed every connection for 0 s"):
        one.robot.stop()


def test_a_queue_of_connections_that_stays_full_is_an_error_with_its_reason(place, monkeypatch):
    monkeypatch.setattr("dxlrun.remote.sockets.TIMEOUT_S", 0.05)
    listener, path = create_listener("pair")
    listener.listen(0)
    with listener, socket.socket(socket.AF_UNIX) as waiting:
        waiting.connect(str(path))
        with pytest.raises(dxlrun.DxlrunError, match=r"pair no longer answers: .* full for 0\.05 s"):
            module.RemoteRobot("pair", SocketLink(path, "anna")).pause()
