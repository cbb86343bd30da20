"""The process of simulated buses: terminals that hosts open, and lines of JSON with its starter."""

import contextlib
import ctypes
import math
import os
import random
import select
import signal
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
import serial
from tests.kit.awaited import DEADLINE_S, until
from tests.kit.bus_process import BusProcess, launch, opened, receive
from tests.kit.packets import packet1

from dxlsim.bus.ledger import Ledger, read_ledger
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.motion.plant import Floats
from dxlsim.serving.pseudo_terminal import DeviceLink, PseudoTerminal
from dxlsim.serving.served_bus import LocalStarter
from dxlsim.serving.simulation_server import Server, lateness_us
from dxlsim.simulation_plan import BusConfig, ServoConfig, SimulationConfig
from dxlsim.wire.compiled_line import ServerState, line_library

PING_1 = bytes.fromhex("ff ff 01 02 01 fb")
PONG_1 = bytes.fromhex("ff ff 01 02 00 fc")
READ_1 = bytes.fromhex("ff ff 01 04 02 24 06 ce")
PING_2 = bytes.fromhex("ff ff fd 00 01 03 00 01 19 4e")
PAIR = tuple(ServoConfig(each, "AX-12A", 2.0) for each in (1, 2))
BUSES = (BusConfig("main", 1_000_000, PAIR), BusConfig("arm", 57_600, (ServoConfig(1, "AX-12A", 1.0, 0),)))
RATES = (57_600, 1_000_000, 2_000_000, 4_000_000)
SERVED = (
    *BUSES,
    *(BusConfig(name, 1_000_000, PAIR) for name in ("exact", "guests", "alone", "unread", "foreign")),
    *(BusConfig(str(rate), rate, (ServoConfig(1, "XM430-W350", 2.0, 200_000),), 2.0) for rate in RATES),
    BusConfig("flood", 57_600, (ServoConfig(1, "AX-12A", 1.0),)),
)
"""Each test takes buses of its own, so that one process serves them all."""


@pytest.fixture(scope="module")
def ledger_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("served") / "bus.jsonl"


@pytest.fixture(scope="module")
def served(ledger_path: Path) -> Iterator[BusProcess]:
    with BusProcess(SERVED, ledger_path) as process:
        yield process


def pings(path: str) -> None:
    with opened(path) as port:
        os.write(port, PING_1)
        assert receive(port, 6) == PONG_1


def test_it_answers_as_servos_on_serial_ports_to_hosts_that_come_and_go(served):
    assert sorted(served.ports) == sorted(bus.name for bus in SERVED)
    with opened(served.ports["main"]) as main, opened(served.ports["arm"]) as arm:
        os.write(main, PING_1)
        os.write(arm, PING_1)
        assert receive(main, 6) == receive(arm, 6) == PONG_1
    for _ in range(3):
        pings(served.ports["guests"])


def test_no_process_has_the_port_of_a_host_that_looks_for_others(served):
    """As programs do that end whoever has the port they want, by `lsof` or `fuser -k`."""
    path = served.ports["alone"]

    def holders() -> list[int]:
        found = []
        for descriptor in Path("/proc").glob("[0-9]*/fd/*"):
            with contextlib.suppress(OSError):
                if os.readlink(descriptor) == path:
                    found.append(int(descriptor.parts[2]))
        return found

    assert holders() == []
    with opened(path):
        assert holders() == [os.getpid()]
    pings(path)


def test_a_host_that_never_reads_does_not_stop_it(served):
    with opened(served.ports["unread"]) as port:
        for _ in range(3000):
            os.write(port, READ_1)
    pings(served.ports["guests"])


def test_a_host_that_floods_the_line_feels_its_rate(served):
    with opened(served.ports["flood"]) as port:
        os.set_blocking(port, False)
        sent = 0
        while sent < 1_000_000 and select.select([], [port], [], 0.3)[1]:  # 3 minutes of the line
            with contextlib.suppress(BlockingIOError):
                sent += os.write(port, bytes(4096))
        assert sent < 1_000_000


def test_no_reply_is_there_before_wire_time_and_return_delay_have_passed(served):
    """Judged by the host's own clock."""
    for rate in RATES:
        bound_ns = (len(PING_2) + 14) * 10_000_000_000 // rate + 200_000
        with opened(served.ports[str(rate)]) as port:
            for _ in range(40):
                asked_ns = time.monotonic_ns()
                os.write(port, PING_2)
                receive(port, 14)
                assert time.monotonic_ns() - asked_ns >= bound_ns


