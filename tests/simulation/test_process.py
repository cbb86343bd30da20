from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import pytest
import rustypot
import serial
from tests.kit.awaited import DEADLINE_S
from tests.kit.bus_process import bare, opened, receive

from dxlsim.bus.ledger import Ledger, read_ledger
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.serving.pseudo_terminal import DeviceLink, PseudoTerminal
from dxlsim.serving.realtime_serving import PollBudget
from dxlsim.serving.simulation_server import _WRITTEN, lateness_us
from dxlsim.simulation_plan import BusConfig, ServoConfig, SimulationConfig
from dxlwire.control_table import find_table

PING_1 = bytes.fromhex("ff ff 01 02 01 fb")
PONG_1 = bytes.fromhex("ff ff 01 02 00 fc")
READ_1 = bytes.fromhex("ff ff 01 04 02 24 06 ce")
BUSES = (
    BusConfig("main", 1_000_000, tuple(ServoConfig(each, "AX-12A", 2.0) for each in (1, 2))),
    BusConfig("arm", 57_600, (ServoConfig(1, "AX-12A", 1.0, 0),)),
)


@pytest.fixture
def start(start_buses: Callable[..., Any]) -> Callable[[], Any]:
    return lambda: start_buses(BUSES)


def test_it_answers_as_a_servo_on_a_serial_port(start):
    running = start()
    assert sorted(running.ports) == ["arm", "main"]
    with opened(running.ports["main"]) as main, opened(running.ports["arm"]) as arm:
        os.write(main, PING_1)
        os.write(arm, PING_1)
        assert receive(main, 6) == PONG_1
        assert receive(arm, 6) == PONG_1
    assert running.hang_up() == 0


def test_the_ledger_holds_exactly_what_passed_and_no_reply_is_early(start):
    running = start()
    received = b""
    with opened(running.ports["main"]) as port:
        for _ in range(20):
            os.write(port, READ_1)
            received += receive(port, 12)
    assert running.hang_up() == 0
    entries = running.ledger()
    assert [entry.direction for entry in entries] == ["in", "out"] * 20
    assert b"".join(entry.data for entry in entries if entry.direction == "in") == READ_1 * 20
    assert b"".join(entry.data for entry in entries if entry.direction == "out") == received
    for asked, answered in zip(entries[::2], entries[1::2], strict=True):
        assert answered.t_ns - asked.t_ns == 700_000  # 8 bytes, 500 us, 12 bytes; on the bus' own clock
    for answered, asked in zip(entries[1::2], entries[2::2], strict=False):
        assert asked.t_ns >= answered.t_ns  # the host got it before it asked again


def test_hosts_may_come_and_go(start):
    running = start()
    for _ in range(3):
        with opened(running.ports["main"]) as port:
            os.write(port, PING_1)
            assert receive(port, 6) == PONG_1
    assert running.hang_up() == 0


def test_no_process_has_the_port_of_a_host_that_looks_for_others(start):
    """As programs do that end whoever has the port they want, by `lsof` or `fuser -k`."""
    running = start()

    def holders() -> list[int]:
        found = []
        for descriptor in Path("/proc").glob("[0-9]*/fd/*"):
            with contextlib.suppress(OSError):
                if os.readlink(descriptor) == running.ports["main"]:
                    found.append(int(descriptor.parts[2]))
        return found

    assert holders() == []
    with opened(running.ports["main"]) as port:
        assert holders() == [os.getpid()]
        os.write(port, PING_1)
        assert receive(port, 6) == PONG_1
    assert running.hang_up() == 0


def test_a_terminal_without_a_host_is_reported_once():
    terminal = PseudoTerminal(SimulatedBus(BUSES[0], Ledger(), 0))
    with contextlib.closing(terminal), select.epoll() as waiting:
        with opened(terminal.path) as port:
            waiting.register(terminal.fileno(), _WRITTEN)
            os.write(port, PING_1)
            assert waiting.poll(DEADLINE_S) == [(terminal.fileno(), select.EPOLLIN)]
            terminal.read_chunk()
        waiting.poll(DEADLINE_S)  # the host is gone
        assert waiting.poll(0) == []
        with opened(terminal.path) as port:
            os.write(port, PING_1)
            assert waiting.poll(DEADLINE_S)


