"""Which servos answer later than the others of their bus, and which only look as if they did."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dxlrun.channels.packets import LoggedPacket, PacketKind
from dxlrun.log.columns import PacketColumns
from dxlrun_analysis.finding import Finding
from dxlrun_analysis.page.canvas import Canvas
from dxlrun_analysis.page.findings import finding_plots
from dxlrun_analysis.plan import LoggedBus, LoggedPlan, LoggedServo
from dxlrun_analysis.servos.exchanges import Pairing
from dxlrun_analysis.servos.joint_states import JointStates, Places
from dxlrun_analysis.servos.late_replies import LateReplies
from dxlrun_analysis.servos.reply_times import ReplyTime, ReplyTimes
from dxlrun_analysis.servos.traffic import ServoTraffic

IDS = (1, 2, 3)
CYCLES = 300
PERIOD = 10_000  # us, as all times here
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
    times = ReplyTimes(JointStates())
    times.take(Pairing((BUS,)).alone(columns), Places())
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


LONG = 600
SWING = 60 * np.sin(np.arange(LONG) * 0.13)  # deg
IN_RANGE = (SWING >= 20) & (SWING < 40)
WARM = np.linspace(30, 62, LONG)
PLAN = LoggedPlan(buses=[BUS])


def somewhere(
    late: Callable[[int, int], float],
    angle: Any = SWING,
    heat: Any = None,
    *,
    chained: bool = True,
    given_up: bool = False,
    period: int = PERIOD,
) -> list[Finding]:
    """Findings about a run; `late`: how much, by servo and cycle; angle and heat are those of all joints."""
    line, chance = Line(), np.random.default_rng(1)
    for cycle in range(LONG):
        line.now = cycle * period
        own = [DELAY + late(servo, cycle) + float(chance.exponential(20.0)) for servo in IDS]
        if chained:
            line.exchange(cycle, CHAIN, IDS, own)
            continue
        for servo, us in zip(IDS, own, strict=True):
            line.exchange(cycle, ask(servo), [servo], [us])
            if given_up and us > 700:
                line.packets[-1] = replace(line.packets[-1], kind=PacketKind.LATE)
    cycles = np.zeros(
        LONG,
        [
            *(("cycle", "i8"), ("period_ns", "i8"), ("position", "f8", 3), ("valid", "u1", 3)),
            *(("torque", "u1", 3), ("temperature", "f8", 3)),
        ],
    )
    cycles["cycle"], cycles["period_ns"], cycles["valid"] = np.arange(LONG), period * 1000, 1
    cycles["position"] = np.radians(angle)[:, None]
    cycles["temperature"] = np.nan if heat is None else heat[:, None]
    states = JointStates([BUS.name], [f"j{servo}" for servo in IDS], PLAN)
    states.take(SimpleNamespace(cycles=cycles))  # type: ignore[arg-type]
    columns = replace(PacketColumns.of(line.packets), cycle=np.array(line.cycles, np.int64))
    times = ReplyTimes(states)
    times.take(Pairing((BUS,)).alone(columns), states.until(LONG))
    return list(times.somewhere(0, BUS))


@pytest.mark.parametrize("chained", [True, False])
@pytest.mark.parametrize("slow", IDS[1:])
def test_a_servo_that_is_late_at_some_angles_is_named_with_them(slow: int, chained: bool) -> None:
    angle = np.where(np.arange(LONG) == 7, 100.0, SWING)  # a stray one proves nothing
    late = IN_RANGE | (angle == 100)
    (finding,) = somewhere(lambda servo, cycle: 800 * (servo == slow and late[cycle]), angle, chained=chained)
    assert (finding.code, finding.subject) == ("slow_servo", f"j{slow}")
    assert re.search(
        r"answers 8[01234]0 us later between 20 and 40 deg than elsewhere, while", finding.sentence
    )
    assert finding.share == pytest.approx(IN_RANGE.mean(), abs=0.01)


def test_replies_that_were_given_up_count_at_their_angles() -> None:
    (finding,) = somewhere(
        lambda servo, cycle: 4000 * (servo == 2 and IN_RANGE[cycle]), chained=False, given_up=True
    )
    assert (finding.subject, "between 20 and 40 deg" in finding.sentence) == ("j2", True)


@pytest.mark.parametrize(("took", "named"), [(4000, ["slow_servo"]), (DELAY, [])])
def test_a_reply_that_was_given_up_is_late_if_it_took_longer_than_others(took: int, named: list[str]) -> None:
    """The line may have lost bytes before it."""
    line = Line()
    for cycle in range(CYCLES):
        line.now = cycle * PERIOD
        for servo in IDS:
            given_up = servo == 2 and cycle % 10 == 0
            line.exchange(cycle, ask(servo), [servo], [took if given_up else DELAY])
            if given_up:
                line.packets[-1] = replace(line.packets[-1], kind=PacketKind.LATE)
    columns = replace(PacketColumns.of(line.packets), cycle=np.array(line.cycles, np.int64))
    replies, none = LateReplies(1), np.zeros(0, np.int64)
    replies.take(Pairing((BUS,)).alone(columns), none, none)
    assert [one.code for one in replies.findings(0, BUS)] == named


def test_a_servo_that_is_late_when_hot_is_named_with_the_temperature() -> None:
    (finding,) = somewhere(lambda servo, cycle: 900 * (servo == 3 and WARM[cycle] >= 54.5), heat=WARM)
    assert finding.subject == "j3"
    assert " us later from 55 deg C on than elsewhere" in finding.sentence


def test_where_angle_and_temperature_both_explain_it_they_are_candidates() -> None:
    heat = np.where(IN_RANGE, 55.0, 40.0)
    (finding,) = somewhere(lambda servo, cycle: 900 * (servo == 3 and IN_RANGE[cycle]), heat=heat)
    assert " between 20 and 40 deg or from 55 deg C on than elsewhere" in finding.sentence
    assert finding.sentence.endswith("the log does not show which of the two it is.")


def test_a_late_servo_has_plots_of_its_reply_times_by_angle_and_temperature() -> None:
    own = ReplyTime(
        **dict.fromkeys(("replies", "median_us", "p99_us", "planned_us"), 0),
        histogram=(),
        by_angle=((15.0, 100.0), (20.0, 900.0)),
        by_temperature=((50.0, 120.0), (55.0, 130.0)),
    )
    servos = [ServoTraffic("main", 2, "j2", *(0,) * 4, 0, (), 0.0, 0.0, own=own)]
    said = [Finding("slow_servo", "j2", "It is late."), Finding("slow_servo", "j3", "It is too.")]
    plots = finding_plots(
        Canvas(10**9, 10**9, 3 * 10**9),
        SimpleNamespace(verdict=SimpleNamespace(findings=said), trends=(), joints=(), servos=servos),  # type: ignore[arg-type]
    )
    drawn = [dict(renderer.data_source.data) for plot in plots for renderer in plot.model.renderers]
    assert [(list(each["x"]), list(each["y"])) for each in drawn] == [
        ([15.0, 20.0], [100.0, 900.0]),
        ([50.0, 55.0], [120.0, 130.0]),
    ]
    assert {plot.text for plot in plots} == {"It is late."}


ENDS = ((SWING >= 0) & (SWING < 5)) | ((SWING >= 35) & (SWING < 40))
ONCE = np.arange(LONG) >= LONG // 2
INNOCENT: dict[str, tuple[Callable[[int, int], float], dict[str, Any]]] = {
    "the machine stalls just then": (lambda servo, cycle: 900 * IN_RANGE[cycle], {"heat": WARM}),
    "it stalls for one reply of each cycle": (
        lambda servo, cycle: 3000 * (IN_RANGE[cycle] and cycle % 3 == servo - 1),
        {},
    ),
    "it stalls while all are hot": (lambda servo, cycle: 900 * (WARM[cycle] > 55), {"heat": WARM}),
    "two are late together": (lambda servo, cycle: 900 * (servo > 1 and IN_RANGE[cycle]), {}),
    "late from a moment on, at all angles": (lambda servo, cycle: 900 * (servo == 2 and ONCE[cycle]), {}),
    "late from a moment on, in which it also moved": (
        lambda servo, cycle: 900 * (servo == 2 and ONCE[cycle]),
        {"angle": 30.0 * ONCE},
    ),
    "late from a moment on, while it warms up a little": (
        lambda servo, cycle: 900 * (servo == 2 and ONCE[cycle]),
        {"heat": np.linspace(30, 40, LONG)},
    ),
    "too short a time there": (
        lambda servo, cycle: 900 * (servo == 2 and IN_RANGE[cycle] and cycle < 300),
        {"angle": np.where(np.arange(LONG) < 300, SWING, -50.0)},
    ),
    "too few replies there": (
        lambda servo, cycle: 900 * (servo == 2 and SWING[cycle] >= 50 and cycle < 90),
        {"angle": np.where(np.arange(LONG) < 90, SWING, -50.0), "period": 10 * PERIOD},
    ),
    "late while warm, but not while hotter": (
        lambda servo, cycle: 900 * (servo == 2 and 50 <= WARM[cycle] < 53),
        {"heat": WARM},
    ),
    "much later at both ends only": (
        lambda servo, cycle: (servo == 2) * (200 * (0 <= SWING[cycle] < 40) + 700 * ENDS[cycle]),
        {},
    ),
    "hardly later": (lambda servo, cycle: 250 * (servo == 2 and IN_RANGE[cycle]), {}),
    "hardly more than it varies": (
        lambda servo, cycle: (servo == 2) * (500 * IN_RANGE[cycle] + 200 * (cycle % 2)),
        {},
    ),
}


@pytest.mark.parametrize("name", INNOCENT)
@pytest.mark.parametrize("chained", [True, False])
def test_what_is_no_angle_and_no_temperature_of_one_servo_is_not_named(name: str, chained: bool) -> None:
    late, states = INNOCENT[name]
    assert somewhere(late, **states, chained=chained) == []
