import errno
import fcntl
import os
import pty
import select
import struct
import subprocess
import sys
import termios
import time
import tty
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

import dxlrun
from dxlrun.channels.child_processes import memory_file
from dxlrun.compile.robot_compiler import compile_files
from dxlrun.dynamixel.tools.tool_port import TunablePort
from dxlrun.errors import PortError, help_link
from dxlrun.plan.robot_plan import to_json
from dxlrun.process_table import robot_of
from dxlwire.port.ports import SerialPort, SerialPorts
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
    path.touch()
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
