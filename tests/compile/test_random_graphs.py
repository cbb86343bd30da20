"""Random graphs: a right one runs as it is drawn, and one with a mistake is refused for that mistake.

CI takes 50. The full campaign before a release:

    pytest --campaign=release tests/compile/test_random_graphs.py

The order, and what reaches the servos, are computed here again, from the lists that the robot file is written
from, by brute force and without a line of the runtime's graph. `cases/chains.txt` has each mistake alone.
"""

import random
import re
import struct
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from tests.kit.campaigns import campaign
from tests.kit.wire import taken_apart, writes

from dxlrun.compile.robot_compiler import compile_files
from dxlrun.errors import InputError
from dxlrun.run.virtual_run import VirtualRobot

CYCLES = 12
RATE = 100
JOINTS = ("j1", "j2", "j3")
STATES = ("position", "velocity", "effort", "temperature", "voltage", "age")
INTERFACES = ("position", "velocity", "effort", "pwm")
UNITS = {"position": 2 * np.pi / 4096, "velocity": 0.229 * 2 * np.pi / 60, "effort": 2.69e-3, "pwm": 1 / 885}
"""One step on the wire, of an XM430: its page in the e-Manual."""
SERVO_COMMANDS = (("position",), ("position", "velocity"), ("velocity",), ("effort",), ("pwm",))
ADDRESSES = {"position": (116, "<i"), "velocity": (104, "<i"), "effort": (102, "<h"), "pwm": (100, "<h")}
ROBOT = """\
name: random
buses: {main: {port: sim, protocol: 2.0, baud_rate: 1_000_000}}
loop: {rate: 100}
joint_defaults: {bus: main, model: XM430-W350, reference: 180 deg, direction: 1}
joints: {j1: {id: 1}, j2: {id: 2}, j3: {id: 3}}
controllers:
"""


@dataclass(frozen=True)
class Entry:
    """A controller as it is written."""

    name: str
    joints: Sequence[str] = ()
    command: Sequence[str] = ()
    exports: Sequence[str] = ()
    into: Sequence[str] = ()
    reads: Sequence[str] = ()
    every: int = 1
    active: bool = True

    def line(self, steps: int) -> str:
        lists = {name: getattr(self, name) for name in ("joints", "command", "exports", "into", "reads")}
        words = [f"{key}: [{', '.join(names)}]" for key, names in lists.items() if names]
        words += [f"rate: {RATE / self.every:g}", f"active: {str(self.active).lower()}"]
        return f"  {self.name}: {{type: part, steps: {steps}, {', '.join(words)}}}\n"


Graph = list[Entry]


def some(chance: random.Random, items: Sequence[str], least: int = 0, most: int = 3) -> tuple[str, ...]:
    return tuple(chance.sample(items, chance.randint(least, max(least, min(most, len(items))))))


def draw_graph(chance: random.Random) -> Graph:
    """Draw the lower ends first, each upper one on what is exported and free."""
    graph: Graph = []
    free = list(JOINTS)
    names = [f"{joint}/{state}" for joint in JOINTS for state in STATES]
    for name in "abcde"[: chance.randint(1, 5)]:
        one = draw_upper(chance, name, graph) if chance.random() < 0.75 else None
        if one is None and free:
            joints = some(chance, free, 1)
            free = [joint for joint in free if joint not in joints]
            one = Entry(name, joints, chance.choice(SERVO_COMMANDS))
        one = one or Entry(name, some(chance, JOINTS))
        below = [each for each in graph if each.name in one.into]
        every = int(np.lcm.reduce([each.every for each in below] or [chance.choice((1, 1, 2))]))
        references = [
            f"{each.name}/{row}/{kind}" for each in graph for row in each.joints for kind in each.exports
        ]
        one = replace(
            one,
            exports=some(chance, INTERFACES),
            reads=some(chance, names, most=1) + some(chance, references, most=2),
            every=every * chance.choice((1, 1, 2)),
            active=chance.random() < 0.85 and all(each.active for each in below),
        )
        graph.append(one)
    chance.shuffle(graph)
    return graph


