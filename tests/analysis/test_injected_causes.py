"""Causes injected into simulated robots: the sentence behind the robot's line names each, by the log alone.

And no servo that was well is accused, and no run without a fault is. CI runs a seeded sample; all of it, each
cause on each robot and 100 runs without a fault:

    DXLRUN_CAUSES=500 python -m pytest tests/analysis/test_injected_causes.py -q

Slow controllers and late wake-ups take time that virtual time has not: tests/analysis/cycles/test_causes.py.
"""

from __future__ import annotations

import itertools
import math
import os
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest
from tests.kit.line_faults import corrupt_next, delay_next, other_host
from tests.kit.totals import totals_of

from dxlrun.dynamixel.wire import protocol1, protocol2
from dxlrun.simulation.faults.fault import parse_fault
from dxlrun.simulation.faults.script import FaultScript
from dxlrun.testing import VirtualRobot, simulated_robot
from dxlrun_analysis.finding import Finding, Rank
from dxlrun_analysis.verdict import Verdict, judge

MS = 1_000_000
MODELS = {1.0: ("AX-12A", 150), 2.0: ("XM430-W350", 180)}
ROBOTS: dict[str, dict[str, tuple[float, int]]] = {
    "eight_ax": {"main": (1.0, 8)},
    "six_x": {"main": (2.0, 6)},
    "two_buses": {"left": (1.0, 4), "right": (2.0, 4)},
}
ACCUSING = (Rank.LINE, Rank.SERVO_CAUSE, Rank.SHARE_CAUSE, Rank.CAUSE)
DURATION_S = 12


@dataclass(frozen=True)
class Target:
    """Where a cause is injected."""

    bus: str
    index: int
    protocol: float
    servos: tuple[int, ...]
    servo: int
    other: int
    seed: int

    def joint(self, servo: int | None = None) -> str:
        return f"j{self.servo if servo is None else servo}"


Inject = Callable[[VirtualRobot, Target], Sequence[str]]


@dataclass(frozen=True)
class Cause:
    """A cause, and what the verdict is to call it."""

    code: str
    inject: Inject
    of_bus: bool = False
    of: str = ""  # What else it is of
    protocols: tuple[float, ...] = (1.0, 2.0)
    robots: tuple[str, ...] = tuple(ROBOTS)


def fault(line: str) -> Inject:
    """A fault by its line, with the target's servo, angle and seed."""

    def inject(robot: VirtualRobot, target: Target) -> Sequence[str]:
        middle = MODELS[target.protocol][1]
        chance = random.Random(target.seed)
        low = middle + chance.choice((-25, -10, 5, 20))
        return [line.format(servo=target.servo, low=low, high=low + chance.randint(10, 15), seed=target.seed)]

    return inject


def poke(at_ms: int, **items: tuple[str, int]) -> Inject:
    """A register that is another one from a time on; `items`: by protocol."""

    def inject(robot: VirtualRobot, target: Target) -> Sequence[str]:
        name, value = items[f"p{target.protocol:.0f}"]
        bus = robot.buses[target.index]
        bus.at(at_ms * MS, lambda: bus.servo(target.servo).poke(name, value))
        return []

    return inject


def shared(robot: VirtualRobot, target: Target) -> Sequence[str]:
    times = range(2000, 11_000, 900)
    return [
        f"silence servo={servo} for=45ms at={at}ms" for at in times for servo in (target.servo, target.other)
    ]


def broken_controller(robot: VirtualRobot, target: Target) -> Sequence[str]:
    (controller,) = (each.controller for each in robot.robot.manager._managed)  # no plug-in for it
    update, cycles = controller.update, itertools.count()

    def failing(time: float, period: float) -> None:
        if next(cycles) == 250:
            raise ZeroDivisionError("a gain of 0")
        update(time, period)

    controller.update = failing
    return []


def others(robot: VirtualRobot, target: Target) -> Sequence[str]:
    """Another host pings and reads, at times of its own, so that now and then replies collide."""
    bus, dialect = robot.buses[target.index], protocol1 if target.protocol == 1.0 else protocol2
    for number in range(300):
        packet = dialect.ping(target.other) if number % 3 else dialect.read(target.servo, 36, 2)
        other_host(bus, packet, (2000 + 29 * number) * MS + 400_000 * (number % 7))
    return []


def held_back(robot: VirtualRobot, target: Target) -> Sequence[str]:
    """A hub or the host keeps the replies of every bus back at the same moments."""
    for number in range(12):
        for index, bus in enumerate(robot.buses):
            servo = target.servos[0] if index == target.index else bus.servos[0].servo_id
            delay_ns = (14 + number % 3 * 2) * MS
            bus.at((2000 + 700 * number) * MS, partial(delay_next, bus, servo, delay_ns))
    return []


def later(robot: VirtualRobot, target: Target) -> Sequence[str]:
    """A servo answers now and then after it was given up."""
    bus = robot.buses[target.index]
    for number in range(12):
        bus.at((2000 + 700 * number) * MS, partial(delay_next, bus, target.servo, 25 * MS))
    return []


