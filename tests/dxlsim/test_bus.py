"""The line and its adapter: when bytes are handed over, in what pieces, and what happens on the way."""

import ctypes
import signal
import weakref

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit.packets import packet1, packet2
from tests.kit.simulated_line import Line, split_statuses

from dxlsim.bus.ledger import Ledger
from dxlsim.bus.recording import BusRecording, RecordedPackets
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.simulation_plan import WHOLE_REPLIES, AdapterConfig, BusConfig, ServoConfig
from dxlsim.virtual_ports import VirtualPorts
from dxlsim.wire import compiled_line
from dxlsim.wire.compiled_line import ADVANCE
from dxlwire.clock import VirtualClock
from dxlwire.exceptions import PortError

PING_1 = bytes.fromhex("ff ff 01 02 01 fb")
PONG_1 = bytes.fromhex("ff ff 01 02 00 fc")
READ_1 = bytes.fromhex("ff ff 01 04 02 24 06 ce")
MS, BYTE, LATER = 1_000_000, 10_000, 10**12
"""ns; a byte at 1 Mbit/s"""
PONG_ENDS = 6 * BYTE + 500_000 + 6 * BYTE


def new_bus(
    adapter: AdapterConfig = WHOLE_REPLIES,
    *,
    ids: tuple[int, ...] = (1, 2),
    baud_rate: int = 1_000_000,
    delay_ns: int = 500_000,
) -> SimulatedBus:
    servos = tuple(ServoConfig(servo_id, "AX-12A", 2.0, delay_ns) for servo_id in ids)
    return SimulatedBus(BusConfig("main", baud_rate, servos, adapter=adapter), Ledger(), 0)


def handed_over(bus: SimulatedBus, until_ns: int = LATER) -> list[tuple[int, bytes]]:
    """Take whatever comes as soon as it comes."""
    parts = []
    while (due_ns := bus.next_due_ns()) is not None and due_ns <= until_ns:
        if data := bus.drain_bytes(due_ns):
            parts.append((due_ns, data))
    return parts


def notes(bus: SimulatedBus) -> str:
    return "\n".join(entry.note for entry in bus.ledger.entries if entry.direction == "note")


# The line


def test_a_burst_ends_with_the_adapter_that_sends_it():
    bus = new_bus(AdapterConfig(latency_timer_ns=MS, split="byte"))
    bus.receive_bytes(READ_1, 0)
    assert len(bus.drain_bytes(MS)) == 1
    bus.unplug()
    bus.plug_in()
    assert (bus.next_due_ns(), bus.drain_bytes(LATER)) == (None, b"")


@pytest.mark.parametrize(
    ("baud_rate", "due_ns"),
    [(1_000_000, 80_000 + 500_000 + 120_000), (57_600, 1_388_888 + 500_000 + 2_083_333)],
)
def test_a_reply_is_due_after_wire_time_and_return_delay_and_the_ledger_has_its_time(baud_rate, due_ns):
    bus = new_bus(baud_rate=baud_rate)
    bus.receive_bytes(READ_1, 1000)
    assert bus.next_due_ns() == 1000 + due_ns
    assert bus.drain_bytes(1000 + due_ns - 1) == b""
    reply = bus.drain_bytes(1000 + due_ns)
    assert len(reply) == 12
    assert bus.next_due_ns() is None
    assert bus.drain_bytes(LATER) == b""
    entries = [(entry.t_ns, entry.bus, entry.direction, entry.data) for entry in bus.ledger.entries]
    assert entries == [(1000, "main", "in", READ_1), (1000 + due_ns, "main", "out", reply)]


def test_an_instruction_waits_for_the_bytes_before_it():
    bus = new_bus()
    bus.receive_bytes(bytes(100), 0)  # 1 ms of noise
    bus.receive_bytes(PING_1, 10_000)
    assert bus.next_due_ns() == 1_000_000 + PONG_ENDS