def draw_upper(chance: random.Random, name: str, graph: Graph) -> Entry | None:
    """Draw a controller that commands one or two others, if any exports what no other one commands."""
    lows = [one for one in graph if one.exports and one.joints]
    chosen = chance.sample(lows, min(len(lows), chance.choice((1, 1, 2))))
    shared = [each for each in INTERFACES if all(each in low.exports for low in chosen)]
    if (
        not chosen
        or not shared
        or len({*chosen[0].joints, *chosen[-1].joints}) < sum(len(one.joints) for one in chosen)
    ):
        return None
    command = some(chance, shared, 1)
    joints: list[str] = []
    for low in list(chosen):
        others = [one for one in graph if low.name in one.into and set(one.command) & set(command)]
        left = [joint for joint in low.joints if not any(joint in one.joints for one in others)]
        if not left:
            return None
        joints += some(chance, left, 1)
    chance.shuffle(joints)
    return Entry(name, joints, command, into=[low.name for low in chosen])


def mistakes(one: Entry, low: Entry) -> dict[str, Entry]:
    """Return a controller that commands another one, or that one, with each mistake, by its sentence."""
    return {
        r"`into` of \w+ names an unknown controller z$": replace(one, into=[*one.into, "z"]),
        r"`into` of (\w+) names \1 itself$": replace(one, into=[*one.into, one.name]),
        r"`into` of \w+ names \w+ twice$": replace(one, into=[*one.into, low.name]),
        r"`into` of \w+ names .*, but \w+ has no commands$": replace(one, command=()),
        r"`into` of \w+ names (\w+), but \1 exports no reference$": replace(low, exports=()),
        r"^the rate of .* does not divide the rate of ": replace(low, every=5),
        r" reads z/j1/position, but z is not a controller$": replace(one, reads=["z/j1/position"]),
    }


def order_of(graph: Graph) -> Graph | None:
    """Return the order of updates: again and again the first of the file that waits for none.

    A controller waits for those that command it, and for those that command what it reads.
    """
    left, order = list(graph), []
    while left:
        waiting = {low for one in left for low in one.into}
        read = {(one.name, name.split("/")[0]) for one in left for name in one.reads if name.count("/") == 2}
        waiting |= {name for name, low in read for upper in left if low in upper.into and upper.name != name}
        ready = [one for one in left if one.name not in waiting]
        if not ready:
            return None
        left.remove(ready[0])
        order.append(ready[0])
    return order


def errors_of(path: Path) -> list[str]:
    try:
        compile_files(path, {}, ())
    except InputError as error:
        return [problem.what for problem in error.problems if problem.severity == "error"]
    return []


class Model:
    """What every controller of a right graph commands, cycle by cycle."""

    def __init__(self, order: Graph, own: dict[str, int]) -> None:
        self.order, self.own = [one for one in order if one.active], own
        self.updates = Counter[str]()
        self.commanded: dict[tuple[str, str, str], float] = {}
        """By name, joint and interface"""
        self.read: dict[str, list[list[float]]] = {one.name: [] for one in self.order}

    def value(self, commanding: Graph, joint: str, interface: str) -> float:
        """Return what the only one of some controllers that has a joint commands of it; NaN: none."""
        having = [one.name for one in commanding if joint in one.joints and interface in one.command]
        assert len(having) < 2, "two command one thing"
        return self.commanded.get((having[0], joint, interface), np.nan) if having else np.nan

    def reference(self, name: str, joint: str, interface: str) -> float:
        return self.value([one for one in self.order if name in one.into], joint, interface)

    def servo(self, joint: str, interface: str) -> float:
        return self.value([one for one in self.order if not one.into], joint, interface)

    def cycle(self, cycle: int) -> None:
        """Update everything that is due."""
        for one in self.order:
            if cycle % one.every:
                continue
            self.updates[one.name] += 1
            references = [name for name in one.reads if name.count("/") == 2]
            self.read[one.name].append([self.reference(*name.split("/")) for name in references])
            for joint in one.joints:
                for each in one.command:
                    above = self.reference(one.name, joint, each) if each in one.exports else np.nan
                    own = self.own[one.name] * (1 + self.updates[one.name] * 1e-8) * UNITS[each]
                    self.commanded[one.name, joint, each] = own + (0.0 if np.isnan(above) else above)


