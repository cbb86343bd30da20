"""Serial and simulated ports: their latency timers, deadlines, and pyserial's and the maker's way to them."""

import errno
import fcntl
import os
import pty
import re
import select
import struct
import subprocess
import sys
import termios
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from msgspec.structs import replace

import dxlrun
from dxlrun.channels.child_processes import memory_file
from dxlrun.channels.heartbeat import LineProgress, SimulationProgress, create_progress
from dxlrun.compile.robot_compiler import compile_files
from dxlrun.dynamixel.remedies import CHECK, INJECTED, choose_remedy, describe_late_start, late_replies
from dxlrun.dynamixel.tools.tool_port import TunablePort
from dxlrun.errors import PortError, StartUpError, help_link
from dxlrun.plan.machine_load import MachineLoad
from dxlrun.plan.robot_plan import to_json
from dxlrun.process_table import robot_of
from dxlrun.run.guardian import make_ports
from dxlrun.testing import VirtualRobot, plan_of
from dxlwire.bus_plan import SIMULATED
from dxlwire.port.latency_timer import latency_timer, shorten
from dxlwire.port.ports import LONGEST_STALL_NS, SerialPort, SerialPorts, SimulatedPort, StallCounter
from dxlwire.port.reopening import KeptLines, LineSettings
from dxlwire.port.serial_open import let_go, open_serial, rate_remark


@pytest.fixture
def terminal():
    master, slave = pty.openpty()
    yield master, os.ttyname(slave), slave
    for descriptor in (master, slave):
        with suppress(OSError):
            os.close(descriptor)


@pytest.fixture
def opened(terminal):
    master, path, _ = terminal
    with open_serial(path, 1_000_000) as line:
        yield master, SerialPort(line.fileno(), path), path


def test_bytes_go_out_and_come_in_unchanged(opened):
    master, port, _ = opened
    everything = bytes(range(256))
    port.write_packet(everything)
    assert os.read(master, 1000) == everything
    ports = SerialPorts([port])
    os.write(master, everything)
    buffer = memoryview(bytearray(1000))
    assert ports.wait_for_bytes(time.monotonic_ns() + 5_000_000_000) == [0]
    assert bytes(buffer[: port.read_into(buffer)]) == everything
    assert ports.wait_for_bytes(time.monotonic_ns()) == ()
    assert port.read_into(buffer) == 0


def test_a_line_whose_bytes_somebody_took_is_not_gone(terminal):
    master, _, slave = terminal
    tty.setraw(slave)
    port = SerialPort(slave, "line")
    os.write(master, b"abc")
    assert SerialPorts([port]).wait_for_bytes(time.monotonic_ns() + 5_000_000_000) == [0]
    assert os.read(slave, 10) == b"abc"
    assert port.read_into(memoryview(bytearray(10))) == 0


def test_an_adapter_that_is_gone_is_a_port_error(opened):
    master, port, path = opened
    os.close(master)
    ports = SerialPorts([port])
    assert ports.wait_for_bytes(time.monotonic_ns() + 5_000_000_000) == [0]
    with pytest.raises(PortError, match=f"{path} is gone"):
        port.read_into(memoryview(bytearray(10)))
    with pytest.raises(PortError, match=f"{path} is gone"):
        port.write_packet(b"x")


def test_a_line_that_is_back_has_the_place_and_the_number_of_the_one_that_is_gone(opened):
    master, port, path = opened
    again = []
    ports = SerialPorts([port], lambda index: again.pop() if again else None)
    os.close(master)
    ports.wait_for_bytes(time.monotonic_ns() + 5_000_000_000)
    assert not ports.reopen(0)
    # nothing here has the device open any more, and nothing waits for it
    assert os.readlink(f"/proc/self/fd/{port.descriptor}") == os.devnull
    assert ports.wait_for_bytes(time.monotonic_ns() + 1_000_000) == ()
    master, slave = pty.openpty()
    again.append(slave)
    assert ports.reopen(0)
    (renewed,) = ports.ports
    assert (renewed.descriptor, renewed.name) == (port.descriptor, path)
    os.write(master, b"hello\n")
    assert ports.wait_for_bytes(time.monotonic_ns() + 5_000_000_000) == [0]
    buffer = memoryview(bytearray(10))
    assert bytes(buffer[: renewed.read_into(buffer)]) == b"hello\n"
    os.close(master)