@pytest.mark.parametrize(("split", "received"), [("whole", "ff ff"), ("byte", "ff ff")])
def test_who_talks_into_a_reply_loses_both(split, received):
    bus = new_bus(AdapterConfig(split=split))
    bus.receive_bytes(READ_1, 0)  # the reply passes from 580 to 700 us
    early = b"".join(data for _, data in handed_over(bus, 600_000))
    bus.receive_bytes(READ_1, 600_000)
    assert early + bus.drain_bytes(LATER) == bytes.fromhex(received)
    assert "the host sends during" in notes(bus)


@pytest.mark.parametrize("baud_rate", [1 << 31, (1 << 32) - 1])
def test_any_rate_of_a_terminal_is_one_at_which_a_host_talks_into_a_reply(baud_rate):
    bus = new_bus()
    bus.receive_bytes(READ_1, 0)
    bus.drain_bytes(600_000)
    bus.baud_rate = baud_rate
    bus.receive_bytes(READ_1, 600_000)
    assert bus.baud_rate == baud_rate
    assert bus.drain_bytes(LATER)[:2] == PONG_1[:2]


@pytest.mark.parametrize(
    ("baud_rate", "hears"), [(971_000, True), (1_030_000, True), (970_000, False), (1_031_000, False)]
)
def test_a_servo_hears_a_host_whose_rate_differs_by_less_than_three_percent(baud_rate, hears):
    bus = new_bus()
    bus.baud_rate = baud_rate
    bus.receive_bytes(READ_1, 0)
    assert (bus.drain_bytes(LATER) != b"") == hears


@pytest.mark.filterwarnings("ignore:Exception ignored on calling ctypes")
def test_an_interrupt_before_a_task_of_the_line_begins_is_not_lost():
    bus, library = new_bus(), ctypes.CDLL(None)
    bus._line.step, bus._line.mechanics = ctypes.cast(library["raise"], ctypes.c_void_p), signal.SIGINT
    with pytest.raises(KeyboardInterrupt):
        bus.receive_bytes(PING_1, 0)


@pytest.mark.parametrize("split", ["whole", "byte"])
def test_a_reply_that_is_due_is_delivered_after_an_exception_of_an_action(split):
    bus, other = new_bus(AdapterConfig(split=split)), new_bus()
    for one in (bus, other):
        one.receive_bytes(READ_1, 0)
    bus.at(1000, [].pop)
    with pytest.raises(IndexError):
        bus.drain_bytes(LATER)
    assert bus.drain_bytes(LATER) == other.drain_bytes(LATER) != b""


def test_the_exit_of_the_interpreter_frees_no_line_that_a_thread_may_still_serve(monkeypatch):
    made: list[weakref.finalize] = []

    def finalize(*given) -> weakref.finalize:
        made.append(weakref.finalize(*given))
        return made[-1]

    monkeypatch.setattr(compiled_line, "finalize", finalize)
    bus = new_bus()
    assert [each.atexit for each in made if each.alive] == [False, False]
    del bus


def test_a_host_that_sends_within_the_return_delay_is_received():
    bus = new_bus()
    bus.receive_bytes(READ_1, 0)
    bus.receive_bytes(PING_1, 100_000)  # over at 160 us; its reply begins at 660 us, into the first one
    received = bus.drain_bytes(LATER)
    assert len(received) == 14
    assert received[:8] == bytes.fromhex("ff ff 01 08 00 87 01 00")  # the begin of the first reply, alone
    assert " overlaps " in notes(bus)


def test_bytes_that_no_host_takes_do_not_pile_up():
    bus = new_bus(delay_ns=0)
    for index in range(1_000):
        bus.ledger.entries.clear()
        bus.receive_bytes(PING_1, index * 1_000_000)
    assert len(bus.drain_bytes(LATER)) <= 4096
    bus.receive_bytes(PING_1, LATER)
    assert bus.drain_bytes(2 * LATER) == PONG_1


def test_actions_happen_in_order_at_their_time_or_after_their_instruction():
    bus, happened = new_bus(), list[str]()
    bus.at(2 * MS, lambda: happened.append("second"))
    bus.at(1 * MS, lambda: happened.append("first"))
    assert bus.next_due_ns() == MS
    bus.drain_bytes(MS - 1)
    assert happened == []
    bus.drain_bytes(2 * MS)
    bus.after(2, lambda: happened.append("two"))
    bus.after(1, lambda: happened.append("one"))
    bus.after(0, lambda: happened.append("now"))
    bus.receive_bytes(packet1(0xFE, 3, 25, 1), 3 * MS)
    assert happened == ["first", "second", "now", "one"]
    bus.receive_bytes(PING_1, 4 * MS)
    assert happened[4:] == ["two"]


