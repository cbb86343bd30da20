"""Clients of other computers: certificates, roles, one commander; the loop's mailbox is the judge."""

import asyncio
import json
import os
import socket
import ssl
from contextlib import suppress
from datetime import timedelta
from functools import partial

import pytest
from tests.kit.campaigns import campaign
from tests.remote.conftest import STOP, Door

from dxlrun.channels.answers import Code
from dxlrun.errors import DxlrunError, InputError, Refused
from dxlrun.remote.asked import LONGEST_ORIGIN
from dxlrun.remote.client import RemoteRobot, connect
from dxlrun.remote.network.certificates import client_context, counts, keys_place, server_context
from dxlrun.remote.network.commander import LEASE_S
from dxlrun.remote.network.listener import MOST_UNPROVED, ListenAddress, Listener
from dxlrun.remote.network.network_link import NetworkLink, known_robots
from dxlrun.remote.requests.request_table import REQUESTS, Role
from dxlrun.remote.sockets import Address

authority = pytest.importorskip("dxlrun_fleet.authority", reason="needs the extra network")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Keys of a robot and of three clients, made once: directories by name."""
    place = tmp_path_factory.mktemp("settings")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CONFIG_HOME", str(place))
        patch.setattr(authority, "_EARLIER", timedelta(days=2))
        authority.issue("pair", None, 30, keys_place())
        found = {"": place}
        for role in Role:
            name = role.name.lower()
            found[name] = place / name
            authority.issue(name, role, 30, found[name] / "dxlrun" / "keys")
        authority.issue("late", Role.ADMIN, -1, place / "late" / "dxlrun" / "keys")
        patch.setenv("XDG_CONFIG_HOME", str(place / "stranger"))
        authority.issue("stranger", Role.ADMIN, 30, keys_place())
        authority.issue("pair", None, 30, keys_place())
    return found | {name: place / name for name in ("late", "stranger")}


class NetDoor(Door):
    """A gateway that listens on TCP, too."""

    def __init__(self, desk, path, made, monkeypatch):
        super().__init__(desk, path)
        self.made, self.patch = made, monkeypatch
        self.be("")
        self.network = Listener("127.0.0.1", 0, server_context("pair"))
        self.address = Address("pair", *self.network.getsockname())

    def be(self, name):
        """Have the settings of a client from now on."""
        self.patch.setenv("XDG_CONFIG_HOME", str(self.made[name]))

    def robot(self, name):
        """Return the robot as a client of another computer has it."""
        self.be(name)
        link = NetworkLink(self.address, "test")
        self.be("")
        return RemoteRobot("pair", link)

    def while_served(self, act):
        """Serve while a client acts in a thread; return what it returned."""
        return self.open(partial(asyncio.to_thread, act))


@pytest.fixture
def net(desk, tmp_path, made, monkeypatch):
    found = NetDoor(desk, tmp_path / "s.sock", made, monkeypatch)
    yield found
    found.network.close()


def asked(context, address):
    """Return what a request to stop is answered; nothing: the connection was refused."""
    with (
        suppress(OSError),
        socket.create_connection(address[1:]) as end,
        context.wrap_socket(end, server_hostname="pair") as secured,
    ):
        secured.sendall(STOP)
        return secured.recv(100)
    return b""


def test_a_client_looks_listens_and_commands_as_on_the_robots_own_computer(net):
    def act():
        with net.robot("admin") as robot:
            assert robot.info()["robot"] == "pair"
            listening = robot.listen("/joint_states")
            net.desk.finish_cycle()
            assert next(iter(listening)).topic == "/joint_states"
            listening.close()
            robot.send("left", "go", {"positions": [0.5]})
            robot.stop(wait=False)

    net.while_served(act)
    assert [(one.kind, one.origin) for one in net.desk.taken] == [
        ("commander", "client admin: test"),
        ("go", "client admin: test"),
        ("stop", "client admin: test"),
    ]
    assert json.loads(net.desk.taken[0].data) == {"client": "client admin", "instead": "this computer"}


def test_certificate_decides_the_role(net):
    def act():
        with net.robot("observe") as robot:
            assert robot.info()["robot"] == "pair"
            with pytest.raises(Refused) as refused:
                robot.halt()
            assert refused.value.code == Code.NOT_ALLOWED

    net.while_served(act)
    assert net.desk.taken == []


def test_a_robot_has_the_name_by_which_it_can_be_connected_again(net):
    """That in its certificate may be another robot's on this computer, or of the file."""
    net.be("admin")
    (keys_place().parent / "robots.yaml").write_text(f"robots: {{second: '{net.address}'}}")
    for name in ("second", str(net.address)):
        with connect(name) as robot:
            assert robot.name == name
            assert robot.link.__class__ is NetworkLink
    (keys_place().parent / "robots.yaml").unlink()