def test_interrupt_is_left_to_the_front_process_and_sigterm_ends_in_order(start):
    running = start()
    with opened(running.ports["main"]) as port:
        os.kill(running.child.pid, signal.SIGINT)
        os.write(port, PING_1)
        assert receive(port, 6) == PONG_1
    os.kill(running.child.pid, signal.SIGTERM)
    assert running.child.wait(DEADLINE_S) == 0
    assert [entry.data for entry in running.ledger()] == [PING_1, PONG_1]


def test_a_host_that_never_reads_does_not_stop_it(start):
    running = start()
    with opened(running.ports["main"]) as port:
        for _ in range(3000):
            os.write(port, READ_1)
    with opened(running.ports["arm"]) as port:
        os.write(port, PING_1)
        assert receive(port, 6) == PONG_1
    assert running.hang_up() == 0


def test_what_does_not_fit_into_the_terminal_is_lost_and_noted():
    bus = SimulatedBus(BUSES[0], Ledger(), 0)
    terminal = PseudoTerminal(bus)
    for now in range(10**9, 10**11, 10**9):  # 400 kB, and no host reads
        bus.inject_noise(bytes(4000), now - 10**8)
        terminal.deliver(now)
    assert any("the host does not read" in entry.note for entry in bus.ledger.entries)
    terminal.read_chunk()  # the host has sent nothing
    terminal.deliver_bytes(10**11)
    terminal.close()
    assert not [entry for entry in bus.ledger.entries if entry.direction == "in"]


def test_a_host_that_opens_the_port_at_another_rate_changes_the_lines_rate():
    bus = SimulatedBus(BUSES[0], Ledger(), 0)
    terminal = PseudoTerminal(bus)
    for now, rate in enumerate((1_000_000, 57_600, 1_000_000), 1):
        with serial.Serial(terminal.path, rate) as port:
            port.write(PING_1)
            select.select([terminal], [], [])
            terminal.read_chunk()
            terminal.deliver_bytes(now * 10**9)
        assert bus.baud_rate == rate
    terminal.close()


def test_what_a_host_writes_while_others_are_served_is_not_of_the_moment_before():
    bus = SimulatedBus(BUSES[0], Ledger(), 0)
    terminal = PseudoTerminal(bus)
    with opened(terminal.path) as port:
        os.write(port, READ_1)
        select.select([terminal], [], [])
        terminal.read_chunk()
        os.write(port, READ_1)
        select.select([terminal], [], [])
        terminal.deliver_bytes(10**9)
        terminal.read_chunk()
        terminal.deliver_bytes(2 * 10**9)
    terminal.close()
    received = [(entry.t_ns, entry.data) for entry in bus.ledger.entries if entry.direction == "in"]
    assert received == [(10**9, READ_1), (2 * 10**9, READ_1)]


def test_a_foreign_driver_finds_every_item_where_the_servo_holds_it(start):
    """rustypot, written by others in Rust, talks to our servo: its addresses, its packets, its units."""
    running = start()
    table = find_table("AX-12A")
    foreign = rustypot.AxPyController(running.ports["main"], 1_000_000, DEADLINE_S)
    values = {"id": 1, "baud_rate": 1, "cw_angle_limit": 10, "moving_speed": 300, "punch": 40, "led": 1}
    for name, wire in values.items():
        foreign.write_register(1, {"baud_rate": "baudrate"}.get(name, name), wire)
    for item in table.items.values():
        name = {"baud_rate": "baudrate"}.get(item.name, item.name)
        ours = int.from_bytes(bytes(foreign.read_raw_data(1, item.address, item.size)), "little")
        assert foreign.read_register(1, name) == ours
        if item.name in values:
            assert ours == values[item.name]
    assert foreign.ping(2)
    foreign.sync_write_raw_goal_position([1, 2], [600, 400])
    assert foreign.read_raw_goal_position(1) == [600]
    foreign.close()
    assert running.hang_up() == 0
    assert not [
        entry.note for entry in running.ledger() if entry.note
    ]  # nothing was refused, nothing collided