def test_a_cut_instruction_swallows_the_begin_of_the_next_one_unless_a_pause_ends_it():
    bus, counted = new_bus(), list[int]()
    bus.alter_next_instruction("cut", lambda packet: packet[:4])
    bus.after(1, lambda: counted.append(1))
    bus.receive_bytes(PING_1, 0)
    assert counted == [1]
    bus.receive_bytes(PING_1, 1 * MS)
    assert handed_over(bus, 10 * MS) == []
    bus.receive_bytes(PING_1, 300 * MS)
    assert [data for _, data in handed_over(bus)] == [PONG_1]


def test_each_servo_counts_instructions_and_replies():
    bus = new_bus()
    asked = (PING_1, packet1(0xFE, 3, 25, 1), packet1(1, 3, 25, 1), packet1(2, 3, 25, 9))
    spoiled = packet1(2, 2, 36, 2)[:-1] + b"\x00"
    for turn, data in enumerate((*asked, spoiled)):
        bus.receive_bytes(data, turn * 10 * MS)
        bus.drain_bytes((turn + 1) * 10 * MS)
    one, two = (bus.servo(servo_id).counts for servo_id in (1, 2))
    assert (one.received, one.replied, one.last_error) == (3, 2, 0)
    assert (two.received, two.replied, two.last_error) == (2, 1, 0x08)  # range


def test_a_servo_that_is_not_there_is_named():
    with pytest.raises(LookupError, match="bus main has no servo with ID 5"):
        new_bus().servo(5)


def chain_of_three(delay_ns: int) -> Line:
    """Return a line whose three servos were asked by a sync read."""
    line = Line("XM430-W350", 1, 2, 3, return_delay_ns=delay_ns)
    line.instruct(0xFE, 0x82, bytes.fromhex("84000400 010203"))
    return line


def test_a_servo_that_waits_for_its_turn_gives_up_when_it_receives_another_instruction():
    line = chain_of_three(500_000)
    line.bus.receive_bytes(packet2(9, 1), line.clock.now_ns() + 200_000)  # before the first one talks
    assert [each.servo_id for each in line.statuses()] == [1]


def test_the_host_that_talks_into_a_chain_ends_it():
    line = chain_of_three(100_000)  # 17 bytes; the first status from 270 to 420 us
    line.bus.receive_bytes(b"\x55", line.clock.now_ns() + 400_000)
    assert len(line.receive()) == 13
    assert "the servos after it in the chain do not reply" in "\n".join(line.notes)


def test_a_twin_with_another_id_leaves_the_chain_alone():
    line = Line("XM430-W350", 1, 2, 3)
    line.bus.add_servo(ServoConfig(2, "XM430-W350", 1.0)).poke("id", 9)
    line.instruct(0xFE, 0x82, bytes.fromhex("84000400 010203"))
    assert [each.servo_id for each in split_statuses(line.receive(), 2.0)] == [1, 2, 3]


# The adapter


@pytest.mark.parametrize("timer_ms", [1, 4, 16])
def test_the_latency_timer_keeps_each_short_reply_back(timer_ms):
    bus, now = new_bus(AdapterConfig(latency_timer_ns=timer_ms * MS)), 0
    for turn in range(1, 9):  # a host that requests at once waits a whole timer for each
        bus.receive_bytes(PING_1, now)
        ((now, data),) = handed_over(bus)
        assert (now, data) == (turn * timer_ms * MS, PONG_1)
    # the ledger has the times of the wire
    assert [entry.t_ns for entry in bus.ledger.entries[:2]] == [0, PONG_ENDS]


