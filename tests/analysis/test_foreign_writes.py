"""What another host wrote to servos is told, with what failed then; what it only may have written is not."""

from typing import Any

import pytest

from dxlrun.channels.event_records import Event, EventCode, Severity
from dxlrun.channels.logged_packets import LoggedPacket
from dxlrun_analysis.plan_excerpt import LoggedBus, LoggedServo
from dxlrun_analysis.servos.foreign_writes import ForeignWrites
from dxlwire.control_table import find_table
from dxlwire.packets import PacketKind
from dxlwire.wire import protocol1, protocol2

S = 10**9
WIRES: dict[float, Any] = {1.0: protocol1, 2.0: protocol2}
MODELS = {1.0: "MX-28", 2.0: "XM430-W350"}
Failure = tuple[str, EventCode, float]


def told(protocol: float, *sent: bytes, failure: Failure | None = None) -> tuple[str, bool]:
    """What is told of instructions at 1 s, with a failure at its time, s."""
    names = enumerate(("hip", "knee", "foot"), 3)
    servos = [LoggedServo(joint=name, servo_id=at, model=MODELS[protocol]) for at, name in names]
    bus, writes = LoggedBus("main", protocol=protocol, servos=servos), ForeignWrites()
    for data in sent:
        writes.add_write(0, bus, LoggedPacket(0, PacketKind.OTHER_HOST, 254, S, S, data))
    if failure:
        name, code, at_s = failure
        writes.add_failure(Event(round(at_s * S), code, Severity.ERROR, name, ""))
    assert writes.describe_writes(1) == ("", False)
    return writes.describe_writes(0)


def item(protocol: float, name: str) -> tuple[int, int]:
    entry = find_table(MODELS[protocol], protocol).items[name]
    return entry.address, entry.size


def write(protocol: float, servo_id: int, name: str, value: int, more: bytes = b"") -> bytes:
    address, size = item(protocol, name)
    packet: bytes = WIRES[protocol].write_range(servo_id, address, value.to_bytes(size, "little") + more)
    return packet


@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_what_was_written_to_which_servo_and_what_failed_then(protocol):
    sent = write(protocol, 4, "torque_enable", 0), write(protocol, 4, "baud_rate", 3)
    text, failed = told(protocol, *sent, failure=("knee", EventCode.SERVO_LOST, 1.2))
    assert (text, failed) == ("torque_enable = 0 and baud_rate = 3 to knee (ID 4) before it was lost", True)


@pytest.mark.parametrize(
    ("code", "name", "at_s", "by_it"),
    [
        (EventCode.SERVO_LOST, "knee", 2.9, True),
        (EventCode.SERVO_LIMP, "knee", 1.1, True),
        (EventCode.SERVO_LOST, "knee", 0.9, False),
        (EventCode.SERVO_LOST, "knee", 3.1, False),
        (EventCode.SERVO_LOST, "hip", 1.1, False),
        (EventCode.SERVO_BACK, "knee", 1.1, False),
    ],
)
def test_servo_that_failed_before_or_much_later_did_not_by_it(code, name, at_s, by_it):
    text, failed = told(1.0, write(1.0, 4, "id", 9), failure=(name, code, at_s))
    assert failed is by_it
    assert text.startswith("id = 9 to knee (ID 4)" if by_it else "id = 9 to ID 4")
    assert (" before it " in text) is by_it


@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_all_servos_that_an_instruction_means_are_told(protocol):
    address, size = item(protocol, "torque_enable")
    several = WIRES[protocol].sync_write(address, size, {3: b"\0", 5: b"\1", 9: b"\0"})
    assert told(protocol, several) == ("torque_enable to IDs 3, 5", False)
    everybody = WIRES[protocol].factory_reset(254, *([protocol2.Reset.ALL] if protocol > 1 else []))
    assert told(protocol, everybody)[0] == "a factory reset to IDs 3, 4, 5"


def test_of_a_bulk_write_each_part_is_told():
    part = bytes((4, item(2.0, "torque_enable")[0], 0, 1, 0, 0))
    code = protocol2.Protocol2Instruction.BULK_WRITE
    data = protocol2.instruction_packet(254, code, part + b"\5" + part[1:])
    assert told(2.0, data) == ("torque_enable = 0 to IDs 4, 5", False)


NOTHING = {
    "a ping": protocol1.ping(4),
    "a read": protocol1.read_range(4, 36, 2),
    "no servo": write(1.0, 9, "id", 1),
    "no item begins there": protocol1.write_range(4, 31, b"\1"),
    "half an item": write(1.0, 4, "goal_position", 1, b"\1"),
    "a piece": b"\xff\xff\x04",
}


@pytest.mark.parametrize("sent", NOTHING)
def test_what_writes_no_item_of_a_servo_is_not_told(sent):
    assert told(1.0, NOTHING[sent]) == ("", False)