def test_a_starter_that_ends_before_it_has_read_the_ports_ends_it():
    with bare(BUSES) as (child, control):
        assert select.select([control], [], [], DEADLINE_S)[0]
        control.close()  # with the ports unread: the other end sees a reset, not an end
        assert child.communicate(timeout=DEADLINE_S)[1] == b""
        assert child.returncode == 0


def test_a_full_disk_does_not_stop_it_and_is_reported_at_the_end():
    with bare(BUSES, ledger="/dev/full") as (child, control):
        with control.makefile("rb") as sent, opened(json.loads(sent.readline())["ports"]["main"]) as port:
            os.write(port, PING_1)
            assert receive(port, 6) == PONG_1
        control.close()
        assert b"No space left" in child.communicate(timeout=DEADLINE_S)[1]
        assert child.returncode == 1


@dataclass
class Talk:
    """Lines of JSON with the process."""

    control: socket.socket
    sent: IO[bytes]

    def ask(self, **question: object) -> dict[str, Any]:
        self.control.sendall(json.dumps(question).encode() + b"\n")
        return self.next()

    def next(self) -> dict[str, Any]:
        answer: dict[str, Any] = json.loads(self.sent.readline())
        return answer


@contextlib.contextmanager
def talking(config: SimulationConfig, **options: object) -> Iterator[tuple[Talk, dict[str, Any]]]:
    """Start it and give what it sends first; it must end in order."""
    with bare(config, **options) as (child, control):
        control.settimeout(DEADLINE_S)
        with control.makefile("rb") as sent:
            talk = Talk(control, sent)
            yield talk, talk.next()
        control.close()
        assert child.communicate(timeout=DEADLINE_S)[1] == b""
        assert child.returncode == 0


def test_a_look_shows_every_servo():
    with talking(SimulationConfig(BUSES)) as (talk, first):
        assert "lateness_us" not in talk.ask(look=True)
        with opened(first["ports"]["main"]) as port:
            os.write(port, PING_1)
            receive(port, 6)
        look = talk.ask(look=True)
    one, two, other = look["servos"]
    assert (one["bus"], one["id"], one["model"]) == ("main", 1, "AX-12A")
    assert (one["heard"], one["answered"], two["heard"], other["bus"]) == (1, 1, 0, "arm")
    assert one["present"] == pytest.approx(2.0, abs=0.01)
    assert (one["torque"], one["error"]) == (False, 0)
    assert 0 <= look["lateness_us"]["median"] <= look["lateness_us"]["maximum"]


def test_a_starter_that_reads_nothing_does_not_stop_it():
    with talking(SimulationConfig(BUSES)) as (talk, first):
        talk.control.setblocking(False)
        for _ in range(5000):  # each is answered by 150 bytes, and so is the last one
            with contextlib.suppress(BlockingIOError):
                talk.control.sendall(b'{"fault":"noise bus=main at=9s"}\n' * 10)
        with opened(first["ports"]["main"]) as port:
            os.write(port, PING_1)
            assert receive(port, 6) == PONG_1
        talk.control.settimeout(DEADLINE_S)


def test_faults_by_hand_happen_and_are_reported():
    with talking(SimulationConfig(BUSES)) as (talk, first):
        assert "bus" in talk.ask(fault="lose servo=1")["error"]  # there are two
        assert "error" in talk.ask(fault="explode")
        assert talk.ask(fault="lose  bus=main servo=1")["fault"] == "lose bus=main servo=1"
        with opened(first["ports"]["main"]) as port:
            os.write(port, PING_1)
            assert talk.next() == {"happened": "lose bus=main servo=1"}
            os.write(port, PING_1)
            assert receive(port, 6) == PONG_1


@pytest.mark.parametrize(
    ("config", "reason"),
    [
        (SimulationConfig(BUSES, faults=("lose bus=main servo=9",)), "no servo 9"),
        (SimulationConfig(BUSES, links={"main": "/nowhere/link"}), "/nowhere/link"),
        (SimulationConfig((BusConfig("main", 3, BUSES[0].servos),)), "3 bit/s"),
    ],
)
def test_what_cannot_be_served_is_refused_with_a_sentence(config, reason):
    with bare(config) as (child, control):
        with control.makefile("rb") as sent:
            assert reason in json.loads(sent.readline())["error"]
        assert child.communicate(timeout=DEADLINE_S)[1] == b""
        assert child.returncode == 2


