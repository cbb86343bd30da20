"""The maker's packet handlers on a tool's port: their mistakes are corrected, and only tools load them."""

import subprocess
import sys
from types import SimpleNamespace

import pytest
import serial
from dynamixel_sdk import COMM_SUCCESS, Protocol2PacketHandler
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from tests.kit.awaited import until
from tests.kit.line_faults import delay_next
from tests.kit.rigs import VirtualLine

from dxlrun.dynamixel.tools.one_servo import OneServo
from dxlrun.dynamixel.tools.scanning import Search, find_servo, scan
from dxlrun.dynamixel.tools.tool_line import ToolLine
from dxlrun.dynamixel.tools.tool_port import TunablePort
from dxlrun.errors import PortError
from dxlsim.simulation_plan import BusConfig, ServoConfig
from dxlwire.bus import adjustable_port
from dxlwire.bus.sdk_port import StuffedPackets
from dxlwire.control_table import find_table
from dxlwire.packets import PacketKind
from dxlwire.wire import protocol2

LOADED = "import sys; import {}; print(sorted({{'serial', 'dynamixel_sdk'}} & set(sys.modules)))"


class Wire:
    """A port for the packet handlers: keeps what is sent, and has one reply."""

    def __init__(self, reply=b""):
        self.is_using, self.sent, self._reply = False, b"", reply
        self.clearPort = self.setPacketTimeout = lambda *_: None

    def writePort(self, packet):
        self.sent = bytes(packet)
        return len(packet)

    def isPacketTimeout(self):
        return not self._reply

    def readPort(self, length):
        data, self._reply = self._reply[:length], self._reply[length:]
        return data


def exchanged(handler, data):
    """Return the bytes of a write of data, and what a read of a servo that has these data gives."""
    out, back = Wire(), Wire(protocol2.status_packet(1, 0, data))
    handler.writeTxOnly(out, 1, 100, len(data), data)
    found, result, _ = handler.readTxRx(back, 1, 100, len(data))
    assert result == COMM_SUCCESS
    return out.sent, bytes(found)


@given(st.lists(st.sampled_from([0xFF, 0xFD, 0x00]), min_size=1, max_size=24).map(bytes))
def test_parameters_that_look_like_a_header_are_stuffed(data):
    assert exchanged(StuffedPackets(), data) == (protocol2.write_range(1, 100, data), data)


@pytest.mark.parametrize("data", ["ff ff fd ff", "ff ff fd 01 ff fd fd 01"])
def test_sdk_alone_sends_or_reads_something_else(data):
    """As soon as this fails, `StuffedPackets` can go."""
    data = bytes.fromhex(data)
    assert exchanged(Protocol2PacketHandler(), data) != (protocol2.write_range(1, 100, data), data)


def test_register_whose_bytes_are_a_header_is_written_and_read():
    line = VirtualLine(ServoConfig(1, "XM430-W350", 2.0))
    (found,) = find_servo(tool := ToolLine(line), 1, Search((2.0,), (57_600,)))
    one = OneServo(tool, found)
    one.write_registers([one.register("homing_offset", -131_073)])
    assert any(data[10:-2] == b"\xff\xff\xfd\xfd\xff" for data in line.heard)
    assert one.read_items(["homing_offset"]) == {"homing_offset": -131_073}
    assert line.bus.servo(1).registers["homing_offset"] == -131_073 & 0xFFFF_FFFF


def test_late_reply_counts_neither_for_another_register_nor_after_a_write_and_is_logged():
    line = VirtualLine(ServoConfig(1, "XM430-W350", 2.0), rate=1_000_000)
    log: list[tuple[int, bytes]] = []
    sink = SimpleNamespace(
        packet=lambda bus, kind, servo_id, first, last, data: log.append((kind, bytes(data)))
    )
    (tool := ToolLine(line, sink)).speak(2.0, 1_000_000)
    items = find_table("XM430-W350").items
    led, limit = (tool.line.read_range(1, items[name].address, 1) for name in ("led", "temperature_limit"))
    turn_on, wrong = (tool.line.write_range(1, items["led"].address, bytes((value,))) for value in (1, 7))
    lost, on, hot = ("TIMEOUT", b""), ("OK", b"\1"), ("OK", b"\x50")

    def answered(*requests, delays_ms):
        for delay_ms in delays_ms:
            delay_next(line.bus, 1, round(delay_ms * 1e6))
        first = replace(requests[0], timeout_ns=60_000_000)
        replies = [tool.heard.exchange(request) for request in (first, *requests[1:])]
        return [(reply.outcome.name, bytes(reply.parameters)) for reply in replies]

    # A request that may not wait, a read after a write, and a late refusal, which fits every length.
    assert answered(led, replace(limit, patience_ns=0), delays_ms=(60.5, 5)) == [lost, hot]
    assert answered(led, turn_on, led, delays_ms=(61.5, 0, 5)) == [lost, ("OK", b""), on]
    assert answered(wrong, limit, delays_ms=(60.5, 5)) == [lost, hot]
    assert [kind for kind, _ in log].count(PacketKind.LATE) == 3
    sent = [entry.data for entry in line.ledger.entries if entry.direction == "out"]
    assert b"".join(data for kind, data in log if kind != PacketKind.INSTRUCTION) == b"".join(sent)


