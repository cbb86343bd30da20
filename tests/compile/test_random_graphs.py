"""Random graphs: each accepted one runs as it is drawn, each refused one is refused for the reason there is.

CI takes 50. The full campaign before a release:

    pytest --campaign=release tests/compile/test_random_graphs.py

What is right or wrong, the order, and what reaches the servos are computed here again, from the lists that
the robot file is written from, by brute force and without a line of the runtime's graph.
"""

from __future__ import annotations

import random
import re
import struct
from collections import Counter
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, seed, settings
from hypothesis import given as given_
from hypothesis import strategies as st
from tests.kit.campaigns import campaign
from tests.kit.wire import taken_apart, writes

from dxlrun.compile.robot_compiler import compile_files
from dxlrun.control.controllers.claims import ControllerSnapshot
from dxlrun.control.controllers.update_order import above
from dxlrun.errors import InputError
from dxlrun.plan.loop_plan import ControllerPlan
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
joints:
  j1: {bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: 1}
  j2: {bus: main, id: 2, model: XM430-W350, reference: 180 deg, direction: 1}
  j3: {bus: main, id: 3, model: XM430-W350, reference: 180 deg, direction: 1}
controllers:
"""


@dataclass(frozen=True)
class One:
    """A controller as it is written."""

    name: str
    joints: tuple[str, ...] = ()
    command: tuple[str, ...] = ()
    exports: tuple[str, ...] = ()
    into: tuple[str, ...] = ()
    reads: tuple[str, ...] = ()
    every: int = 1
    active: bool = True
    fallback: str = ""

    def line(self, steps: int) -> str:
        """Return its line in the file."""
        lists = {"joints": self.joints, "command": self.command, "exports": self.exports, "reads": self.reads}
        words = [f"{key}: [{', '.join(names)}]" for key, names in lists.items()]
        if self.into:
            names = ", ".join(self.into)
            words.append(f"into: {names}" if len(self.into) == 1 else f"into: [{names}]")
        if self.every > 1:
            words.append(f"rate: {RATE / self.every:g}")
        if not self.active:
            words.append("active: false")
        if self.fallback:
            words.append(f"fallback: {self.fallback}")
        return f"  {self.name}: {{type: part, steps: {steps}, {', '.join(words)}}}\n"


Graph = list[One]


# Graphs: right ones, of which some are broken afterwards


@st.composite
def graphs(draw: st.DrawFn) -> Graph:
    """Draw the lower ends first, each upper one on what is exported and free, and then some changes."""
    made: Graph = []
    free = list(JOINTS)
    for number in range(draw(st.integers(1, 5))):
        name = "abcde"[number]
        every = draw(st.sampled_from((1, 1, 1, 2, 4)))
        exports = tuple(draw(st.lists(st.sampled_from(INTERFACES), max_size=3, unique=True)))
        if made and draw(st.integers(0, 3)):
            one = draw(_upper(name, made))
        elif free:
            joints = tuple(draw(st.lists(st.sampled_from(free), min_size=1, unique=True)))
            free = [joint for joint in free if joint not in joints]
            one = One(name, joints, draw(st.sampled_from(SERVO_COMMANDS)))
        else:
            one = One(name, tuple(draw(st.lists(st.sampled_from(JOINTS), unique=True))))
        below = [each for each in made if each.name in one.into]
        if below:
            every = np.lcm.reduce([each.every for each in below]) * draw(st.sampled_from((1, 1, 2)))
        reads = tuple(draw(st.lists(_readable(made), max_size=2)))
        active = draw(st.integers(0, 5)) > 0 and all(each.active for each in below)
        made.append(replace(one, exports=exports, every=int(every), reads=reads, active=active))
    if draw(st.integers(0, 3)) == 0:
        joints = tuple(draw(st.lists(st.sampled_from(JOINTS), min_size=1, unique=True)))
        at = draw(st.integers(0, len(made) - 1))
        made[at] = replace(made[at], fallback="f")
        made.append(One("f", joints, ("position",), active=False))
    for _ in range(draw(st.sampled_from((0, 0, 1, 1, 2)))):
        made = draw(_changed(made))
    return list(draw(st.permutations(made)))


@st.composite
def _upper(draw: st.DrawFn, name: str, made: Graph) -> One:
    """Draw a controller above one or two others, if any exports what is left."""
    lowers = [one for one in made if one.exports and one.joints]
    if not lowers:
        return One(name, tuple(draw(st.lists(st.sampled_from(JOINTS), unique=True))))
    chosen = draw(st.lists(st.sampled_from(lowers), min_size=1, max_size=2, unique_by=lambda one: one.name))
    shared = [each for each in INTERFACES if all(each in one.exports for one in chosen)]
    if not shared:
        chosen = chosen[:1]
        shared = list(chosen[0].exports)
    command = tuple(draw(st.lists(st.sampled_from(shared), min_size=1, unique=True)))
    joints: list[str] = []
    into: list[str] = []
    for one in chosen:
        taken = {j for u in made if one.name in u.into and set(u.command) & set(command) for j in u.joints}
        left = [joint for joint in one.joints if joint not in taken and joint not in joints]
        others = {
            j for two in chosen if two is not one and set(command) <= set(two.exports) for j in two.joints
        }
        left = [joint for joint in left if joint not in others]
        if left:
            joints += draw(st.lists(st.sampled_from(left), min_size=1, unique=True))
            into.append(one.name)
    return One(name, tuple(draw(st.permutations(joints))), command if into else (), into=tuple(into))


def _readable(made: Graph) -> st.SearchStrategy[str]:
    names = [f"{joint}/{state}" for joint in JOINTS for state in STATES]
    references = [
        f"{one.name}/{joint}/{each}" for one in made for joint in one.joints for each in one.exports
    ]
    return st.sampled_from(names) | st.sampled_from(references or names)


@st.composite
def _changed(draw: st.DrawFn, made: Graph) -> Graph:
    """Change one thing of one controller; the graph may be right all the same."""
    at = draw(st.integers(0, len(made) - 1))
    one = made[at]
    names = [*(each.name for each in made), "z"]
    interfaces = st.lists(st.sampled_from(INTERFACES), max_size=3, unique=True).map(tuple)
    commands = interfaces if one.into else st.sampled_from(SERVO_COMMANDS)
    joints = st.lists(st.sampled_from(JOINTS), max_size=3, unique=True).map(tuple)
    reads = st.sampled_from(
        "j1 j9/position j1/pwm a/position z/j1/position a/j1/position b/j2/effort a/b/c/d".split()  # noqa: SIM905
    )
    changes: list[dict[str, st.SearchStrategy[object]]] = [
        {"into": st.lists(st.sampled_from(names), max_size=3).map(tuple)},
        {"into": st.sampled_from(names).map(lambda name: (*one.into, name))},
        {"command": commands},
        {"exports": interfaces},
        {"joints": joints},
        {"active": st.booleans()},
        {"every": st.sampled_from((1, 2, 4, 5))},
        {"fallback": st.sampled_from(names)},
        {"fallback": st.sampled_from(names), "active": st.just(True)},
        {"reads": reads.map(lambda name: (*one.reads, name))},
    ]
    change = draw(st.sampled_from(changes))
    new = replace(one, **{key: draw(values) for key, values in change.items()})
    if not new.into and new.command not in {(), *SERVO_COMMANDS}:
        new = replace(new, command=("position",))  # how interfaces go together on a servo is tested elsewhere
    return [*made[:at], new, *made[at + 1 :]]


# The reference: what is wrong, in which order, and what is commanded


def reach(graph: Graph, name: str) -> set[str]:
    """Return all below a controller, by `into` alone."""
    found: set[str] = set()
    for _ in graph:
        found |= {low for one in graph if one.name in {name, *found} for low in one.into}
    return found & {one.name for one in graph}


def lower_of(graph: Graph, one: One, joint: str) -> list[One]:
    """Return the controllers that take what a controller commands of a joint."""
    return [
        low
        for low in graph
        if low.name in one.into
        and low is not one
        and joint in low.joints
        and set(one.command) <= set(low.exports)
    ]


def claims(graph: Graph, one: One) -> set[tuple[str, ...]]:
    """Return what only one active controller may have: servos, and references of others."""
    if not one.command:
        return set()
    if not one.into:
        return {(joint,) for joint in one.joints}
    return {
        (low.name, joint, each)
        for joint in one.joints
        for low in lower_of(graph, one, joint)
        for each in one.command
    }


def clashes(graph: Graph, names: set[str]) -> set[frozenset[str]]:
    """Return the pairs among some controllers that claim the same."""
    return {
        frozenset((one.name, two.name))
        for one, two in combinations([one for one in graph if one.name in names], 2)
        if claims(graph, one) & claims(graph, two)
    }


def steps(graph: Graph) -> set[tuple[str, str]]:
    """Return what is updated before what."""
    names = {one.name for one in graph}
    down = {(one.name, low) for one in graph for low in one.into if low in names}
    read = {
        (upper, one.name)
        for one in graph
        for interface in one.reads
        if interface.count("/") == 2
        for upper, low in down
        if low == interface.split("/")[0] and upper != one.name
    }
    return down | read


def reasons(graph: Graph) -> set[str]:
    """Return why a graph is refused, as words; empty: it is right."""
    named = {one.name: one for one in graph}
    found: set[str] = set()
    together: set[frozenset[str]] = set()
    for one in graph:
        lows = [named[low] for low in one.into if low in named and low != one.name]
        for index, low in enumerate(one.into):
            found |= {"self"} if low == one.name else {"unknown"} if low not in named else set()
            if low in one.into[:index] and low in named and low != one.name:
                found.add("twice")
        found |= {"inactive" for low in lows if one.active and not low.active}
        found |= {"rate" for low in lows if one.every % low.every}
        found |= {"reads" for interface in one.reads if not readable(graph, interface)}
        if one.into:
            together |= (pairs := clashes(graph, {one.name, *reach(graph, one.name)}))
            found |= {"together"} if pairs else set()
            found |= into_reasons(one, lows, all(low in named for low in one.into))
        if one.fallback:
            found |= fallback_reasons(graph, one)
    ways = steps(graph)
    for _ in graph:
        ways |= {(a, d) for a, b in ways for c, d in ways if b == c}
    if any((b, a) in ways for a, b in ways if a != b):
        found.add("circle")
    active = {one.name for one in graph if one.active}
    if clashes(graph, active) - together:
        found.add("both active")
    return found


def into_reasons(one: One, lows: list[One], known: bool) -> set[str]:
    """Return what is wrong between a controller and those that it is into."""
    if not one.command:
        return {"commands nothing"}
    found = {"mute" for low in lows if not (low.exports and low.joints)}
    lows = [low for low in {low.name: low for low in lows}.values() if low.exports and low.joints]
    if not known or not lows:
        return found
    for joint in one.joints:
        there = [low for low in lows if joint in low.joints]
        whole = [low for low in there if set(one.command) <= set(low.exports)]
        found |= {"not exported"} if not there else {"interface"} if not whole else set()
        found |= {"double"} if len(whole) > 1 else set()
    if "not exported" not in found and any(not set(low.joints) & set(one.joints) for low in lows):
        found.add("idle")
    return found


def readable(graph: Graph, interface: str) -> bool:
    """Return whether there is such an interface."""
    names = {f"{joint}/{state}" for joint in JOINTS for state in STATES}
    names |= {f"{one.name}/{joint}/{each}" for one in graph for joint in one.joints for each in one.exports}
    return interface in names


def fallback_reasons(graph: Graph, one: One) -> set[str]:
    """Return why a fallback could not take over."""
    named = {each.name: each for each in graph}
    other = named.get(one.fallback)
    if other is None:
        return {"fallback unknown"}
    entering = {other.name, *reach(graph, other.name)}
    if other is one or one.name in entering:
        return {"fallback itself" if other is one else "fallback above"}
    if not (one.active and not other.active):
        return {"fallback active"} if one.active else set()
    staying = {
        each.name for each in graph if each.active and one.name not in {each.name, *reach(graph, each.name)}
    }
    used = {low for name in staying for low in reach(graph, name)}
    unused = {
        low
        for low in reach(graph, one.name) - used
        if not any(low in reach(graph, each.name) for each in graph if each.name in staying)
    }
    staying -= unused - entering
    for pair in clashes(graph, staying | entering):
        if pair & entering and pair - entering:
            return {"fallback claims"}
    return set()


SENTENCES = {
    "self": r"`into` of \w+ names \w+ itself$",
    "unknown": r"`into` of \w+ names an unknown controller \w+$",
    "twice": r"`into` of \w+ names \w+ twice$",
    "commands nothing": r"`into` of \w+ names .*, but \w+ has no commands$",
    "mute": r"`into` of \w+ names (\w+), but \1 exports no reference$",
    "not exported": r" commands j\d(, j\d)*, but [\w, ]+ (does|do) not export (it|them)$",
    "interface": r" commands [\w ]+ of [\w, ]+, but \w+ does not export (it|them)$",
    "double": r" is exported by \w+ and ",
    "idle": r"`into` of (\w+) names (\w+), but \2 exports no joint of \1$",
    "inactive": r"(\w+) commands \w+, but only \1 is active from the start$",
    "rate": r"^the rate of .* does not divide the rate of ",
    "reads": r" reads .*, but ",
    "together": r"^the chains .* both command ",
    "circle": r"^controllers (command|depend on) each other.*: \w+( -> \w+)+$",
    "both active": r" are both active and both (claim|command) ",
    "fallback unknown": r"^the fallback \w+ of \w+ is not a controller of the robot$",
    "fallback itself": r" is its own fallback$",
    "fallback above": r"^the fallback \w+ of (\w+) commands the failed \1 ",
    "fallback active": r"^the fallback .* is active from the start$",
    "fallback claims": r"^the fallback .* claims joints of the active ",
}


def reason_of(sentence: str) -> str:
    """Return which of the reasons a sentence gives."""
    (reason,) = [reason for reason, pattern in SENTENCES.items() if re.search(pattern, sentence)]
    return reason


def reasons_given(path: Path) -> set[str]:
    """Return why a file is refused, by what the compiler says."""
    try:
        compile_files(path, {}, ())
    except InputError as error:
        return {reason_of(problem.what) for problem in error.problems if problem.severity == "error"}
    return set()


def order_of(graph: Graph) -> list[One]:
    """Return the order of updates: again and again the first of the file that waits for none."""
    left, ways, order = list(graph), steps(graph), []
    while left:
        names = {one.name for one in left}
        first = next(one for one in left if not any(b == one.name and a in names for a, b in ways))
        left.remove(first)
        order.append(first)
    return order


Values = dict[tuple[str, str, str], float]
"""What a controller commands: by name, joint, interface; the name is empty for what reaches a servo."""


class Model:
    """What every controller of a right graph commands, cycle by cycle."""

    def __init__(self, graph: Graph, own: dict[str, int]) -> None:
        self.graph, self.own = graph, own
        self.order = [one for one in order_of(graph) if one.active]
        self.updates = Counter[str]()
        self.commanded: Values = {}
        self.read: dict[str, list[list[float]]] = {one.name: [] for one in self.order}

    def reference(self, name: str, joint: str, interface: str) -> float:
        """Return what the one that commands a reference has commanded; NaN where there is none."""
        values = [
            self.commanded.get((upper.name, joint, interface), np.nan)
            for upper in self.order
            if (name, joint, interface) in claims(self.graph, upper)
        ]
        assert len(values) < 2, "two command one reference"
        return values[0] if values else np.nan

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

    def servo(self, joint: str, interface: str) -> float:
        """Return what reaches a servo; NaN where there is nothing."""
        ends = [one for one in self.order if (joint,) in claims(self.graph, one)]
        assert len(ends) < 2, "two command one servo"
        return self.commanded.get((ends[0].name, joint, interface), np.nan) if ends else np.nan


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


def require_takeovers(plans: tuple[ControllerPlan, ...]) -> None:
    """Require of an accepted file that each fallback of what is active from the start can take over."""
    known = {plan.name: plan for plan in plans}
    active = {name: plan for name, plan in known.items() if plan.active}
    for name, plan in active.items():
        if plan.fallback:
            taken = [*above(plans, name), name]
            staying = {each: one for each, one in active.items() if each not in taken}
            assert ControllerSnapshot(known, staying).fall_back(plan.fallback, taken, {name}), (
                f"{plan.fallback} of {name}"
            )


# The campaign


def judge_run(graph: Graph, path: Path, own: dict[str, int], read: dict[str, list[np.ndarray]]) -> None:
    """Run a graph, and compare each cycle's commands and what is on the wire with the model."""
    plan = compile_files(path, {}, (), CYCLES * 10**9 // RATE).plan
    require_takeovers(plan.loop.controllers)
    robot, model = VirtualRobot(plan), Model(graph, own)
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
            continue  # what a servo is told at its start-up and at its end
        moved = [goal - (2048 if interface == "position" else 0) for goal in goals]
        last = round(expected / UNITS[interface])
        assert last in moved, f"{joint} was never sent what its end controller commands"
        assert moved[: moved.index(last)] == sorted(moved[: moved.index(last)]), (
            "two command one servo in turn"
        )
        assert 0 <= min(moved) <= max(moved) <= last


@campaign(ci=50, night=1000, release=10_000)
@pytest.mark.timeout(120)
def test_a_graph_runs_as_it_is_drawn_or_is_refused_for_its_reason(
    part_plugins, amount: float, chance: random.Random
) -> None:
    path = Path("robot.yaml")
    outcomes = Counter[str]()

    @seed(chance.getrandbits(64))
    @settings(
        max_examples=int(amount),
        deadline=None,
        phases=[Phase.generate],  # a smaller find would take some hundred runs more
        suppress_health_check=list(HealthCheck),
    )
    @given_(graphs())
    def judge(graph: Graph) -> None:
        own = {one.name: 1 << place for place, one in enumerate(graph)}
        path.write_text(ROBOT + "".join(one.line(own[one.name]) for one in graph))
        expected = reasons(graph)
        given = reasons_given(path)
        assert given == expected, path.read_text()
        outcomes.update([*given, "refused" if given else "accepted"])
        if given:
            return
        judge_run(graph, path, own, part_plugins)
        deepest = max(len(reach(graph, one.name)) for one in graph)
        outcomes[f"accepted, {deepest} below"] += 1

    judge()
    assert outcomes["accepted"] > amount / 5
    assert outcomes["refused"] > amount / 10
    if amount >= 10_000:  # some are rare
        assert set(SENTENCES) <= set(outcomes)
