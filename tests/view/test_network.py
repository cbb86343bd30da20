"""The page beyond this computer: certificates of both ends, and what the role of a browser allows."""

import ssl
from http.client import HTTPException

import pytest

from dxlrun import InputError
from dxlrun.remote.network.certificates import client_context, keys_place, server_context
from dxlrun.remote.requests.request_table import Role
from dxlrun_view.page_server import HEADER

authority = pytest.importorskip("dxlrun_fleet.authority", reason="needs the extra network")
ROBOT = "bioloid_torso_imu"


@pytest.fixture
def browse(tmp_path, monkeypatch):
    """Makes what a browser with a certificate of a role shows; the robot's is in the settings."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    authority.issue(ROBOT, None, 30, keys_place())

    def made(role: str) -> ssl.SSLContext:
        place = tmp_path / role
        authority.issue(role, Role[role.upper()], 30, place / "dxlrun/keys")
        with monkeypatch.context() as patch:
            patch.setenv("XDG_CONFIG_HOME", str(place))
            context = client_context()
        context.check_hostname = False  # the test has no name for 127.0.0.1
        return context

    return made


def test_a_browser_with_a_certificate_gets_the_page(recorded, serve, browse):
    served = serve(recorded, control=True, tls=server_context(ROBOT))
    for role in ("observe", "command"):
        served.browser = browse(role)
        assert served.ask("/")[0] in (200, 404)  # 404: the package has no bundle
        shown = served.look(shown=True)["shown"]
        assert shown["control"] is (role == "command")
        status, answer = served.ask("/act", {"verb": "stop"})
        assert (status, b"the role observe" in answer) == ((403, True) if role == "observe" else (409, False))
        assert (
            served.ask("/act", {"verb": "parameters", "controller": "left_arm"})[0] == 409
        )  # a log has none
    assert served.ask("/look", {}, **{HEADER: "wrong"})[0] == 401
    assert served.ask("/look", {}, Origin=f"http://127.0.0.1:{served.port}")[0] == 403
    assert served.ask("/look", {}, Origin=f"https://127.0.0.1:{served.port}")[0] == 200


def test_no_byte_of_the_page_without_a_certificate_that_counts(recorded, serve, browse):
    served = serve(recorded, tls=server_context(ROBOT))
    revoked = browse("observe")
    served.browser = revoked
    assert served.ask("/look", {})[0] == 200
    authority.revoke(next(one for one in authority.issued() if one.name == "observe"))
    stranger = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    stranger.check_hostname, stranger.verify_mode = False, ssl.CERT_NONE
    for context in (None, stranger, revoked):
        served.browser = context
        with pytest.raises((OSError, HTTPException)):
            served.ask("/look", {})
    served.browser = browse("admin")
    assert served.ask("/look", {})[0] == 200


def test_a_robot_without_a_certificate_is_not_served(browse):
    with pytest.raises(InputError, match="make it by `dxlrun keys robot arm`"):
        server_context("arm")