def test_ledger_holds_exactly_what_passed_and_no_reply_is_early(served):
    """The last test of this process, which it ends."""
    received = b""
    with opened(served.ports["exact"]) as port:
        for _ in range(20):
            os.write(port, READ_1)
            received += receive(port, 12)
    ledger = served.hang_up()
    entries = [entry for entry in ledger if entry.bus == "exact"]
    assert [entry.direction for entry in entries] == ["in", "out"] * 20
    assert b"".join(entry.data for entry in entries if entry.direction == "in") == READ_1 * 20
    assert b"".join(entry.data for entry in entries if entry.direction == "out") == received
    for asked, answered in zip(entries[::2], entries[1::2], strict=True):
        assert answered.t_ns - asked.t_ns == 700_000  # 8 bytes, 500 us, 12 bytes; on the bus' own clock
    for answered, asked in zip(entries[1::2], entries[2::2], strict=False):
        assert asked.t_ns >= answered.t_ns  # the host got it before it asked again
    paced = [entry for entry in ledger if entry.bus in map(str, RATES) and entry.direction == "out"]
    assert len(paced) in (0, 40 * len(RATES))  # none where this test runs alone
    assert all(entry.late_ns > 0 for entry in paced)  # none was handed over before it was due
    # nothing was refused, nothing collided
    assert not [entry.note for entry in ledger if entry.bus == "foreign" and entry.note]


# How it starts and ends


def test_a_ledger_is_written_while_no_host_asks_any_more(tmp_path):
    with BusProcess(BUSES, tmp_path / "bus.jsonl") as process:
        with opened(process.ports["main"]) as port:
            os.write(port, READ_1)  # Answered without Python
            assert len(receive(port, 12)) == 12
        until(lambda: len(read_ledger(tmp_path / "bus.jsonl")) == 2, "the entries")


def test_interrupt_is_left_to_the_front_process_and_sigterm_ends_in_order(tmp_path):
    with BusProcess(BUSES, tmp_path / "bus.jsonl") as process:
        os.kill(process.child.pid, signal.SIGINT)
        pings(process.ports["main"])
        os.kill(process.child.pid, signal.SIGTERM)
        assert process.child.wait(DEADLINE_S) == 0
        assert [entry.data for entry in process.hang_up()] == [PING_1, PONG_1]


def test_a_starter_that_ends_before_it_has_read_the_ports_ends_it():
    child, control = launch(BUSES)
    with child, control:
        assert select.select([control], [], [], DEADLINE_S)[0]
        control.close()  # with the ports unread: the other end sees a reset, not an end
        assert child.communicate(timeout=DEADLINE_S)[1] == b""
        assert child.returncode == 0


def test_a_full_disk_does_not_stop_it_and_is_reported_at_the_end():
    with BusProcess(BUSES, Path("/dev/full")) as process:
        pings(process.ports["main"])
        process.hang_up(code=1, error=b"No space left")


@pytest.mark.parametrize(
    ("config", "reason"),
    [
        (SimulationConfig(BUSES, faults=("lose bus=main servo=9",)), "no servo 9"),
        (SimulationConfig(BUSES, links={"main": "/nowhere/link"}), "/nowhere/link"),
        (SimulationConfig((BusConfig("main", 3, PAIR),)), "3 bit/s"),
    ],
)
def test_what_cannot_be_served_is_refused_with_a_sentence(config, reason):
    with BusProcess(config) as process:
        assert reason in process.first["error"]
        process.hang_up(code=2)


def test_real_time_is_requested_and_what_was_granted_is_reported(tmp_path):
    with BusProcess(BUSES, tmp_path / "bus.jsonl", priority=1, core=1023) as process:
        granted = process.first["real_time"]
        assert "priority 1" in granted
        assert "no dedicated core" in granted
        assert process.hang_up()[0].note == f"real time: {granted}"


# Lines of JSON


def test_a_look_shows_every_servo_and_faults_by_hand_happen_and_are_reported():
    with BusProcess(BUSES) as process:
        assert "lateness_us" not in process.ask(look=True)
        pings(process.ports["main"])
        look = process.ask(look=True)
        one, two, other = look["servos"]
        assert (one["bus"], one["id"], one["model"]) == ("main", 1, "AX-12A")
        assert (one["heard"], one["answered"], two["heard"], other["bus"]) == (1, 1, 0, "arm")
        assert one["present"] == pytest.approx(2.0, abs=0.01)
        assert (one["torque"], one["error"]) == (False, 0)
        assert 0 <= look["lateness_us"]["median"] <= look["lateness_us"]["maximum"]
        assert "bus" in process.ask(fault="lose servo=1")["error"]  # there are two
        assert "error" in process.ask(fault="explode")
        assert process.ask(fault="lose  bus=main servo=1")["fault"] == "lose bus=main servo=1"
        with opened(process.ports["main"]) as port:
            os.write(port, PING_1)
            assert process.next() == {"happened": "lose bus=main servo=1"}
        pings(process.ports["main"])
        process.hang_up()