def test_a_line_that_takes_nothing_is_a_port_error(opened):
    _, port, _ = opened
    while select.select([], [port.descriptor], [], 0)[1]:
        os.write(port.descriptor, bytes(1000))
    with pytest.raises(PortError, match="accepts no more bytes"):
        port.write_packet(bytes(100_000))


def test_a_missing_device_and_a_file_are_named(tmp_path):
    with pytest.raises(PortError, match=r"port /dev/ttyNOPE not found; (choose from /dev|plug in a serial)"):
        open_serial("/dev/ttyNOPE", 1_000_000)
    path = tmp_path / "file"
    with pytest.raises(PortError, match=f"not found; check the path, .*`dxlrun sim --link {path}`"):
        open_serial(str(path), 1_000_000)
    path.touch()
    with pytest.raises(PortError, match=r"port COM3 not found; that is a port of Windows; "):
        open_serial("COM3", 57_600)
    with pytest.raises(PortError, match="port sim not found; start simulated servos by `dxlrun sim "):
        open_serial("sim", 57_600)
    with pytest.raises(PortError, match=r"port null not found; write /dev/null") as refused:
        open_serial("null", 57_600)
    assert refused.value.__suppress_context__  # a script shows the sentence after one traceback
    with pytest.raises(PortError, match="is not a serial line"):
        open_serial(str(path), 1_000_000)


class Driver:
    """Answers ioctl of a line as a driver with one baud rate, and maybe RS-485, would."""

    def __init__(self, monkeypatch, baud_rate=0, *, rs485=True):
        self.rs485 = []
        real = fcntl.ioctl

        def ioctl(descriptor, request, argument=0):
            if request == 0x542F:  # TIOCSRS485
                if not rs485:
                    raise OSError(errno.ENOTTY, os.strerror(errno.ENOTTY))
                self.rs485.append(struct.unpack("8I", argument))
                return 0
            answer = real(descriptor, request, argument)
            if request == 0x802C542A and baud_rate:  # TCGETS2
                return answer[:-8] + struct.pack("2I", baud_rate, baud_rate)
            return answer

        monkeypatch.setattr(fcntl, "ioctl", ioctl)
        monkeypatch.setattr("dxlwire.port.serial_open.is_simulated", lambda path: False)


@pytest.mark.parametrize(
    ("real", "said"), [(1_020_000, ""), (980_000, ""), (3_000_000, "+200.0%"), (975_000, "-2.5%")]
)
def test_the_rate_that_the_driver_set_is_read_back(terminal, monkeypatch, real, said):
    _, path, _ = terminal
    Driver(monkeypatch, real)
    with open_serial(path, 1_000_000) as line:
        assert line.baud_rate == real
        remark = rate_remark(line, 1_000_000)
        assert line.set_rate(real)
    assert bool(remark) == bool(said)
    if said:
        assert f"{path} runs at {real} bit/s instead of 1000000 ({said})" in remark
    lines = KeptLines([LineSettings(path, 1_000_000, 0)])
    assert lines.remarks == ([remark] if remark else [])
    lines.close()


def test_a_rate_beyond_two_percent_is_left_out_by_tools(terminal, monkeypatch):
    _, path, _ = terminal
    Driver(monkeypatch, 3_000_000)
    with TunablePort(path) as port:
        assert not port.tune(4_000_000)
        assert port.tune(3_000_000)
        assert not port.tune(4_000_000)
        assert port.other_rates == {4_000_000: 3_000_000}


def test_rs485_is_switched_on_or_refused(terminal, monkeypatch):
    _, path, _ = terminal
    with open_serial(path, 1_000_000, rs485=True):
        pass  # a simulated line needs none
    driver = Driver(monkeypatch)
    with open_serial(path, 1_000_000):
        assert driver.rs485 == []
    with open_serial(path, 1_000_000, rs485=True):
        assert driver.rs485 == [(3, 0, 0, 0, 0, 0, 0, 0)]  # SER_RS485_ENABLED | SER_RS485_RTS_ON_SEND
    Driver(monkeypatch, rs485=False)
    with pytest.raises(PortError, match=rf"the driver of {path} has no RS-485 mode .*; omit"):
        open_serial(path, 1_000_000, rs485=True)
    with open_serial(path, 1_000_000):
        pass  # what was refused let go of it


