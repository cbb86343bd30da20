"""The adapter between line and host: when bytes are handed over, in what pieces, what faults do to it."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit.line_faults import corrupt_next, truncate_next
from tests.kit.packets import packet1, packet2

from dxlsim.bus.ledger import Ledger
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.simulation_plan import AdapterConfig, BusConfig, ServoConfig
from dxlsim.virtual_ports import VirtualPorts
from dxlwire.clock import VirtualClock
from dxlwire.exceptions import PortError

PING_1 = bytes.fromhex("ff ff 01 02 01 fb")
PONG_1 = bytes.fromhex("ff ff 01 02 00 fc")
READ_1 = bytes.fromhex("ff ff 01 04 02 24 06 ce")
MS = 1_000_000
BYTE = 10_000
"""ns, at 1 Mbit/s"""
PONG_ENDS = 6 * BYTE + 500_000 + 6 * BYTE


def new_bus(adapter: AdapterConfig, ids: tuple[int, ...] = (1, 2)) -> SimulatedBus:
    servos = tuple(ServoConfig(servo_id, "AX-12A", 2.0) for servo_id in ids)
    return SimulatedBus(BusConfig("main", 1_000_000, servos, adapter=adapter), Ledger(), 0)


def handed_over(bus: SimulatedBus, until_ns: int = 10**12) -> list[tuple[int, bytes]]:
    """Take whatever comes as soon as it comes."""
    parts = []
    while (due_ns := bus.next_due_ns()) is not None and due_ns <= until_ns:
        if data := bus.drain_bytes(due_ns):
            parts.append((due_ns, data))
    return parts


def notes(bus: SimulatedBus) -> list[str]:
    return [entry.note for entry in bus.ledger.entries if entry.direction == "note"]


@pytest.mark.parametrize("timer_ms", [1, 4, 16])
def test_the_latency_timer_keeps_a_short_reply_back(timer_ms):
    bus = new_bus(AdapterConfig(latency_timer_ns=timer_ms * MS))
    bus.receive_bytes(PING_1, 0)
    assert handed_over(bus) == [(timer_ms * MS, PONG_1)]
    assert [entry.t_ns for entry in bus.ledger.entries] == [
        0,
        PONG_ENDS,
    ]  # the ledger has the times of the wire


def test_a_host_that_requests_at_once_waits_a_whole_timer_for_each_reply():
    bus = new_bus(AdapterConfig(latency_timer_ns=16 * MS))
    now = 0
    for turn in range(1, 9):
        bus.receive_bytes(PING_1, now)
        ((now, data),) = handed_over(bus)
        assert (now, data) == (turn * 16 * MS, PONG_1)


def test_a_full_packet_does_not_wait_for_the_timer():
    bus = new_bus(AdapterConfig(latency_timer_ns=16 * MS))
    noise = bytes(range(100))
    bus.inject_noise(noise, 0)
    assert handed_over(bus) == [(62 * BYTE, noise[:62]), (62 * BYTE + 16 * MS, noise[62:])]


def test_the_timer_may_run_out_in_the_middle_of_a_reply():
    bus = new_bus(AdapterConfig(latency_timer_ns=MS))
    bus.inject_noise(bytes(range(20)), MS - 5 * BYTE)
    assert handed_over(bus) == [(MS, bytes(range(5))), (2 * MS, bytes(range(5, 20)))]


def test_bytes_one_by_one_come_as_they_pass_the_wire():
    bus = new_bus(AdapterConfig(split="byte"))
    bus.receive_bytes(PING_1, 0)
    first = PONG_ENDS - 5 * BYTE
    assert handed_over(bus) == [(first + index * BYTE, PONG_1[index : index + 1]) for index in range(6)]


def test_a_burst_of_the_timer_can_be_split_too():
    bus = new_bus(AdapterConfig(latency_timer_ns=4 * MS, split="byte"))
    bus.receive_bytes(PING_1, 0)
    parts = handed_over(bus)
    assert [data for _, data in parts] == [PONG_1[index : index + 1] for index in range(6)]
    assert parts[0][0] == 4 * MS


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


def test_a_collision_in_a_reply_that_is_half_handed_over_takes_only_the_rest():
    bus = new_bus(AdapterConfig(split="byte"))
    bus.receive_bytes(READ_1, 0)  # the reply passes from 580 to 700 us
    whole = b"".join(data for _, data in handed_over(bus, 610_000))
    assert len(whole) == 3
    bus.receive_bytes(bytes(1), 612_000)  # into its fourth byte
    assert b"".join(data for _, data in handed_over(bus)) == b""
    assert any("the host sends during" in note for note in notes(bus))


def test_an_unplugged_adapter_loses_what_was_on_its_way():
    bus = new_bus(AdapterConfig())
    bus.receive_bytes(PING_1, 0)
    bus.at(300_000, bus.unplug)
    assert handed_over(bus) == []
    assert not bus.plugged
    bus.plug_in()
    bus.receive_bytes(PING_1, 10 * MS)
    assert [data for _, data in handed_over(bus)] == [PONG_1]
    assert [note for note in notes(bus) if note.startswith("adapter")] == [
        "adapter unplugged",
        "adapter plugged in",
    ]


def test_a_port_does_not_outlive_its_adapter_though_it_comes_back():
    clock = VirtualClock()
    bus = new_bus(AdapterConfig())
    port = VirtualPorts(clock, [bus]).ports[0]
    bus.unplug()
    bus.plug_in()
    with pytest.raises(PortError, match="adapter of bus main is unplugged"):
        port.write_packet(PING_1)
    again = VirtualPorts(clock, [bus])
    again.ports[0].write_packet(PING_1)
    assert again.wait_for_bytes(10**9) == [0]


# Hooks for faults


def test_a_cut_instruction_swallows_the_begin_of_the_next_one_unless_a_pause_ends_it():
    bus = new_bus(AdapterConfig())
    bus.alter_next_instruction("cut", lambda packet: packet[:4])
    counted: list[int] = []
    bus.after(1, lambda: counted.append(1))
    bus.receive_bytes(PING_1, 0)
    assert counted == [1]
    bus.receive_bytes(PING_1, 1 * MS)
    assert handed_over(bus, 10 * MS) == []
    bus.receive_bytes(PING_1, 300 * MS)
    assert [data for _, data in handed_over(bus)] == [PONG_1]


def test_something_can_be_planned_after_so_many_instructions():
    bus = new_bus(AdapterConfig())
    happened: list[str] = []
    bus.after(2, lambda: happened.append("two"))
    bus.after(1, lambda: happened.append("one"))
    bus.after(0, lambda: happened.append("now"))
    assert happened == ["now"]
    bus.receive_bytes(packet1(0xFE, 3, 25, 1), 0)
    assert happened == ["now", "one"]
    bus.receive_bytes(PING_1, MS)
    assert happened == ["now", "one", "two"]


def test_each_servo_counts_instructions_and_replies():
    bus = new_bus(AdapterConfig())
    asked = (PING_1, packet1(0xFE, 3, 25, 1), packet1(1, 3, 25, 1), packet1(2, 3, 25, 9))
    spoiled = packet1(2, 2, 36, 2)[:-1] + b"\x00"
    for turn, data in enumerate((*asked, spoiled)):
        bus.receive_bytes(data, turn * 10 * MS)
        bus.drain_bytes((turn + 1) * 10 * MS)
    one, two = (bus.servo(servo_id).counts for servo_id in (1, 2))
    assert (one.received, one.replied, one.last_error) == (3, 2, 0)
    assert (two.received, two.replied) == (2, 1)
    assert two.last_error == 0x08  # range (e-Manual, Protocol 1.0, Error)


# Group reads


def sync_read(line: Any) -> None:
    line.instruct(0xFE, 0x82, bytes.fromhex("84000400 010203"))


def test_a_servo_that_waits_for_its_turn_gives_up_when_it_receives_another_instruction(make_line2):
    line = make_line2((1, 2, 3), return_delay_ns=500_000)
    sync_read(line)
    line.bus.receive_bytes(packet2(9, 1), line.clock.now_ns() + 200_000)  # before the first one talks
    assert [each.servo_id for each in line.statuses()] == [1]


@pytest.mark.parametrize(("absent", "ids"), [("silent", []), ("slot", [3])])
def test_who_cannot_make_out_the_one_before_it_takes_it_for_absent(make_line2, absent, ids):
    line = make_line2((1, 2, 3), return_delay_ns=100_000)
    line.bus.absent = absent
    corrupt_next(line.bus, 1, index=10)
    truncate_next(line.bus, 2, 0)
    sync_read(line)
    received = line.receive()
    assert received[15:][4:5] == bytes(ids)


def test_the_host_that_talks_into_a_chain_ends_it(make_line2):
    line = make_line2((1, 2, 3), return_delay_ns=100_000)
    sync_read(line)  # 17 bytes; the first status from 270 to 420 us
    start = line.clock.now_ns()
    line.bus.receive_bytes(b"\x55", start + 400_000)
    received = line.receive()
    assert len(received) == 13
    assert any("the servos after it in the chain do not reply" in note for note in line.notes())


def test_two_servos_with_one_id_garble_their_turn_and_break_the_chain(make_line2):
    line = make_line2((1, 2, 3), return_delay_ns=100_000)
    twin = line.bus.add_servo(ServoConfig(2, "XM430-W350", 1.0, 100_000))
    sync_read(line)
    received = line.receive()
    assert received[:5] == bytes.fromhex("fffffd00 01")
    assert len(received) == 2 * 15
    twin.poke("id", 9)  # on the line of its own from now on
    sync_read(line)
    assert [each.servo_id for each in line.statuses()] == [1, 2, 3]
