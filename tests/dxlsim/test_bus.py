from __future__ import annotations

import pytest
from tests.kit.line_faults import turn_by_hand
from tests.kit.packets import packet1

from dxlsim.bus.ledger import Ledger
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.simulation_plan import BusConfig, ServoConfig

PING_1 = bytes.fromhex("ff ff 01 02 01 fb")
PONG_1 = bytes.fromhex("ff ff 01 02 00 fc")
READ_1 = bytes.fromhex("ff ff 01 04 02 24 06 ce")


def new_bus(
    ids: tuple[int, ...] = (1, 2), baud_rate: int = 1_000_000, delay_ns: int = 500_000
) -> SimulatedBus:
    servos = tuple(ServoConfig(servo_id, "AX-12A", 2.0, delay_ns) for servo_id in ids)
    return SimulatedBus(BusConfig("main", baud_rate, servos), Ledger(), 0)


@pytest.mark.parametrize(
    ("baud_rate", "due_ns"),
    [
        (1_000_000, 80_000 + 500_000 + 120_000),
        (57_600, 1_388_888 + 500_000 + 2_083_333),
    ],
)
def test_a_reply_is_due_after_wire_time_and_return_delay(baud_rate, due_ns):
    bus = new_bus(baud_rate=baud_rate)
    bus.receive_bytes(READ_1, 1000)
    assert bus.next_due_ns() == 1000 + due_ns
    assert bus.drain_bytes(1000 + due_ns - 1) == b""
    assert len(bus.drain_bytes(1000 + due_ns)) == 12
    assert bus.next_due_ns() is None
    assert bus.drain_bytes(10**12) == b""


def test_an_instruction_waits_for_the_bytes_before_it():
    bus = new_bus()
    bus.receive_bytes(bytes(100), 0)  # 1 ms of noise
    bus.receive_bytes(PING_1, 10_000)
    assert bus.next_due_ns() == 1_000_000 + 60_000 + 500_000 + 60_000


def test_what_is_read_is_the_state_when_the_instruction_arrived():
    bus = new_bus(delay_ns=0)
    bus.receive_bytes(packet1(1, 3, 30, 255, 3), 0)  # goal 1023
    bus.drain_bytes(1_000_000)
    bus.receive_bytes(READ_1, 200_000_000)
    reply = bus.drain_bytes(10**12)
    bus.receive_bytes(READ_1, 400_000_000)
    later = bus.drain_bytes(10**12)
    assert int.from_bytes(reply[5:7], "little") < int.from_bytes(later[5:7], "little")


def test_two_instructions_in_one_write_are_both_obeyed():
    bus = new_bus()
    bus.receive_bytes(packet1(0xFE, 3, 25, 1) + PING_1, 0)
    assert bus.drain_bytes(10**12) == PONG_1
    assert bus.servo(2).registers["led"] == 1


def test_who_talks_into_a_reply_loses_both():
    bus = new_bus()
    bus.receive_bytes(READ_1, 0)  # the reply passes from 580 to 700 us
    bus.receive_bytes(READ_1, 600_000)
    assert bus.drain_bytes(10**12) == bytes.fromhex("ff ff")  # 20 us of it
    assert any("the host sends during" in entry.note for entry in bus.ledger.entries)


def test_a_host_that_sends_within_the_return_delay_is_received():
    bus = new_bus(delay_ns=500_000)
    bus.receive_bytes(READ_1, 0)
    bus.receive_bytes(PING_1, 100_000)  # over at 160 us; its reply begins at 660 us, into the first one
    received = bus.drain_bytes(10**12)
    assert len(received) == 14
    assert received[:8] == bytes.fromhex("ff ff 01 08 00 87 01 00")  # the begin of the first reply, alone
    assert any(" overlaps " in entry.note for entry in bus.ledger.entries)


def test_two_servos_with_one_id_garble_what_differs():
    bus = new_bus(ids=(1, 1))
    turn_by_hand(bus.servos[1], 3.0)
    bus.receive_bytes(PING_1, 0)
    assert bus.drain_bytes(10**9) == PONG_1  # equal bytes, in step: nothing to be seen
    bus.receive_bytes(READ_1, 10**9)
    reply = bus.drain_bytes(10**12)
    assert sum(reply[2:]) & 0xFF != 0xFF


def test_noise_toward_the_host_takes_wire_time():
    bus = new_bus()
    bus.inject_noise(b"\x12\x34", 5_000)
    assert bus.drain_bytes(24_999) == b""
    assert bus.drain_bytes(25_000) == b"\x12\x34"


def test_planned_faults_happen_in_order_when_their_time_comes():
    bus = new_bus()
    happened: list[str] = []
    bus.at(2_000_000, lambda: happened.append("second"))
    bus.at(1_000_000, lambda: happened.append("first"))
    assert bus.next_due_ns() == 1_000_000
    bus.drain_bytes(999_999)
    assert happened == []
    bus.receive_bytes(PING_1, 2_000_000)
    assert happened == ["first", "second"]


def test_a_servo_that_is_not_there_is_named():
    with pytest.raises(LookupError, match="bus main has no servo with ID 5"):
        new_bus().servo(5)


def test_bytes_that_no_host_takes_do_not_pile_up():
    bus = new_bus(delay_ns=0)
    for index in range(1_000):
        bus.ledger.entries.clear()
        bus.receive_bytes(PING_1, index * 1_000_000)
    assert len(bus.drain_bytes(10**12)) <= 4096
    bus.receive_bytes(PING_1, 10**12)
    assert bus.drain_bytes(2 * 10**12) == PONG_1


def test_the_ledger_holds_every_byte_with_its_time():
    bus = new_bus()
    bus.receive_bytes(READ_1, 3_000)
    bus.drain_bytes(10**9)
    entries = [(entry.t_ns, entry.bus, entry.direction, entry.data) for entry in bus.ledger.entries]
    assert entries[0] == (3_000, "main", "in", READ_1)
    assert entries[1][:3] == (703_000, "main", "out")
    assert len(entries) == 2