def test_a_board_that_resets_when_it_is_opened_gets_time_once(terminal, monkeypatch):
    _, path, slave = terminal
    slept = []
    monkeypatch.setattr(time, "sleep", slept.append)
    settings = termios.tcgetattr(slave)
    settings[2] |= termios.HUPCL  # as a port that was plugged in
    termios.tcsetattr(slave, termios.TCSANOW, settings)
    for _ in range(3):
        with open_serial(path, 1_000_000, boot_ns=2_000_000_000):
            assert not termios.tcgetattr(slave)[2] & termios.HUPCL  # DTR stays set
    assert slept == [2.0]


@contextmanager
def holder(path, *more):
    """Run a process that has the line open."""
    code = (
        "import sys\nfrom dxlrun.channels import child_processes\n"
        "from dxlwire.port.serial_open import open_serial\n"
        "port = open_serial(sys.argv[1], 1_000_000)\n" + "".join(more) + "print('opened', flush=True)\n"
        "sys.stdin.read()\n"
    )
    command = [sys.executable, "-c", code, path]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "opened\n"
        yield process
        process.stdin.close()


def test_the_process_that_has_the_line_is_named(terminal):
    with holder(terminal[1]) as process, pytest.raises(PortError, match="is in use by") as error:
        open_serial(terminal[1], 1_000_000)
    assert f"(process {process.pid})" in str(error.value)


def test_the_run_that_has_the_line_is_named_and_how_to_end_it(terminal):
    """A guardian has the line and the plan's memory open."""
    _, path, slave = terminal
    plan = 'plan = child_processes.memory_file("dxlrun-plan", b\'{"robot":"pan_tilt","loop":{}}\')\n'
    with holder(path, plan):
        fcntl.ioctl(slave, termios.TIOCNXCL)  # root may open it all the same; the flock stays
        with pytest.raises(PortError) as refused:
            dxlrun.open_serial(path, 1_000_000)
    assert str(refused.value) == (
        f"{path} is in use by a run of pan_tilt; stop it by `dxlrun stop --robot pan_tilt`, or Ctrl-C in its "
        f"terminal; {help_link('the-port-is-in-use')}"
    )


def test_a_process_that_has_a_plan_open_is_known_by_its_robot():
    torso = Path(__file__).parents[2] / "robots" / "bioloid_torso.yaml"
    descriptor = memory_file("dxlrun-plan", to_json(compile_files(torso, {}, []).plan))
    try:  # a process of its own: this one may have others open
        with subprocess.Popen(["/bin/cat"], stdin=subprocess.PIPE, pass_fds=[descriptor]) as run:
            assert robot_of(Path(f"/proc/{run.pid}")) == "bioloid_torso"
    finally:
        os.close(descriptor)
    with subprocess.Popen(["/bin/cat"], stdin=subprocess.PIPE) as other:
        assert robot_of(Path(f"/proc/{other.pid}")) is None


def test_the_line_is_locked_against_every_program(opened):
    _, port, _ = opened
    assert _is_locked(port.descriptor)
    fcntl.ioctl(port.descriptor, termios.TIOCNXCL)


def test_the_lock_goes_with_whoever_has_the_line_although_its_other_end_stays(terminal):
    _, path, slave = terminal
    for _ in range(2):  # simulated servos wait for the next program
        with open_serial(path, 1_000_000):
            assert _is_locked(slave)
        assert not _is_locked(slave)
    handed_over = os.dup(slave)
    fcntl.ioctl(slave, termios.TIOCEXCL)  # by a process that was killed
    let_go([handed_over])
    assert not _is_locked(slave)


def _is_locked(descriptor: int) -> bool:
    return fcntl.ioctl(descriptor, 0x80045440, b"\0\0\0\0") == b"\1\0\0\0"  # TIOCGEXCL of asm-generic


