"""Which servos answer later than the others of their bus, and which only look as if they did."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from dxlrun.channels.cycle import Torque
from dxlrun.channels.logged_packets import LoggedPacket
from dxlrun.log.columns import PacketColumns
from dxlrun_analysis.finding import Finding
from dxlrun_analysis.plan_excerpt import LoggedBus, LoggedServo
from dxlrun_analysis.servos.exchanges import Pairing
from dxlrun_analysis.servos.joint_states import BINS, JointStates
from dxlrun_analysis.servos.losses import Losses
from dxlrun_analysis.servos.reply_times import ReplyTimes
from dxlwire.packets import PacketKind
from dxlwire.wire import protocol2

IDS = (1, 2, 3)
CYCLES = 300
PERIOD = 10_000  # us, as all times here
SIZE = 4
CHAIN = protocol2.sync_read(132, SIZE, IDS)
ask = partial(protocol2.read_range, address=132, length=SIZE)
REPLY = 11 + SIZE
DELAY = 100
BUS = LoggedBus(
    "main",
    protocol=2.0,
    baud_rate=1_000_000,
    return_delay_ns=DELAY * 1000,
    servos=tuple(LoggedServo(servo_id=servo, joint=f"j{servo}") for servo in IDS),
)


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
            self.add(cycle, PacketKind.STATUS, servo, protocol2.status_packet(servo, 0, bytes(SIZE)))


def findings(packets: Line, *, line: bool = False) -> list[Finding]:
    """Return those about the servos; `line`: and about their bus."""
    columns = replace(PacketColumns.from_packets(packets.packets), cycle=np.array(packets.cycles, np.int64))
    times = ReplyTimes(1)
    exchanges = Pairing((BUS,)).alone(columns)
    times.add_exchanges(exchanges, exchanges.complete(), Losses(JointStates([BUS.name])))
    slow = list(times.servos(0, BUS, now_and_then=True))
    return [*slow, *times.line(0, BUS, [one.subject for one in slow])] if line else slow


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
    adapter: float = 0.0,
) -> Line:
    """Return a run of three servos. `wakes`: delays of the host, of the first reply of a cycle; `idle`: of
    the slow servo, but only where it is asked alone; `adapter`: of the first reply of each exchange.
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
            line.exchange(cycle, CHAIN, IDS, [first + waking + adapter, *behind])
        else:
            for servo in IDS:
                line.exchange(
                    cycle,
                    ask(servo),
                    [servo],
                    [own(servo) + (waking if servo == IDS[0] else 0)],
                )
        line.now += 2000  # the idle time
        servo = IDS[cycle % len(IDS)]
        line.exchange(
            cycle,
            ask(servo),
            [servo],
            [own(servo) + adapter + (idle if servo == slow else 0.0)],
        )
    return line


@pytest.mark.parametrize("chained", [True, False])
def test_what_wakes_host_and_adapter_or_is_busy_accuses_no_servo(chained):
    for noise in (0.0, 300.0):
        assert findings(run(chained=chained, wakes=800.0, noise=noise)) == []
    for seed in range(10):
        assert findings(run(chained=chained, noise=2000.0, seed=seed)) == []


def test_servo_that_is_late_only_where_it_is_asked_alone_is_not_accused():
    assert findings(run(2, chained=True, idle=900.0)) == []
    assert findings(run(1, 3000.0, idle=-3000.0), line=True) == []  # nor the adapter, of a chain alone


@pytest.mark.parametrize("chained", [True, False])
@pytest.mark.parametrize("slow", IDS)
@pytest.mark.parametrize("noise", [0.0, 200.0])
def test_a_slow_servo_is_named_wherever_it_is(slow, chained, noise):
    (finding,) = findings(run(slow, 900.0, chained=chained, wakes=300.0, noise=noise))
    assert (finding.code, finding.subject) == ("slow_servo", f"j{slow}")
    assert " now and then" not in finding.sentence


@pytest.mark.parametrize("slow", IDS)
def test_servo_that_is_slow_now_and_then_and_another_return_delay_are_named(slow):
    (finding,) = findings(run(slow, 3000.0, share=0.4, wakes=300.0, noise=20.0))
    assert (finding.code, finding.subject) == ("slow_servo", f"j{slow}")
    assert " sometimes answers late: " in finding.sentence
    (finding,) = findings(run(slow, 250.0, wakes=300.0))
    assert (finding.code, finding.subject) == ("slow_servo", f"j{slow}")
    assert "its Return Delay Time is 350 us instead of 100 us" in finding.sentence
    assert f"{slow} set return_delay_time 50" in finding.remedy


@pytest.mark.parametrize(("took", "named"), [(4000, ["slow_servo"]), (DELAY, [])])
def test_a_reply_that_was_given_up_is_late_if_it_took_longer_than_others(took, named):
    """The line may have lost bytes before it."""
    line = Line()
    for cycle in range(CYCLES):
        line.now = cycle * PERIOD
        for servo in IDS:
            given_up = servo == 2 and cycle % 10 == 0
            line.exchange(cycle, ask(servo), [servo], [took if given_up else DELAY])
            if given_up:
                line.packets[-1] = structs.replace(line.packets[-1], kind=PacketKind.LATE)
    assert [one.code for one in findings(line)] == named


def test_an_adapter_that_is_late_is_named_with_its_timer_and_no_servo():
    assert [(one.code, one.subject) for one in findings(run(wakes=300.0), line=True)] == []
    (finding,) = findings(run(adapter=16_000.0), line=True)
    assert (finding.code, finding.subject) == ("late_replies", "main")
    assert "probably by a latency timer of 16 ms: 100% of its exchanges" in finding.sentence
    assert finding.remedy.startswith("`echo 1 | sudo tee /sys/")


def test_samples_wait_for_their_exchanges_and_a_linear_joint_is_binned_by_the_angle_of_its_servo():
    count, share = 8, 0.01  # m per rad
    kind = [(name, of, (1,)) for name, of in (("position", float), ("temperature", float), ("valid", bool))]
    cycles = np.zeros(count, [("cycle", int), ("period_ns", int), *kind, ("torque", np.uint8, (1,))])
    cycles["cycle"], cycles["period_ns"] = range(count), 20_000_000
    cycles["position"][:, 0] = share * np.radians(5) * (np.arange(count) + 0.5)
    cycles["valid"], cycles["torque"] = True, Torque.ON
    states = JointStates((), ("lift",))
    states.share[:] = share
    for part in (cycles[:4], cycles[4:]):
        log: Any = SimpleNamespace(cycles=part)
        states.add_states(log)
    found = [states.until(1), states.until(0, everything=True)]
    assert [places.cycle.tolist() for places in found] == [[0, 1], [2, 3, 4, 5, 6, 7]]
    angle = np.concatenate([places.bins[0, :, 0] for places in found])
    assert angle.tolist() == [BINS // 2 + number for number in range(count)]
    assert states.time_ns[0, 0].sum() == count * 20_000_000
