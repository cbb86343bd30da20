"""Traffic counted by columns equals the count packet by packet, to the number."""

from __future__ import annotations

import random
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tests.analysis import traffic_oracle as oracle

from dxlrun.channels.logged_packets import LoggedPacket
from dxlrun.log.columns import PacketColumns
from dxlrun.log.log_reader import read_log
from dxlrun.testing import simulated_robot
from dxlrun_analysis.servos import exchanges as pairing
from dxlrun_analysis.servos.traffic import Traffic
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.script import FaultScript
from dxlwire.packets import PacketKind

pytestmark = pytest.mark.long

ROBOTS = Path(__file__).parents[2] / "robots"
VARIOUS = ("bioloid_torso", "humanoid_20", "mechanics", "wolfgang")
"""Robots of both protocols, of one bus and of four, with devices, and with several servos a joint."""
SINGLE_1 = [bytes.fromhex("ffff0504022406ca"), bytes.fromhex("ffff070401ec"), b"\xff\xff\x05"]
MANY = [
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


def packets(chance: random.Random, count: int) -> list[LoggedPacket]:
    """Packets of three buses, in bursts that are nearly in order of time, some of one moment."""
    now = 0
    found = []
    for _ in range(count):
        bus = chance.choice((0, 0, 0, 1, 2))
        now += chance.choice((0, 1000, 40_000, 900_000, 20_000_000))
        kind = chance.choice((*[PacketKind.INSTRUCTION] * 3, *[PacketKind.STATUS] * 4, PacketKind.NOISE))
        data = (
            chance.choice(SINGLE_1 + MANY if kind is PacketKind.INSTRUCTION else STATUS)
            if kind is not PacketKind.NOISE
            else chance.randbytes(chance.randint(1, 9))
        )
        servo_id = 254 if data[2:3] == b"\xfe" or data[4:5] == b"\xfe" else chance.choice((1, 3, 4, 5, 7))
        first = now + chance.choice((0, 0, 0, 0, 30_000_000, -30_000_000))
        last = first + chance.choice((0, 500_000))
        found.append(LoggedPacket(bus, kind, servo_id, first, last, data))
    return found


def log_of(found: list[LoggedPacket]) -> Any:
    return SimpleNamespace(
        buses=("a", "b", "c"),
        packets=PacketColumns.from_packets(found),
        attachments={"plan.json": PLAN},
        cycles=(),
        events=(),
        joints=(),
        metadata={},
    )


def same(traffic: Traffic, log: Any) -> None:
    """Compare what was counted with the count of the whole log packet by packet."""
    for found, expected in zip(traffic.summarize_traffic(), oracle.traffic(log), strict=True):
        assert [
            {name: getattr(one, name) for name in row} for one, row in zip(found, expected, strict=True)
        ] == expected


@pytest.mark.parametrize("window_ms", [100, 10_000])
def test_columns_give_what_packet_by_packet_gives(window_ms: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pairing, "DISORDER_NS", window_ms * 1_000_000)
    for seed in range(50):
        chance = random.Random(seed)
        found = packets(chance, chance.choice((0, 1, 3, 40, 300)))
        for size in (chance.choice((1, 7)), 1000):
            traffic = Traffic()
            for start in range(0, max(len(found), 1), size):
                traffic.add_slice(log_of(found[start : start + size]))
            same(traffic, log_of(found))


@pytest.mark.parametrize("name", VARIOUS)
def test_columns_give_what_packet_by_packet_gives_of_a_run(name: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    simulated = simulated_robot(ROBOTS / f"{name}.yaml", duration_s=1.0, log=path)
    FaultScript([parse_fault("storm seed=5 faults=12 within=400ms at=1000ms")]).attach(simulated.buses)
    simulated.run()
    log, traffic = read_log(path), Traffic()
    traffic.add_slice(log)
    same(traffic, log)