@pytest.mark.parametrize(
    ("timer_ms", "size", "at_ns", "handed"),
    [
        (16, 100, 0, [(62 * BYTE, 62), (62 * BYTE + 16 * MS, 38)]),  # a full packet does not wait
        (1, 20, MS - 5 * BYTE, [(MS, 5), (2 * MS, 15)]),  # the timer may run out within a reply
        (1, 20, 2 * MS + 50 * BYTE, [(3 * MS, 20)]),  # it runs out with an empty buffer, too
    ],
)
def test_a_packet_is_handed_over_when_it_is_full_or_the_timer_runs_out(timer_ms, size, at_ns, handed):
    bus = new_bus(AdapterConfig(latency_timer_ns=timer_ms * MS))
    bus.inject_noise(bytes(range(size)), at_ns)
    found = handed_over(bus)
    assert [(due_ns, len(data)) for due_ns, data in found] == handed
    assert b"".join(data for _, data in found) == bytes(range(size))


def test_bytes_one_by_one_come_as_they_pass_the_wire_or_with_the_timer():
    for timer_ns, first in ((0, PONG_ENDS - 5 * BYTE), (4 * MS, 4 * MS)):
        bus = new_bus(AdapterConfig(latency_timer_ns=timer_ns, split="byte"))
        bus.receive_bytes(PING_1, 0)
        parts = handed_over(bus)
        assert [data for _, data in parts] == [PONG_1[index : index + 1] for index in range(6)]
        assert parts[0][0] == first
        assert timer_ns or [at for at, _ in parts] == [first + index * BYTE for index in range(6)]


def test_random_pieces_are_drawn_from_the_seed():
    def pieces(seed: int) -> list[int]:
        bus = new_bus(AdapterConfig(split="random", seed=seed))
        for turn in range(20):
            bus.receive_bytes(READ_1, turn * MS * 2)
            bus.advance_to(turn * MS * 2 + MS)
        return [len(data) for _, data in handed_over(bus)]

    assert pieces(1) == pieces(1)
    assert pieces(1) != pieces(2)
    assert len(set(pieces(1))) > 4


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from((0, MS, 3 * MS, 16 * MS)),
    st.sampled_from(("whole", "byte", "random")),
    st.lists(st.tuples(st.binary(min_size=1, max_size=90), st.integers(0, 3 * MS)), min_size=1, max_size=8),
    st.integers(50_000, 2 * MS),
)
def test_every_byte_comes_once_in_order_and_not_before_it_passed(timer_ns, split, noises, look_ns):
    bus = new_bus(AdapterConfig(timer_ns, split))
    now, arrivals = 0, []
    for data, pause_ns in noises:
        now += pause_ns
        bus.inject_noise(data, now)
        arrivals += [(now + (index + 1) * BYTE, byte) for index, byte in enumerate(data)]
        now += len(data) * BYTE
    received = bytearray()
    for t_ns in range(0, now + 17 * MS, look_ns):
        part = bus.drain_bytes(t_ns)
        for index in range(len(received), len(received) + len(part)):
            assert arrivals[index][0] <= t_ns
        received += part
    received += bus.drain_bytes(now + 1000 * MS)
    assert bytes(received) == bytes(byte for _, byte in arrivals)
    assert bus.next_due_ns() is None
    assert b"".join(each.data for each in bus.ledger.entries if each.direction == "out") == bytes(received)


def test_an_adapter_that_echoes_gives_the_host_its_own_bytes_first():
    bus = new_bus(AdapterConfig(echo=True))
    bus.receive_bytes(PING_1, 0)
    assert handed_over(bus) == [(6 * BYTE, PING_1), (PONG_ENDS, PONG_1)]


def test_an_unplugged_adapter_loses_what_was_on_its_way():
    bus = new_bus()
    bus.receive_bytes(PING_1, 0)
    bus.at(300_000, bus.unplug)
    assert handed_over(bus) == []
    assert not bus.plugged
    bus.plug_in()
    bus.receive_bytes(PING_1, 10 * MS)
    assert [data for _, data in handed_over(bus)] == [PONG_1]
    assert [note for note in notes(bus).split("\n") if "adapter" in note] == [
        "adapter unplugged",
        "adapter plugged in",
    ]


# Its ports on virtual time