def goals_of(robot: VirtualRobot) -> dict[tuple[str, str], list[int]]:
    """Return the goals that each servo was sent, by joint and interface, from the ledger."""
    found: dict[tuple[str, str], list[int]] = {}
    for sent in taken_apart(robot.ledger.entries, 2.0):
        for servo, address, data in writes(sent, 2.0):
            for interface, (first, form) in ADDRESSES.items():
                if address <= first and first + struct.calcsize(form) <= address + len(data):
                    (value,) = struct.unpack_from(form, data, first - address)
                    found.setdefault((f"j{servo}", interface), []).append(value)
    return found


def judge_run(graph: Graph, model: Model, path: Path, read: dict[str, list[np.ndarray]]) -> None:
    """Run a graph, and compare each cycle's commands and what is on the wire with the model."""
    robot = VirtualRobot(compile_files(path, {}, (), CYCLES * 10**9 // RATE).plan)
    places = {one.name: place for place, one in enumerate(graph)}

    def ran(cycles: int, _: int) -> None:
        model.cycle(cycles - 1)
        assert robot.record.active == sum(1 << places[one.name] for one in model.order)
        for row, joint in enumerate(JOINTS):
            for interface in INTERFACES:
                commanded = getattr(robot.record.commands, interface)[row]
                expected = model.servo(joint, interface)
                assert commanded == pytest.approx(expected, rel=1e-12, abs=0, nan_ok=True), (joint, interface)

    robot.sinks.progress = ran
    result = robot.run()
    assert (result.detail, result.cycles) == ("", CYCLES)
    for one in model.order:
        columns = [at for at, name in enumerate(one.reads) if name.count("/") == 2]
        seen = [row[columns] for row in read[one.name]]
        np.testing.assert_allclose(seen, model.read[one.name], rtol=1e-12)
    for (joint, interface), goals in goals_of(robot).items():
        expected = model.servo(joint, interface)
        if np.isnan(expected) or (interface == "velocity" and not np.isnan(model.servo(joint, "position"))):
            continue  # what a servo is sent at its start-up and at its end
        moved = [goal - (2048 if interface == "position" else 0) for goal in goals]
        last = round(expected / UNITS[interface])
        assert last in moved, f"{joint} was never sent what its end controller commands"
        rising = moved[: moved.index(last)]
        assert rising == sorted(rising), "two command one servo in turn"
        assert 0 <= min(moved) <= max(moved) <= last


@campaign(ci=50, night=1000, release=10_000)
@pytest.mark.timeout(120)
def test_a_graph_runs_as_it_is_drawn_or_is_refused_for_its_reason(
    part_plugins, amount: float, chance: random.Random
) -> None:
    path = Path("robot.yaml")
    outcomes = Counter[str]()
    for _ in range(int(amount)):
        graph = draw_graph(chance)
        own = {one.name: 1 << place for place, one in enumerate(graph)}
        path.write_text(ROBOT + "".join(one.line(own[one.name]) for one in graph))
        order = order_of(graph)
        if order is None:
            assert all("each other" in one for one in errors_of(path)), path.read_text()
            outcomes["circle"] += 1
        else:
            assert errors_of(path) == [], path.read_text()
            judge_run(graph, Model(order, own), path, part_plugins)
            outcomes["accepted"] += 1
        pairs = [(one, low) for one in graph for low in graph if low.name in one.into]
        if not pairs:
            continue
        sentence, wrong = chance.choice([*mistakes(*chance.choice(pairs)).items()])
        graph = [wrong if one.name == wrong.name else one for one in graph]
        path.write_text(ROBOT + "".join(one.line(own[one.name]) for one in graph))
        assert any(re.search(sentence, one) for one in errors_of(path)), path.read_text()
        outcomes["refused"] += 1
    assert outcomes["accepted"] > amount / 2
    assert outcomes["refused"] > amount / 4
