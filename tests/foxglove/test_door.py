"""The door: a foreign page, a wrong, old or missing token get nothing; half-open connections make room."""

import os
import socket
import ssl
import subprocess
from contextlib import ExitStack, suppress

import pytest
from tests.foxglove.foreign import ForeignViewer
from tests.foxglove.served import PAGE
from tests.kit.awaited import DEADLINE_S
from websockets.exceptions import ConnectionClosed, InvalidMessage, InvalidStatus

from dxlrun import InputError
from dxlrun.remote.network.listener import MOST_UNPROVED
from dxlrun_foxglove.foxglove import tls_of


def refused(url: str, origin: str | None = None, subprotocol: str = "foxglove.websocket.v1") -> int:
    """Return the status with which a viewer is refused; it gets no other byte."""
    with pytest.raises(InvalidStatus) as caught:
        ForeignViewer(url, subprotocol, origin)
    return caught.value.response.status_code


def test_only_the_token_of_this_start_opens_the_door(serve):
    before, served = serve(), serve()
    token = served.server.token
    for wrong in (before.server.token, "", token[:-1], token + "x", token.swapcase(), "%00", "é"):
        assert refused(served.address(wrong)) == 401, wrong
    assert refused(f"ws://127.0.0.1:{served.port}/") == 401
    assert refused(f"ws://127.0.0.1:{served.port}/?Token={token}&token=") == 401
    with ForeignViewer(served.url) as viewer, pytest.raises(ConnectionClosed) as caught:
        viewer.take()  # no robot runs
    assert caught.value.rcvd is not None
    assert caught.value.rcvd.code == 1013
    assert "robot bioloid_torso_imu is not running" in caught.value.rcvd.reason


@pytest.mark.parametrize(
    "origin", ["https://evil.example", "http://127.0.0.1:8080", "null", "file://", PAGE + ":1"]
)
def test_a_foreign_page_gets_nothing_even_with_the_token(serve, origin):
    served = serve()
    assert refused(served.url, origin) == 403
    assert refused(served.address("wrong"), origin) == 401


def test_the_viewer_on_the_web_may_connect(serve):
    with ForeignViewer(serve().url, "foxglove.sdk.v1", PAGE) as viewer:
        assert viewer.socket.subprotocol == "foxglove.sdk.v1"


def test_another_protocol_is_refused(serve):
    assert refused(serve().url, subprotocol="chat") == 400


@pytest.fixture
def patient(monkeypatch):
    """Give handshakes more time than a server does: a busy machine can need longer than 5 s."""
    monkeypatch.setattr("dxlrun_foxglove.foxglove_server.OPENING_S", 120.0)


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("with_tls", [False, True])
def test_half_open_connections_make_room_for_a_viewer(serve, certificate, with_tls):
    served = serve(tls=tls_of(*certificate) if with_tls else None)
    known = ssl.create_default_context(cafile=certificate[0]) if with_tls else None
    before = len(os.listdir("/proc/self/fd"))
    with ExitStack() as opened:
        many = [
            opened.enter_context(socket.create_connection(("127.0.0.1", served.port)))
            for _ in range(2 * MOST_UNPROVED)
        ]
        for one in many[::2]:
            with suppress(ConnectionError):  # ended already
                one.sendall(b"\x16\x03" if with_tls else b"GET / HTTP/1.1\r\n")
        with ForeignViewer(served.url, tls=known) as viewer, pytest.raises(ConnectionClosed):
            viewer.take()
        assert len(os.listdir("/proc/self/fd")) < before + len(many) + MOST_UNPROVED + 10
        many[0].settimeout(DEADLINE_S)
        with suppress(ConnectionResetError):  # closed either way
            assert many[0].recv(1) == b""


@pytest.fixture(scope="module")
def certificate(tmp_path_factory):
    """Certificate and key of 127.0.0.1."""
    place = tmp_path_factory.mktemp("tls")
    cert, key = place / "cert.pem", place / "key.pem"
    words = (
        "openssl req -x509 -nodes -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -days 1 -subj /CN=robot"
    )
    made = [*words.split(), "-addext", "subjectAltName=IP:127.0.0.1", "-out", cert, "-keyout", key]
    subprocess.run(made, check=True, capture_output=True)
    return cert, key


@pytest.mark.usefixtures("patient")
def test_with_a_certificate_there_is_nothing_without_tls(serve, certificate):
    cert, key = certificate
    served = serve(tls=tls_of(cert, key))
    known = ssl.create_default_context(cafile=cert)
    with ForeignViewer(served.url, tls=known) as viewer, pytest.raises(ConnectionClosed):
        viewer.take()
    with pytest.raises(InvalidStatus):
        ForeignViewer(served.address("wrong"), tls=known)
    with pytest.raises(ssl.SSLCertVerificationError):
        ForeignViewer(served.url, tls=ssl.create_default_context())
    with pytest.raises((InvalidMessage, ConnectionError, EOFError)):
        ForeignViewer(served.url.replace("wss", "ws"))
    with pytest.raises(InputError, match="give a certificate and its private key"):
        tls_of(key, cert)
