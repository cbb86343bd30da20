"""Traffic: the ledger of the simulated buses has the same packets and bytes, and slices change no number."""

import random
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tests.kit.virtual_run import VirtualRun

from dxlrun.channels.logged_packets import LoggedPacket
from dxlrun.log.columns import PacketColumns
from dxlrun.testing import read_log
from dxlrun_analysis.servos import exchanges as pairing
from dxlrun_analysis.servos.traffic import Traffic
from dxlwire.packets import PacketKind

pytestmark = pytest.mark.long

ROBOTS = Path(__file__).parents[2] / "robots"
INSTRUCTIONS = [
    bytes.fromhex("ffff0504022406ca"),
    bytes.fromhex("ffff070401ec"),
    b"\xff\xff\x05",
    bytes.fromhex("fffffd00fe090082840004000102cefa"),
    bytes.fromhex("fffffd00fe0a008a84000400030704fab5"),
    bytes.fromhex("fffffd00fe0a00829000040003030405b5"),  # one servo twice
    bytes.fromhex("fffffe09920002032402072411"),
    bytes.fromhex("fffffd00fe0d009a0384000400078400020000"),
    bytes.fromhex("fffffd00fe0a0082fffffdfd0005cefa"),
    bytes.fromhex("fffffd00fe0300013142"),
    bytes.fromhex("fffffd0001070002840004001d15"),
    bytes.fromhex("fffffe0783240205fa01aa"),
]
STATUS = [
    bytes.fromhex("ffff05080000020000000000f0"),
    bytes.fromhex("ffff0308240002000000000000"),
    bytes.fromhex("fffffd0001080055000102030400"),
    bytes.fromhex("fffffd0003080055840102030400"),
    bytes.fromhex("fffffd00fe1a00550003a60000002e9080070100000011220004000000000000"),
    bytes.fromhex("fffffd00fe1a0055000301"),
]
PLAN = (
    b'{"buses": [{"name": "a", "baud_rate": 1000000, "return_delay_ns": 250000, "latency_ns": 1000000},'
    b'{"name": "c", "baud_rate": 57600, "return_delay_ns": 0}]}'
)


def random_packets(chance: random.Random, count: int) -> list[LoggedPacket]:
    """Return packets of three buses, in bursts that are nearly in order of time, some of one moment."""
    now = 0
    found = []
    for _ in range(count):
        now += chance.choice((0, 1000, 40_000, 900_000, 20_000_000))
        kind = chance.choice((*[PacketKind.INSTRUCTION] * 3, *[PacketKind.STATUS] * 4, PacketKind.NOISE))
        known = {PacketKind.INSTRUCTION: INSTRUCTIONS, PacketKind.STATUS: STATUS}
        data = chance.choice(known[kind]) if kind in known else chance.randbytes(chance.randint(1, 9))
        servo_id = 254 if data[2:3] == b"\xfe" or data[4:5] == b"\xfe" else chance.choice((1, 3, 4, 5, 7))
        first = now + chance.choice((0, 0, 0, 0, 30_000_000, -30_000_000))
        last = first + chance.choice((0, 500_000))
        found.append(LoggedPacket(chance.choice((0, 0, 0, 1, 2)), kind, servo_id, first, last, data))
    return found


def count_slices(found: list[LoggedPacket], size: int) -> object:
    """Return the traffic of packets that are counted in slices of a size."""
    traffic, about = Traffic(), {"cycles": (), "events": (), "joints": (), "metadata": {}}
    for start in range(0, max(len(found), 1), size):
        packets = PacketColumns.from_packets(found[start : start + size])
        part: Any = SimpleNamespace(
            buses=("a", "b", "c"), packets=packets, attachments={"plan.json": PLAN}, **about
        )
        traffic.add_slice(part)
    return traffic.summarize_traffic()


@pytest.mark.parametrize("window_ms", [100, 10_000])
def test_slices_of_any_size_have_the_same_traffic(window_ms, monkeypatch):
    monkeypatch.setattr(pairing, "DISORDER_NS", window_ms * 1_000_000)
    for seed in range(50):
        chance = random.Random(seed)
        found = random_packets(chance, chance.choice((0, 1, 3, 40, 300)))
        assert count_slices(found, chance.choice((1, 7))) == count_slices(found, 1000), seed


@pytest.mark.parametrize("name", ["humanoid_20", "mechanics", "wolfgang"])
def test_traffic_is_that_of_the_ledger(name, tmp_path):
    robot = VirtualRun(ROBOTS / f"{name}.yaml", tmp_path / "run.mcap", duration_s=1.0)
    robot.fault("storm seed=5 faults=12 within=400ms at=1000ms")
    traffic = Traffic()
    traffic.add_slice(read_log(robot.logged()))
    servos, buses = traffic.summarize_traffic()
    assert buses
    for bus in buses:
        mine = [entry for entry in robot.ledger.entries if entry.bus == bus.name]
        asked = [entry.data for entry in mine if entry.direction == "in"]
        came = [entry for entry in mine if entry.direction == "out"]
        noise = [entry.data for entry in came if entry.note.startswith("noise")]
        assert (bus.instructions, bus.bytes_out) == (len(asked), len(b"".join(asked)))
        assert (bus.bytes_in, bus.noise_bytes) == (sum(len(one.data) for one in came), len(b"".join(noise)))
        assert sum(servo.replies for servo in servos if servo.bus == bus.name) == len(came) - len(noise)