def test_reply_to_an_interrupted_request_does_not_count_for_the_next(monkeypatch):
    line = VirtualLine(ServoConfig(1, "XM430-W350", 2.0), rate=1_000_000)
    (tool := ToolLine(line)).speak(2.0, 1_000_000)
    led, limit = (tool.line.read_range(1, address, 1) for address in (65, 31))
    for delay_ms in (60, 70):
        delay_next(line.bus, 1, delay_ms * 1_000_000)

    def interrupt(until_ns):
        if line.heard:
            raise KeyboardInterrupt
        return b""

    with monkeypatch.context() as patch:
        patch.setattr(line, "receive_bytes", interrupt)
        with pytest.raises(KeyboardInterrupt):
            tool.heard.exchange(led)
    assert bytes(tool.heard.exchange(replace(limit, timeout_ns=100_000_000)).parameters) == b"\x50"


@pytest.mark.parametrize(
    "module", ["dxlrun.run.loop_process", "dxlrun.run.guardian", "dxlrun.cli.tools.servo"]
)
def test_neither_loop_nor_help_loads_the_sdk(module):
    said = subprocess.run(
        [sys.executable, "-c", LOADED.format(module)], capture_output=True, text=True, check=True
    )
    assert said.stdout == "[]\n"


@pytest.fixture
def macos(monkeypatch):
    """Open ports by pyserial."""
    monkeypatch.setattr(sys, "platform", "darwin")


def test_port_that_pyserial_opens_finds_servos(simulated_line, macos):
    servos = (ServoConfig(3, "XM430-W350", 2.0), ServoConfig(7, "XL430-W250", 1.0))
    path, finish = simulated_line(BusConfig("main", 57_600, servos, 2.0))
    with TunablePort(path) as port:
        tool, search = ToolLine(port), Search((2.0,), (1_000_000, 57_600), tuple(range(1, 9)))
        # the process of the servos may get no processor for longer than a scan waits
        found = until(lambda: len(servos := scan(tool, search).servos) == 2 and servos)
    assert [(one.servo_id, one.model, one.remarks) for one in found] == [
        (3, "XM430-W350", ()),
        (7, "XL430-W250", ()),
    ]
    assert {entry.data[7] for entry in finish() if entry.direction == "in"} == {1, 2}


def test_bytes_that_arrive_while_this_process_has_no_processor_are_read(macos, monkeypatch):
    reads: list[bytes] = []

    def read(_):
        reads.append(b"late" * len(reads))
        return reads[-1]

    port = SimpleNamespace(read=read, close=None)
    monkeypatch.setattr(serial, "serial_for_url", lambda *_, **__: port)
    monkeypatch.setattr(adjustable_port.time, "monotonic_ns", lambda: 50 * len(reads))
    assert adjustable_port.PyserialLine("COM3", 57_600).receive_bytes(10) == b"late"


def test_pyserial_names_what_is_wrong_with_a_port(simulated_line, macos, monkeypatch):
    ports = SimpleNamespace(comports=lambda: [SimpleNamespace(device="/dev/cu.usbserial")])
    monkeypatch.setitem(sys.modules, "serial.tools.list_ports", ports)
    with pytest.raises(PortError, match=r"port /dev/none not found; choose from /dev/cu\.usbserial"):
        TunablePort("/dev/none")
    path, finish = simulated_line(BusConfig("main", 57_600, (), 2.0))
    with pytest.raises(PortError, match="rs485: true}` needs Linux, and this is darwin"):
        TunablePort(path, rs485=True)
    with TunablePort(path) as port:
        with pytest.raises(PortError, match=f"{path} is in use by"):
            TunablePort(path)
        finish()
        with pytest.raises(PortError, match=f"{path} is gone"):
            port.receive_bytes(port.clock.now_ns() + 1_000_000_000)