BUSY = MachineLoad(10.0, busy_s=10.0, no_idle_core_s=10.0)
MS = 1_000_000


@pytest.fixture
def line(terminal):
    return terminal[1]


def timer_of(tmp_path, port, text):
    """Write the file in which the kernel would show the timer of a port's adapter."""
    place = tmp_path / "bus/usb-serial/devices" / os.path.basename(port) / "latency_timer"
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text(text)
    return place


@pytest.fixture
def timer(tmp_path, line):
    return timer_of(tmp_path, line, "16\n")


def shortened(line, most_ns, system):
    with open_serial(line, 1_000_000) as port:
        return shorten(port.fileno(), line, most_ns, system)


def test_a_timer_is_shortened_where_it_is_longer_than_the_robot_file_says(tmp_path, line, timer):
    assert shortened(line, 16 * MS, tmp_path) == ("", "")
    assert timer.read_text() == "16\n"
    lines = KeptLines([LineSettings(line, 1_000_000, MS)], tmp_path)
    lines.close()
    assert lines.done == [f"{line}: latency timer set from 16 ms to 1 ms"]
    assert timer.read_text() == "1"
    assert shortened(line, MS, tmp_path) == ("", "")


def test_an_adapter_without_a_timer_or_with_one_that_says_no_number_is_nobodys_fault(tmp_path, line):
    for unreadable in (None, "", "soon", "16 ms"):
        if unreadable is not None:
            timer_of(tmp_path, line, unreadable)
        assert latency_timer(line, tmp_path) is None
        assert shortened(line, 0, tmp_path) == ("", "")


def test_a_timer_that_this_user_may_not_set_is_one_sentence_with_the_command(
    tmp_path, line, timer, monkeypatch
):
    def forbidden(*_):
        raise PermissionError

    monkeypatch.setattr("pathlib.Path.write_text", forbidden)
    done, wrong = shortened(line, MS, tmp_path)
    assert done == ""
    assert f"{line} delays replies by 16 ms instead of the planned 1 ms; run `echo 1 | sudo tee " in wrong
    assert f"`echo 1 | sudo tee {timer}`" in wrong
    with pytest.raises(PortError, match="sudo tee"):
        KeptLines([LineSettings(line, 1_000_000, MS)], tmp_path)
    with open_serial(line, 1_000_000):
        pass  # a start that was refused let go of it


ROBOT = """\
name: pair
loop: {rate: 20}
buses:
  main:
    {port: sim, protocol: 1.0, baud_rate: 1_000_000, return_delay_time: 100 us,
    simulation: {latency_timer: 16 ms}}
joints:
  pan: {bus: main, id: 3, model: AX-12A, reference: 150 deg, direction: 1}
  tilt: {bus: main, id: 7, model: AX-12A, reference: 150 deg, direction: 1}
"""


def with_a_timer(tmp_path, latency_ms, port="sim"):
    """Return a robot whose simulated adapter keeps replies back for 16 ms, and a plan that expects less."""
    path = tmp_path / "pair.yaml"
    path.write_text(ROBOT)
    plan = plan_of(path, duration_s=0.2)
    robot = VirtualRobot(plan)
    (bus,) = robot.robot.hardware._lines.buses
    assert bus.plan is plan.buses[0]
    bus.plan = replace(bus.plan, latency_ns=latency_ms * MS, port=port)
    return robot


def test_replies_later_than_planned_are_reported_before_any_servo_has_torque(tmp_path):
    robot = with_a_timer(tmp_path, 1, "/dev/ttyUSB0")
    with pytest.raises(StartUpError) as refusal:
        robot.run()
    assert refusal.value.for_replies
    (sentence,) = refusal.value.sentences
    start = (
        r"the loop would miss most replies: (\d+) of \1 replies on bus main were delayed by up to 1[56] ms"
    )
    assert re.match(start, sentence), sentence
    assert sentence.endswith(" (planned for the adapter: 1 ms)"), "nothing shows the cause"
    torque_on = bytes.fromhex("0318")  # a write to Torque Enable (24)
    sent = [entry.data for entry in robot.ledger.entries if entry.direction == "in"]
    assert sent
    assert not any(torque_on in data for data in sent)