def test_a_starter_that_reads_nothing_does_not_stop_it():
    with BusProcess(BUSES) as process:
        process.control.setblocking(False)
        for _ in range(5000):  # each is answered by 150 bytes, and so is the last one
            with contextlib.suppress(BlockingIOError):
                process.control.sendall(b'{"fault":"noise bus=main at=9s"}\n' * 10)
        pings(process.ports["main"])
        process.control.settimeout(DEADLINE_S)
        process.hang_up()


def test_an_unplugged_adapter_hangs_up_and_comes_back_under_another_name(tmp_path):
    link = tmp_path / "robot"
    with BusProcess(SimulationConfig(BUSES, links={"main": str(link)})) as process:
        before = process.ports["main"]
        assert os.readlink(link) == before
        with opened(str(link)) as port:
            # longer than a busy machine starves it
            assert "fault" in process.ask(fault="unplug bus=main for=2s")
            while process.next() != {"ports": {**process.ports, "main": ""}}:
                pass
            assert not link.is_symlink()
            assert select.select([port], [], [], DEADLINE_S)[0]
            with contextlib.suppress(OSError):  # EIO on Linux
                assert os.read(port, 10) == b""
            after = process.next()["ports"]["main"]
            assert after not in ("", before)
            assert os.readlink(link) == after
            pings(str(link))
        assert "fault" in process.ask(fault="unplug bus=main packet=1")
        with opened(str(link)) as port:
            os.write(port, bytes.fromhex("ff ff 09 02 01 f3"))  # A ping that no servo answers
            while process.next() != {"ports": {**process.ports, "main": ""}}:
                pass
        process.hang_up()
    assert not link.is_symlink()


def test_a_bus_is_a_socket_without_a_terminal_until_its_adapter_is_unplugged(tmp_path):
    ours, theirs = socket.socketpair()
    ledger = tmp_path / "bus.jsonl"
    with ours, theirs, BusProcess(BUSES[:1], ledger, sockets=(theirs.fileno(),)) as process:
        theirs.close()
        assert process.ports == {"main": ""}
        ours.sendall(PING_1)
        assert receive(ours.fileno(), 6) == PONG_1
        assert "fault" in process.ask(fault="unplug bus=main for=50ms")
        assert select.select([ours], [], [], DEADLINE_S)[0]
        assert ours.recv(1) == b""
        while not (path := process.next().get("ports", {}).get("main")):
            pass
        pings(path)
        entries = [entry for entry in process.hang_up() if not entry.note]
        assert [entry.data for entry in entries] == [PING_1, PONG_1] * 2


# Its parts


@pytest.fixture
def terminal() -> Iterator[PseudoTerminal]:
    with contextlib.closing(PseudoTerminal(SimulatedBus(BUSES[0], Ledger(), 0))) as terminal:
        yield terminal


def deliver(terminal: PseudoTerminal, at_ns: int) -> None:
    """Hand over what a host wrote."""
    select.select([terminal], [], [])
    terminal.read_chunk()
    terminal.deliver_bytes(at_ns)


def test_what_a_host_wrote_to_an_unplugged_terminal_is_lost(terminal):
    with opened(terminal.path) as port:
        os.write(port, PING_1)
        select.select([terminal], [], [])
        terminal.read_chunk()
        terminal.bus.unplug()
        terminal.bus.plug_in()
        assert terminal.follow_adapter()
        assert terminal.deliver_bytes(1) == 0


def test_a_terminal_without_a_host_is_reported_once(terminal):
    with select.epoll() as waiting:
        with opened(terminal.path) as port:
            waiting.register(terminal.fileno(), select.EPOLLIN | select.EPOLLET)
            os.write(port, PING_1)
            assert waiting.poll(DEADLINE_S) == [(terminal.fileno(), select.EPOLLIN)]
            terminal.read_chunk()
        waiting.poll(DEADLINE_S)  # the host is gone
        assert waiting.poll(0) == []
        with opened(terminal.path) as port:
            os.write(port, PING_1)
            assert waiting.poll(DEADLINE_S)


def test_what_does_not_fit_into_the_terminal_is_lost_and_noted(terminal):
    for now in range(10**9, 10**11, 10**9):  # 400 kB, and no host reads
        terminal.bus.inject_noise(bytes(4000), now - 10**8)
        terminal.deliver(now)
    entries = terminal.bus.ledger.entries
    assert any("the host does not read" in entry.note for entry in entries)
    terminal.read_chunk()  # the host has sent nothing
    terminal.deliver_bytes(10**11)
    assert not [entry for entry in entries if entry.direction == "in"]