def test_each_role_may_what_the_table_has_and_the_loop_gets_nothing_else(desk):
    for role in Role:
        for request in REQUESTS:
            desk.taken.clear()
            names = request.path.replace(":path", "").replace("{", "").replace("}", "")
            status, answer = desk.ask(request.method, names, {}, client=(f"client {role.name}", role))
            allowed = role >= request.role
            assert (answer is not None and answer.get("code") == Code.NOT_ALLOWED) == (not allowed)
            assert (status == 403) == (not allowed)
            assert allowed or not desk.taken, request
        desk.now += 2 * LEASE_S
    looks = [one for one in REQUESTS if one.role is Role.OBSERVE]
    assert {one.method for one in looks} == {"GET"}
    assert {(one.method, one.path) for one in REQUESTS if one.role is Role.ADMIN} == {
        ("POST", "/controllers"),
        ("DELETE", "/controllers/{name}"),
        ("POST", "/joints/{name:path}/registers/{item}"),
        ("POST", "/rate"),
    }
    assert {one.method for one in REQUESTS} - {"GET"} <= {"POST", "DELETE"}


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("stranger", "unable to get local issuer certificate|self.signed|unknown ca"),
        ("late", "is expired, revoked or"),
    ],
)
def test_wrong_certificates_are_asked_nothing(net, name, words):
    def act():
        with pytest.raises(DxlrunError, match=words):
            net.robot(name).info()
        refused = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)  # without any certificate
        refused.load_verify_locations(keys_place() / "ca.crt")
        assert asked(refused, net.address) == b""

    net.while_served(act)
    assert net.desk.taken == []


def test_a_clients_certificate_is_none_of_a_robot_and_a_robots_none_of_a_client(net, tmp_path, made):
    """What serves one end does not serve the other, nor does an older TLS."""
    keys = made["admin"] / "dxlrun" / "keys"
    robots = made[""] / "dxlrun" / "keys"

    def act():
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.load_verify_locations(robots / "ca.crt")
        context.load_cert_chain(robots / "pair.crt", robots / "pair.key")
        old = client_context()
        old.minimum_version = ssl.TLSVersion.TLSv1_2
        old.maximum_version = ssl.TLSVersion.TLSv1_2
        assert [asked(one, net.address) for one in (context, old)] == [b"", b""]

    net.be("admin")
    net.while_served(act)
    assert net.desk.taken == []
    net.be("")
    for file in ("crt", "key"):
        (robots / f"admin.{file}").write_bytes((keys / f"client.{file}").read_bytes())
        (robots / f"admin.{file}").chmod(0o600)
    with pytest.raises(InputError, match="admin"):
        server_context("admin")


def test_a_revoked_certificate_is_refused_at_once_also_on_a_connection_that_is_open(net):
    one, other = ([one for one in authority.issued() if one.name == name] for name in ("command", "observe"))

    def act():
        with net.robot("command") as robot:
            robot.halt()
            authority.revoke(*one)
            authority.revoke(*other)
            try:
                for _ in range(2):
                    with pytest.raises(DxlrunError, match="is expired, revoked or"):
                        robot.halt()
            finally:
                (keys_place() / "revoked").unlink()
            robot.stop(wait=False)

    net.while_served(act)
    assert [command.kind for command in net.desk.taken] == ["halt", "stop"]