def at_an_angle(robot: VirtualRobot, target: Target) -> Sequence[str]:
    """A servo answers later in a part of its way, whatever the others do; a fast status hides it."""
    bus, servo = robot.buses[target.index], robot.buses[target.index].servo(target.servo)
    low = math.radians(MODELS[target.protocol][1] + random.Random(target.seed).choice((-25, -10, 5)))

    def check() -> None:
        if low <= servo.position <= low + math.radians(20):
            delay_next(bus, target.servo, 900_000)

    for number in range(20, 50 * DURATION_S):
        bus.at(number * 20 * MS + 100, check)
    return []


def broken(robot: VirtualRobot, target: Target) -> Sequence[str]:
    bus = robot.buses[target.index]
    for number in range(30):
        corrupt = partial(corrupt_next, bus, target.servo, 7 - number % 3)
        bus.at((2000 + 290 * number) * MS, corrupt)
    return []


CAUSES: dict[str, Cause] = {
    "latency timer": Cause("latency_timer", fault("timer at=2s"), of_bus=True),
    "slow servo": Cause("slow_servo", fault("slow servo={servo} by=900us at=2s")),
    "wrong return delay": Cause(
        "return_delay", poke(0, p1=("return_delay_time", 200), p2=("return_delay_time", 200))
    ),
    "loose cable at an angle": Cause(
        "loose_cable", fault("loose servo={servo} low={low}deg high={high}deg share=0.3 at=2s")
    ),
    "lossy line": Cause("lossy_line", fault("lossy share=0.03 at=2s"), of_bus=True),
    "lossy servo": Cause("lossy_servo", fault("lossy servo={servo} share=0.05 at=2s")),
    "noise": Cause("noise", fault("storm seed={seed} faults=300 within=9s kinds=noise at=2s"), of_bus=True),
    "babbling servo": Cause("noise", fault("babble servo={servo} for=5s every=7ms at=3s"), of_bus=True),
    "hot joint": Cause("hot_joint", fault("overheat servo={servo} celsius=92 at=4s")),
    "overload": Cause("overload", fault("overload servo={servo} at=5s")),
    "sagging supply": Cause("sagging_supply", fault("sag ohms=6 at=2s"), of_bus=True),
    "undervoltage": Cause("undervoltage", fault("voltage servo={servo} volts=5 at=4s")),
    "reboot": Cause("servo_rebooted", fault("reboot servo={servo} at=6s")),
    "unplugged servo": Cause("servo_lost", fault("silence servo={servo} at=6s")),
    "wrong baud rate": Cause("servo_lost", poke(6000, p1=("baud_rate", 34), p2=("baud_rate", 1))),
    "unplugged adapter": Cause("bus_lost", fault("unplug at=6s for=2s"), of_bus=True),
    "wedged adapter": Cause("silent_bus", fault("wedge at=6s"), of_bus=True),
    "jammed joint": Cause("jammed_joint", fault("jam servo={servo} at=4s")),
    "wrong torque limit": Cause("torque_limit", poke(3000, p1=("torque_limit", 40), p2=("goal_pwm", 25))),
    "power cut": Cause("power_lost", fault("brownout at=6s"), of_bus=True),
    "broken controller": Cause("errors_logged", broken_controller, of="motion"),
    "another host": Cause("another_host", others, of_bus=True),
    "late everywhere": Cause("late_replies_everywhere", held_back, of="machine", robots=("two_buses",)),
    "late servo": Cause("slow_servo", later),
    "late at an angle": Cause("slow_servo", at_an_angle, protocols=(1.0,)),
    "broken driver": Cause("broken_replies", broken),
    "duplicate ID": Cause("broken_replies", fault("duplicate_id servo={servo} at=4s")),
    "shared cable": Cause("shared_cable", shared, of_bus=True),
}
"""By what happens to the robot."""


def robot_files(directory: Path, robot: str, seed: int) -> tuple[Path, Path]:
    """Write a robot of some buses, and a motion in which each joint swings at its own pace."""
    chance = random.Random(seed)
    lines = ["name: swinging", "loop: {rate: 50}", "buses:"]
    lines += [
        f"  {bus}: {{port: sim, protocol: {protocol}, baud_rate: 1_000_000, return_delay_time: 100 us}}"
        for bus, (protocol, _) in ROBOTS[robot].items()
    ]
    lines.append("joints:")
    motion = [
        f"name: swings\nmotions:\n  - controller: motion\n    duration: {DURATION_S} s\n"
        "    samples: 400\n    joints:"
    ]
    names = []
    for servo, (bus, protocol) in enumerate(servos_of(robot), start=1):
        model, middle = MODELS[protocol]
        lines.append(
            f"  j{servo}: {{bus: {bus}, id: {servo}, model: {model}, reference: {middle} deg, direction: 1, "
            "limits: {position: [-1.2 rad, 1.2 rad], velocity: 4 rad/s}}"
        )
        pace = chance.uniform(3.0, 4.0)
        motion.append(f"      j{servo}: {{position: {chance.uniform(0.7, 0.9):.3f} * sin({pace:.3f} * t)}}")
        names.append(f"j{servo}")
    lines.append("controllers:")
    lines.append(f"  motion: {{type: joint_trajectory_controller, joints: [{', '.join(names)}]}}")
    files = directory / "robot.yaml", directory / "motion.yaml"
    for file, text in zip(files, (lines, motion), strict=True):
        file.write_text("\n".join(text) + "\n")
    return files