@pytest.mark.parametrize("latency_ms", [7, 16])
def test_a_timer_that_the_reads_can_wait_for_is_no_reason_not_to_start(tmp_path, latency_ms):
    robot = with_a_timer(tmp_path, latency_ms)
    robot.run()
    assert robot.record.states.valid.all()


LINK = "/dev/serial/by-id/usb-FTDI"


@pytest.mark.parametrize(
    ("port", "extra_ms", "load", "named"),
    [
        ("/dev/ttyUSB0", 15.9, MachineLoad(), "devices/ttyUSB0/latency_timer"),
        (LINK, 12.0, MachineLoad(), f"devices/$(basename $(readlink -f {LINK}))/"),
        ("/dev/ttyUSB0", 18.1, MachineLoad(), ""),
        ("/dev/ttyUSB0", 11.9, MachineLoad(), ""),
        ("sim", 16.0, MachineLoad(), ""),
        ("/dev/ttyUSB0", 15.9, BUSY, "end other programs"),  # a busy machine comes first
    ],
)
def test_only_what_looks_like_the_timer_is_called_one(port, extra_ms, load, named):
    sentence, remedy = late_replies("main", port, extra_ms * MS, MS, load)
    assert ("latency timer" in sentence) == ("timer" in remedy)
    assert named in remedy if named else not remedy


@pytest.mark.parametrize(
    ("port", "load", "remedy"),
    [
        ("/dev/ttyUSB0", MachineLoad(), CHECK),
        ("/dev/ttyUSB0", BUSY, "end other programs"),
        ("sim", MachineLoad(), INJECTED),
        ("sim", BUSY, "end other programs, or use --virtual"),
    ],
)
def test_remedy_is_for_the_machine_first_and_never_for_simulated_parts(port, load, remedy):
    assert choose_remedy(port, CHECK, load=load) == remedy


@pytest.mark.parametrize(("found", "named"), [("16\n", True), ("1\n", False), (None, False)])
def test_late_start_names_the_timer_that_the_kernel_shows(tmp_path, found, named):
    if found is not None:
        timer_of(tmp_path, "ttyUSB7", found)
    sentence = describe_late_start("main", "/dev/ttyUSB7", [15 * MS, MS, 14 * MS], MS, tmp_path)
    assert sentence.startswith(
        "2 of 3 replies on bus main were delayed by up to 15 ms (planned for the adapter: 1 ms)"
    )
    assert ("latency timer" in sentence) is named
    assert not named or "the adapter's latency timer is 16 ms: shorten it with `echo 1 | sudo tee" in sentence


ENDLESS_NS = 1 << 62  # nothing is due to the host
SENT = 1_000 * MS  # when the request is off the wire
DEADLINE = SENT + 12 * MS


@pytest.fixture
def memory() -> Iterator[int]:
    descriptor = create_progress(2)
    yield descriptor
    os.close(descriptor)


@pytest.fixture
def simulation(memory: int) -> LineProgress:
    """The simulation's side of a line."""
    return SimulationProgress(memory).line(1)


def publish(line: LineProgress, **words: int) -> None:
    """Publish when the simulation `received`, `served` and `delivered` bytes, and when those were `due`."""
    for name, at_ns in words.items():
        line.words[("received", "served", "delivered", "due").index(name)] = at_ns


@pytest.fixture
def stalls() -> StallCounter:
    return StallCounter()


@pytest.fixture
def port(memory: int, stalls: StallCounter) -> Iterator[SimulatedPort]:
    ours, theirs = os.pipe()
    yield SimulatedPort(ours, "sim", SimulationProgress(memory).line(1), stalls)
    os.close(ours)
    os.close(theirs)


def extended(port: SerialPort, now: int, heard: int = 0) -> int:
    return port.extend_deadline(DEADLINE, SENT, heard, now)


DELIVERED = {"due": SENT + MS, "delivered": SENT + 11 * MS}