def test_an_unplugged_adapter_hangs_up_and_comes_back_under_another_name(tmp_path):
    link = tmp_path / "robot"
    config = SimulationConfig(BUSES, links={"main": str(link)})
    with talking(config) as (talk, first):
        before = first["ports"]["main"]
        assert os.readlink(link) == before
        with opened(str(link)) as port:
            assert "fault" in talk.ask(
                fault="unplug bus=main for=2s"
            )  # longer than a busy machine starves it
            while talk.next() != {"ports": {**first["ports"], "main": ""}}:
                pass
            assert not link.is_symlink()
            assert select.select([port], [], [], DEADLINE_S)[0]
            with contextlib.suppress(OSError):  # EIO on Linux
                assert os.read(port, 10) == b""
            after = talk.next()["ports"]["main"]
            assert after not in ("", before)
            assert os.readlink(link) == after
            with opened(str(link)) as again:
                os.write(again, PING_1)
                assert receive(again, 6) == PONG_1
    assert not link.is_symlink()


def test_real_time_is_requested_and_what_was_granted_is_reported(tmp_path):
    path = tmp_path / "bus.jsonl"
    with talking(SimulationConfig(BUSES), priority=1, core=1023, ledger=str(path)) as (_, first):
        assert "priority 1" in first["real_time"]
        assert "no dedicated core" in first["real_time"]
    assert read_ledger(path)[0].note == f"real time: {first['real_time']}"


RATES = (57_600, 1_000_000, 2_000_000, 4_000_000)


def test_no_reply_is_there_before_wire_time_and_return_delay_have_passed(start_buses):
    """Judged by the host's own clock."""
    ping = bytes.fromhex("ff ff fd 00 01 03 00 01 19 4e")
    servo = ServoConfig(1, "XM430-W350", 2.0, 200_000)
    buses = [BusConfig(str(rate), rate, (servo,), 2.0) for rate in RATES]
    running = start_buses(buses)
    for rate in RATES:
        bound_ns = (len(ping) + 14) * 10_000_000_000 // rate + 200_000
        with opened(running.ports[str(rate)]) as port:
            for _ in range(40):
                asked_ns = time.monotonic_ns()
                os.write(port, ping)
                receive(port, 14)
                assert time.monotonic_ns() - asked_ns >= bound_ns
    assert running.hang_up() == 0
    replies = [entry for entry in running.ledger() if entry.direction == "out"]
    assert len(replies) == 40 * len(RATES)
    assert all(entry.late_ns > 0 for entry in replies)  # none was handed over before it was due


def test_polling_is_bounded_and_sleeping_is_not_endless():
    budget, now, polled = PollBudget(0), 0, 0
    for _ in range(100_000):  # something is always due in 60 us
        wait_s = budget.sleep_s(now + 60_000, now)
        assert wait_s is not None
        spent = 1_000 if wait_s == 0 else round(wait_s * 1e9)
        polled += spent if wait_s == 0 else 0
        now += spent
        budget.woke(now)
    assert polled < now / 6 + 25_000_000
    assert budget.sleep_s(None, now) is None
    assert budget.sleep_s(now - 5, now + 10**9) == 0
    assert budget.sleep_s(now + 3 * 10**9, now + 2 * 10**9) == pytest.approx(1.0, abs=1e-3)


def test_a_host_that_floods_the_line_feels_its_rate(start_buses):
    running = start_buses([BusConfig("slow", 57_600, (ServoConfig(1, "AX-12A", 1.0),))])
    with opened(running.ports["slow"]) as port:
        os.set_blocking(port, False)
        sent = 0
        while sent < 1_000_000 and select.select([], [port], [], 0.3)[1]:  # 3 minutes of the line
            with contextlib.suppress(BlockingIOError):
                sent += os.write(port, bytes(4096))
        assert sent < 1_000_000
    assert running.hang_up() == 0


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