def servos_of(robot: str) -> list[tuple[str, float]]:
    return [(bus, protocol) for bus, (protocol, count) in ROBOTS[robot].items() for _ in range(count)]


def verdict_of(
    directory: Path, robot: str, seed: int, inject: Callable[[VirtualRobot], Sequence[str]]
) -> Verdict:
    """Run a robot with a cause, and judge its log."""
    file, motion = robot_files(directory, robot, seed)
    log = directory / "run.mcap"
    simulated = simulated_robot(file, play=[motion], duration_s=DURATION_S, log=log)
    lines = inject(simulated)
    FaultScript([parse_fault(line) for line in lines], seed).attach(simulated.buses)
    simulated.run()
    return judge(totals_of(log))


def target_of(robot: str, cause: Cause, seed: int) -> Target:
    """Choose a servo, not the first of its bus: of a group read whose first is silent nothing is known."""
    chance = random.Random(seed)
    buses = [
        (index, bus) for index, bus in enumerate(ROBOTS[robot]) if ROBOTS[robot][bus][0] in cause.protocols
    ]
    index, bus = chance.choice(buses)
    ids = [servo for servo, (of, _) in enumerate(servos_of(robot), start=1) if of == bus]
    servo, other = chance.sample(ids[1:], 2)
    return Target(bus, index, ROBOTS[robot][bus][0], tuple(ids), servo, other, seed)


def accusations(verdict: Verdict) -> list[Finding]:
    return [finding for finding in verdict.findings if finding.rank in ACCUSING]


COUNT = int(os.environ.get("DXLRUN_CAUSES", "5"))
SEED = int(os.environ.get("DXLRUN_CAUSES_SEED", "1"))


def runs() -> list[tuple[str, str, int]]:
    """Return cause, robot and seed of each run."""
    chance = random.Random(SEED)
    pairs = [
        (name, robot, chance.randrange(10**6))
        for name, cause in CAUSES.items()
        for robot in cause.robots
        if any(protocol in cause.protocols for protocol, _ in ROBOTS[robot].values())
    ]
    return chance.sample(pairs, min(COUNT, len(pairs)))


WIRE = [
    ("another host", "eight_ax"),
    ("another host", "six_x"),
    ("late everywhere", "two_buses"),
    ("late servo", "eight_ax"),
    ("late servo", "six_x"),
    ("babbling servo", "eight_ax"),
    ("late at an angle", "eight_ax"),
    ("broken driver", "six_x"),
    ("duplicate ID", "eight_ax"),
]


@pytest.mark.parametrize(("name", "robot"), WIRE)
def test_what_is_on_the_wire_is_named(tmp_path: Path, name: str, robot: str) -> None:
    named_first(tmp_path, name, robot, 7)


@pytest.mark.campaign
@pytest.mark.parametrize(("name", "robot", "seed"), runs())
def test_the_first_sentence_names_the_cause(tmp_path: Path, name: str, robot: str, seed: int) -> None:
    named_first(tmp_path, name, robot, seed)


def named_first(tmp_path: Path, name: str, robot: str, seed: int) -> None:
    cause = CAUSES[name]
    target = target_of(robot, cause, seed)

    def inject(simulated: VirtualRobot) -> Sequence[str]:
        lines = cause.inject(simulated, target)
        return [f"{line} bus={target.bus}" for line in lines]

    verdict = verdict_of(tmp_path, robot, seed, inject)
    first, subject = verdict.findings[1], cause.of or (target.bus if cause.of_bus else target.joint())
    assert (first.code, first.subject) == (cause.code, subject), verdict.sentences
    well = {f"j{servo}" for servo in range(1, 9)} - {target.joint(), target.joint(target.other)}
    assert not [finding for finding in accusations(verdict) if finding.subject in well], verdict.sentences


@pytest.mark.campaign
@pytest.mark.parametrize("seed", range(COUNT // 5))
def test_no_run_without_a_fault_gives_an_accusation(tmp_path: Path, seed: int) -> None:
    verdict = verdict_of(tmp_path, tuple(ROBOTS)[seed % len(ROBOTS)], seed, lambda simulated: [])
    wrong = [one.code for one in verdict.findings if one.rank is Rank.ERROR]
    assert verdict.good or wrong == ["motion_cut"]  # the run is shorter than the motion
    assert accusations(verdict) == []