def test_a_host_that_opens_the_port_at_another_rate_changes_the_lines_rate(terminal):
    for now, rate in enumerate((1_000_000, 57_600, 1_000_000), 1):
        with serial.Serial(terminal.path, rate) as port:
            port.write(PING_1)
            deliver(terminal, now * 10**9)
        assert terminal.bus.baud_rate == rate


def test_what_a_host_writes_while_others_are_served_is_not_of_the_moment_before(terminal):
    with opened(terminal.path) as port:
        os.write(port, READ_1)
        select.select([terminal], [], [])
        terminal.read_chunk()
        os.write(port, READ_1)
        select.select([terminal], [], [])
        terminal.deliver_bytes(10**9)
        deliver(terminal, 2 * 10**9)
    entries = terminal.bus.ledger.entries
    received = [(entry.t_ns, entry.data) for entry in entries if entry.direction == "in"]
    assert received == [(10**9, READ_1), (2 * 10**9, READ_1)]


def test_a_sleep_begins_to_end_earlier_by_what_nearly_all_sleeps_are_late():
    late, early_ns, polled_ns = random.Random(1), 0, 0
    for _ in range(10_000):
        late_ns = round(late.expovariate(1e-4)) + 20_000
        polled_ns += max(0, early_ns - late_ns)
        early_ns = line_library().line_early(early_ns, late_ns)
    assert 15_000 < early_ns < 25_000
    assert polled_ns / 10_000 < 500
    assert line_library().line_early(early_ns, 10**12) == 50_000


def test_replies_of_several_lines_wait_for_each_other_for_50_us_at_most():
    chance, buses = random.Random(4), [SimulatedBus(BUSES[0], Ledger(), 0) for _ in range(5)]
    with contextlib.ExitStack() as stack:
        terminals = [stack.enter_context(contextlib.closing(PseudoTerminal(bus))) for bus in buses]
        addresses = (ctypes.c_void_p * 5)(*(ctypes.addressof(each.state) for each in terminals))
        server, waited = ServerState(terminals=ctypes.addressof(addresses), count=5), []
        for now_ns in range(10**9, 10**11, 10**9):
            for bus in buses:
                bus.receive_bytes(READ_1, now_ns + chance.randrange(200_000))
            due = sorted(bus.next_due_ns() or 0 for bus in buses)
            at_ns = line_library().line_find_delivery(ctypes.byref(server))
            assert at_ns == max(each for each in due if each < due[0] + 50_000)
            waited.append(at_ns - due[0])
            for bus in buses:
                bus.drain_bytes(now_ns + 10**8)
    assert 0 in waited
    assert 40_000 < max(waited) < 50_000


def test_a_shaft_moves_to_its_goal_while_no_host_sends(tmp_path):
    class Shafts:
        values, angle = 3, 0.0

        def write_sample(self, t_ns: int, values: Floats) -> None:
            self.angle = values.item(0)

    shafts, link = Shafts(), tmp_path / "port"
    starter = LocalStarter(lambda message: None)
    config = SimulationConfig((BusConfig("main", 1_000_000, PAIR[:1]),), links={"main": str(link)})
    with contextlib.closing(starter):
        server = Server(config, Ledger(), starter, shafts=shafts)
        thread = threading.Thread(target=server.serve_ports, daemon=True)
        thread.start()
        with opened(str(link)) as port:
            os.write(port, packet1(1, 3, 30, 0, 2))  # its goal, in the middle
            until(lambda: abs(shafts.angle - 512 * math.radians(300) / 1023) < 0.02)
        starter.end_server()
        thread.join()


def test_a_link_never_replaces_a_file_and_is_removed_only_where_it_was_put(tmp_path):
    file, link = tmp_path / "file", tmp_path / "link"
    file.write_text("mine")
    with pytest.raises(FileExistsError, match="is not a symbolic link"):
        DeviceLink(file).point("/dev/null")
    one, other = DeviceLink(link), DeviceLink(link)
    one.point("/dev/null")
    other.point("/dev/zero")
    one.remove()
    assert os.readlink(link) == "/dev/zero"
    other.remove()
    assert os.listdir(tmp_path) == ["file"]


def test_lateness_has_quantiles_by_nearest_rank():
    bus = SimpleNamespace(lateness_ns=[1000 * number for number in range(100, 0, -1)])
    assert lateness_us([bus]) == {"median": 50.5, "p99": 99.0, "maximum": 100.0}