@pytest.mark.parametrize(
    ("words", "heard", "awaited"),
    [
        ({"received": SENT - 1}, 0, True),  # the request was not taken
        ({"received": SENT + MS // 10}, 0, False),  # a servo that is silent
        # a latency timer of 16 ms: the process sleeps until the reply is due, behind the deadline
        ({"received": SENT, "served": SENT + 16 * MS}, 0, False),
        # the reply was due, and the process has not run since
        ({"received": SENT, "served": SENT + MS}, 0, True),
        # the kernel still has the bytes, or the host has read since
        ({"received": SENT, **DELIVERED}, SENT - MS, True),
        ({"received": SENT, **DELIVERED}, SENT + 11 * MS, False),
    ],
)
def test_reply_is_awaited_that_the_process_has_not_handed_over(port, simulation, words, heard, awaited):
    publish(simulation, **{"served": ENDLESS_NS} | words)
    assert (extended(port, DEADLINE, heard) > DEADLINE) is awaited
    assert (port._stalls.times > 0) is awaited


def test_deadline_counts_from_when_the_request_was_taken(port, simulation):
    publish(simulation, served=SENT + 100 * MS)
    publish(simulation, received=SENT + 100 * MS)
    assert extended(port, SENT + 101 * MS) > SENT + 101 * MS
    publish(simulation, served=ENDLESS_NS)  # nothing is due any more: the servo is silent on purpose
    assert extended(port, SENT + 102 * MS) <= SENT + 102 * MS


def test_each_simulated_bus_has_its_own_progress(memory, simulation, stalls):
    ours, theirs = os.pipe()
    buses: Any = [SimpleNamespace(port=SIMULATED)] * 2
    lines: Any = SimpleNamespace(simulation=memory)
    first, second = make_ports(buses, (ours, theirs), lines, stalls)
    publish(simulation, served=ENDLESS_NS)
    publish(simulation, received=SENT + MS // 10)
    assert extended(second, DEADLINE) <= DEADLINE < extended(first, DEADLINE)
    os.close(ours)
    os.close(theirs)


def test_wait_is_bounded_and_not_repeated_for_the_same_stall(port, simulation):
    assert extended(port, SENT + LONGEST_STALL_NS - MS // 2) == SENT + LONGEST_STALL_NS
    late = SENT + LONGEST_STALL_NS
    assert extended(port, late) <= late
    later, sent = late + 100 * MS, late + 80 * MS
    assert port.extend_deadline(sent + 12 * MS, sent, 0, later) <= later
    publish(simulation, received=late)  # the process runs again
    assert port.extend_deadline(sent + 12 * MS, sent, 0, later) > later


def test_waits_of_several_lines_count_once():
    stalls = StallCounter()
    for begin in (100, 101, 102):
        for _line in range(3):
            stalls.count(begin * MS, (begin + 1) * MS)
    stalls.count(200 * MS, 201 * MS)
    assert (stalls.times, stalls.waited_ns) == (2, 4 * MS)
    stalls.count(203 * MS, 204 * MS)  # the same wait goes on, after a wake-up that was late
    assert (stalls.times, stalls.waited_ns) == (2, 7 * MS)


def test_real_port_never_extends_a_deadline(port):
    real = SerialPort(port.descriptor, "/dev/ttyUSB0")
    assert extended(real, DEADLINE) == DEADLINE
    assert (real.late_ns(0, 9), real.stalled_ns(0, 9)) == (0, 0)


def test_late_reply_is_split_into_what_its_process_was_late(port, simulation):
    publish(simulation, received=SENT + 5 * MS)
    publish(simulation, due=SENT + 6 * MS, delivered=SENT + 9 * MS)
    assert port.late_ns(SENT, SENT + 10 * MS) == (5 + 4) * MS


def test_stalls_count_as_far_as_they_overlap(memory, port):
    progress = SimulationProgress(memory)
    for second in range(20):  # more than are kept
        progress.note_stall(second * 1_000 * MS, (second * 1_000 + 100) * MS)
    assert port.stalled_ns(18_050 * MS, 19_050 * MS) == (50 + 50) * MS
    assert port.stalled_ns(18_200 * MS, 18_900 * MS) == 0
    assert port.stalled_ns(0, 2_000 * MS) == 0  # forgotten


def test_port_of_a_line_that_is_back_keeps_its_progress(port, simulation):
    publish(simulation, received=SENT - 1)
    assert extended(port.renewed(), DEADLINE) > DEADLINE
