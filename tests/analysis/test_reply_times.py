"""Which servos answer later than the others of their bus, and which only look as if they did."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from dxlrun.analysis.finding import Finding
from dxlrun.analysis.plan import LoggedBus, LoggedServo
from dxlrun.analysis.servos.exchanges import Pairing
from dxlrun.analysis.servos.reply_times import ReplyTimes
from dxlrun.log.columns import PacketColumns
from dxlrun.run.channels.packets import LoggedPacket, PacketKind

IDS = (1, 2, 3)
CYCLES = 300
PERIOD = 10_000
"""us, as all times here."""
SIZE = 4
CHAIN = bytes([255, 255, 253, 0, 254, 10, 0, 0x82, 132, 0, SIZE, 0, *IDS, 0, 0])
REPLY = 11 + SIZE
DELAY = 100
BUS = LoggedBus(
    "main",
    protocol=2.0,
    baud_rate=1_000_000,
    return_delay_ns=DELAY * 1000,
    servos=tuple(LoggedServo(servo_id=servo, joint=f"j{servo}") for servo in IDS),
)


def ask(servo: int) -> bytes:
    return bytes([255, 255, 253, 0, servo, 7, 0, 0x02, 132, 0, SIZE, 0, 0, 0])


def status(servo: int) -> bytes:
    return bytes([255, 255, 253, 0, servo, 8, 0, 0x55, 0, *bytes(SIZE), 0, 0])


class Line:
    """Packets of a bus, one behind the other."""

    def __init__(self) -> None:
        self.now = 0
        self.packets: list[LoggedPacket] = []
        self.cycles: list[int] = []

    def add(self, cycle: int, kind: PacketKind, servo: int, data: bytes) -> None:
        self.packets.append(LoggedPacket(0, kind, servo, self.now * 1000, self.now * 1000, data))
        self.cycles.append(cycle)

    def exchange(self, cycle: int, data: bytes, servos: Sequence[int], own: Sequence[float]) -> None:
        """Ask, and let each servo take its own time."""
        self.add(cycle, PacketKind.INSTRUCTION, data[4], data)
        self.now += len(data) * 10
        for servo, us in zip(servos, own, strict=True):
            self.now += round(us) + REPLY * 10
            self.add(cycle, PacketKind.STATUS, servo, status(servo))


def findings(line: Line) -> list[Finding]:
    columns = replace(PacketColumns.of(line.packets), cycle=np.array(line.cycles, np.int64))
    times = ReplyTimes()
    times.take(Pairing().pair(columns, (BUS,)))
    return list(times.findings(0, BUS))


def run(
    slow: int = 0,
    by: float = 0.0,
    *,
    chained: bool = True,
    wakes: float = 0.0,
    noise: float = 0.0,
    share: float = 1.0,
    seed: int = 1,
    idle: float = 0.0,
) -> Line:
    """Return a run of three servos. `wakes`: delays of the host, of the first reply of a cycle; `idle`: of
    the slow servo, but only where it is asked alone.
    """
    chance, line = np.random.default_rng(seed), Line()

    def own(servo: int) -> float:
        late = by if servo == slow and chance.random() < share else 0.0
        return DELAY + late + float(chance.exponential(noise) if noise else 0.0)

    for cycle in range(CYCLES):
        line.now = cycle * PERIOD
        waking = float(chance.exponential(wakes) if wakes else 0.0)
        if chained:
            first, *behind = (own(servo) for servo in IDS)
            line.exchange(cycle, CHAIN, IDS, [first + waking, *behind])
        else:
            for servo in IDS:
                line.exchange(cycle, ask(servo), [servo], [own(servo) + (waking if servo == IDS[0] else 0)])
        line.now += 2000  # the idle time
        servo = IDS[cycle % len(IDS)]
        line.exchange(cycle, ask(servo), [servo], [own(servo) + (idle if servo == slow else 0.0)])
    return line


@pytest.mark.parametrize("chained", [True, False])
@pytest.mark.parametrize("noise", [0.0, 300.0])
def test_what_wakes_host_and_adapter_accuses_no_servo(chained: bool, noise: float) -> None:
    assert findings(run(chained=chained, wakes=800.0, noise=noise)) == []


@pytest.mark.parametrize("chained", [True, False])
def test_noise_of_a_busy_machine_accuses_no_servo(chained: bool) -> None:
    for seed in range(10):
        assert findings(run(chained=chained, noise=2000.0, seed=seed)) == []


def test_a_servo_that_is_late_only_where_it_is_asked_alone_is_not_accused() -> None:
    assert findings(run(2, chained=True, idle=900.0)) == []


@pytest.mark.parametrize("chained", [True, False])
@pytest.mark.parametrize("slow", IDS)
@pytest.mark.parametrize("noise", [0.0, 200.0])
def test_a_slow_servo_is_named_wherever_it_is(slow: int, chained: bool, noise: float) -> None:
    (finding,) = findings(run(slow, 900.0, chained=chained, wakes=300.0, noise=noise))
    assert (finding.code, finding.subject) == ("slow_servo", f"j{slow}")
    assert " now and then" not in finding.sentence


@pytest.mark.parametrize("slow", IDS)
def test_a_servo_that_is_slow_now_and_then_is_named(slow: int) -> None:
    (finding,) = findings(run(slow, 3000.0, share=0.4, wakes=300.0, noise=20.0))
    assert (finding.code, finding.subject) == ("slow_servo", f"j{slow}")
    assert " answers late now and then: " in finding.sentence


@pytest.mark.parametrize("slow", IDS)
def test_a_return_delay_that_is_another_is_told_with_its_value(slow: int) -> None:
    (finding,) = findings(run(slow, 250.0, wakes=300.0))
    assert (finding.code, finding.subject) == ("return_delay", f"j{slow}")
    assert "answers after 350 us" in finding.sentence
    assert f"{slow} set return_delay_time 50" in finding.remedy