@pytest.mark.parametrize("written", ["0AFB12", "0afb12", "77\n0aFb12\n"])
def test_serial_of_a_revoked_certificate_counts_in_upper_and_lower_case(written, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    keys_place().mkdir(parents=True)
    (keys_place() / "revoked").write_text(written)
    until = {"notAfter": "Jan  1 00:00:00 2100 GMT"}
    assert not counts(until | {"serialNumber": "0AFB12"})
    assert counts(until | {"serialNumber": "0AFB13"})


def test_one_client_commands_and_another_one_may_stop_or_take_over(desk):
    anna, bert, here = ("anna", Role.ADMIN), ("bert", Role.COMMAND), ("process 7", Role.ADMIN)
    switch = ("POST", "/switch", {"activate": [], "deactivate": ["left"]})
    assert desk.ask(*switch, client=here)[0] == 200
    status, answer = desk.ask(*switch, client=bert)
    assert (status, answer["code"]) == (409, "commanded_by")
    assert "this computer commands this robot" in answer["refused"]
    desk.now += LEASE_S
    assert desk.ask(*switch, client=bert)[0] == 200
    for other in (anna, here):
        assert desk.ask(*switch, client=other)[1]["fields"]["commander"] == "bert"
        assert desk.ask("POST", "/halt", client=other)[0] == 200
        assert desk.ask("GET", "/robot", client=other)[0] == 200
    assert desk.ask("POST", "/take-over", client=anna)[0] == 200
    assert desk.ask(*switch, client=bert)[1]["fields"]["commander"] == "anna"
    assert desk.ask("POST", "/stop", client=bert)[0] == 200
    assert desk.ask("POST", "/take-over", client=("carl", Role.OBSERVE))[0] == 403
    found = [(one.kind, one.origin) for one in desk.taken]
    assert found == [
        ("switch", "process 7"),
        ("commander", "bert"),
        ("switch", "bert"),
        ("halt", "anna"),
        ("halt", "process 7"),
        ("commander", "anna"),
        ("stop", "bert"),
    ]
    assert json.loads(desk.taken[5].data) == {"client": "anna", "instead": "bert"}


@pytest.mark.parametrize(
    ("chosen", "origin"),
    [
        *(
            (text, f"client anna: {text.decode()}")
            for text in (b"bert", b"process 7", b"b" * 200, b"client bert: b")
        ),
        *((text, "client anna") for text in (b"", b"   ", b"\x00\x1b")),
    ],
)
def test_a_name_that_a_client_chose_does_not_hide_that_of_its_certificate(desk, chosen, origin):
    desk.ask("POST", "/stop", client=("client anna", Role.COMMAND), headers=[("x-dxlrun-client", chosen)])
    assert desk.taken[-1].origin == origin[:LONGEST_ORIGIN]


@campaign(ci=150, night=300, release=1000)
def test_half_open_connections_are_closed_and_lock_no_client_out(net, amount):
    def act():
        ends = []
        for number in range(int(amount)):
            end = socket.create_connection(net.address[1:])
            with suppress(ConnectionError):  # closed already, as one of too many
                end.sendall(b"\x16\x03\x01"[: number % 4])
            ends.append(end)
            if number % 50 == 49:
                with net.robot("command") as robot:
                    robot.stop(wait=False)
        left = len(os.listdir("/proc/self/fd")) - len(ends)
        for end in ends:
            end.close()
        return left

    before = len(os.listdir("/proc/self/fd"))
    assert net.while_served(act) < before + MOST_UNPROVED + 30
    assert {command.kind for command in net.desk.taken} == {"stop"}
    assert len(net.desk.taken) == amount // 50


def test_addresses(monkeypatch, tmp_path):
    assert Address.parse("torso@lab3:7660") == ("torso", "lab3", 7660)
    assert Address.parse("[::1]:7660", "torso") == ("torso", "::1", 7660)
    assert str(Address.parse("t@[::1]:1")) == "t@[::1]:1"
    for wrong in ("lab3", "lab3:0", "a@b@c:1", "a@b:65536", "", "a@:1", "a@b:1 "):
        with pytest.raises(InputError, match="is not an address"):
            Address.parse(wrong, "torso")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    (tmp_path / "dxlrun").mkdir()
    (tmp_path / "dxlrun" / "robots.yaml").write_text("robots:\n  torso: lab3:7660\n  arm: lab4\n  leg: x:y\n")
    with pytest.raises(InputError) as found:
        known_robots()
    places = [(one.mark.line, one.mark.column) for one in found.value.problems]
    assert places == [(3, 8), (4, 8)]
    (tmp_path / "dxlrun" / "robots.yaml").write_text("robots: {torso: 'lab3:7660', b: 'c@lab4:1'}")
    assert known_robots() == {"torso": ("torso", "lab3", 7660), "b": ("c", "lab4", 1)}
    with pytest.raises(InputError, match="is missing; make it on the robot's computer by `dxlrun keys "):
        connect("torso")


def test_a_key_that_others_can_read_and_certificates_that_do_not_fit_are_refused(made, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    with monkeypatch.context() as patch:
        patch.setattr(authority, "_EARLIER", timedelta(days=2))
        authority.issue("arm", None, -1, keys_place())
    with pytest.raises(InputError, match="certificate has expired; renew it by `dxlrun keys renew arm`"):
        server_context("arm")
    authority.issue("arm", None, 1, keys_place())
    server_context("arm")
    key = keys_place() / "arm.key"
    key.chmod(0o640)
    with pytest.raises(InputError, match="chmod 600"):
        server_context("arm")
    key.chmod(0o600)
    key.write_bytes((made[""] / "dxlrun" / "keys" / "pair.key").read_bytes())
    with pytest.raises(InputError, match="do not match"):
        server_context("arm")
    with pytest.raises(InputError, match=r"leg\.crt is missing"):
        server_context("leg")


def test_a_certificate_that_cannot_be_written_does_not_count_as_issued(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    (tmp_path / "text").write_text("Dear servo")
    for place in ("text", "text/below"):
        with pytest.raises(InputError, match=f"{place} cannot be written"):
            authority.issue("anna", Role.COMMAND, 30, tmp_path / place)
    assert [*authority.issued()] == []
    authority.issue("anna", Role.COMMAND, 30, tmp_path / "anna")
    assert [one.name for one in authority.issued()] == ["anna"]


# The value of --listen of `view` and `foxglove`


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("127.0.0.1", ListenAddress("127.0.0.1", None)),
        (":9000", ListenAddress("127.0.0.1", 9000)),
        (":0", ListenAddress("127.0.0.1", 0)),
        ("lab3:9000", ListenAddress("lab3", 9000)),
        ("0.0.0.0:65535", ListenAddress("0.0.0.0", 65535)),  # noqa: S104
        ("::1", ListenAddress("::1", None)),
        ("::", ListenAddress("::", None)),
        ("fe80::1:9000", ListenAddress("fe80::1:9000", None)),
        ("[::1]", ListenAddress("::1", None)),
        ("[::1]:9000", ListenAddress("::1", 9000)),
    ],
)
def test_place_is_read_from_its_text(text, place):
    assert ListenAddress.parse(text) == place


@pytest.mark.parametrize("text", ["", ":", ":65536", ":99999999", "lab3:", "lab3:http", "x:y:z", "[::1]9000"])
def test_text_that_is_no_place_is_refused(text):
    with pytest.raises(InputError, match="write HOST:PORT, HOST or :PORT"):
        ListenAddress.parse(text)