class TwoPorts:
    """Ports of two buses with one servo each; the second one answers sooner."""

    def __init__(self) -> None:
        self.clock = VirtualClock(1_000)
        configs = [
            BusConfig(name, 1_000_000, (ServoConfig(1, "AX-12A", 1.0, delay),))
            for name, delay in (("left", 500_000), ("right", 100_000))
        ]
        self.buses = [SimulatedBus(config, Ledger(), 1_000) for config in configs]
        self.ports = VirtualPorts(self.clock, self.buses)

    def read(self, index: int, size: int = 100) -> bytes:
        buffer = bytearray(size)
        return bytes(buffer[: self.ports.ports[index].read_into(memoryview(buffer))])

    def ping(self, index: int) -> None:
        self.ports.ports[index].write_packet(PING_1)


def test_waiting_ends_at_the_first_reply_and_names_its_line():
    two = TwoPorts()
    for index in (0, 1):
        two.ping(index)
    for index, at_ns in ((1, 221_000), (0, 621_000)):
        assert two.ports.wait_for_bytes(10**9) == [index]
        assert two.clock.now_ns() == at_ns
        assert two.read(index) == PONG_1


def test_waiting_ends_at_the_deadline():
    two = TwoPorts()
    assert two.ports.wait_for_bytes(5_000) == []
    assert two.ports.wait_for_bytes(100) == []  # the past: only a look
    assert two.clock.now_ns() == 5_000
    two.buses[0].at(MS, lambda: two.buses[0].inject_noise(b"\x55", MS))
    assert two.ports.wait_for_bytes(2 * MS) == [0]  # planned while somebody waits
    assert two.read(0) == b"\x55"


@pytest.mark.filterwarnings("ignore:Exception ignored on calling ctypes")
def test_an_interrupt_before_a_scheduled_call_is_not_lost():
    two, ends = TwoPorts(), iter((KeyboardInterrupt,))

    @ADVANCE
    def interrupted(until_ns: int) -> int:
        for end in ends:
            raise end
        return two.clock.wait_until(until_ns)

    two.clock.call_at(1_000, lambda: None)
    two.ports._state.advance = ctypes.cast(interrupted, ctypes.c_void_p)
    with pytest.raises(KeyboardInterrupt):
        two.ports.wait_for_bytes(5_000)


def test_bytes_that_do_not_fit_stay_for_the_next_read():
    two = TwoPorts()
    two.ping(0)
    two.ports.wait_for_bytes(10**9)
    first = two.read(0, 4)
    assert two.ports.wait_for_bytes(10**9) == [0]
    assert (first, first + two.read(0), two.read(0)) == (PONG_1[:4], PONG_1, b"")


def test_a_lost_line_is_an_error_until_it_is_opened_again_and_delays_no_other():
    two = TwoPorts()
    ports, (bus, _) = two.ports, two.buses
    bus.unplug()
    assert ports.wait_for_bytes(5_000) == [0]
    with pytest.raises(PortError, match="adapter of bus left is unplugged"):
        two.ping(0)
    with pytest.raises(PortError):
        two.read(0)
    two.ping(1)
    assert ports.wait_for_bytes(10**9) == [0]
    assert not ports.reopen(0)
    assert ports.wait_for_bytes(10**9) == [1]
    assert two.read(1) == PONG_1
    bus.at(2 * MS, bus.plug_in)  # time passes on a lost line
    assert ports.wait_for_bytes(3 * MS) == []
    assert (bus.plugged, two.clock.now_ns()) == (True, 3 * MS)
    with pytest.raises(PortError):  # a port does not outlive its adapter
        two.ping(0)
    assert ports.reopen(0)
    two.ping(0)
    assert ports.wait_for_bytes(10**9) == [0]
    assert two.read(0) == PONG_1


def test_after_the_end_of_a_recording_its_last_answer_comes_again():
    asked, at_ns = np.array([True, False, True, False]), np.arange(4) * MS
    packets = RecordedPackets(asked, at_ns, at_ns, np.arange(4), np.ones(4, np.int64), b"?a?b")
    recording = BusRecording(packets, 1_000_000)
    answers = [recording.replay_answer(b"?") for _ in range(4)]
    assert [one.data for answer in answers for one in answer] == [b"a", b"b", b"b", b"b"]
