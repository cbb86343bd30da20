"""Random graphs of controllers, switched while some of them fail: the invariants of every cycle."""

import random

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit.campaigns import campaign
from tests.kit.loops import PERIOD_NS, Robot

from dxlrun.channels.answers import Code, Completion
from dxlrun.channels.event_records import EventCode
from dxlwire.modes import Mode

CYCLES = 40
LATE = (Code.RUN_ENDING, Code.MODE_NOT_ENTERED, Code.SWITCHED_AGAIN, Code.CONTROLLER_FAULT)
"""Refusals of a switch that was begun."""


class Node:
    """One controller of a random graph: it commands its references, else a number of its own."""

    def __init__(self, name, joints, command, into=(), reference=()):
        self.name, self.joints, self.command = name, joints, command
        self.into, self.reference = into, reference
        self.fallback, self.active = "", False
        self.own = 0.0
        self.raises = {}

    def act(self, controller, step, time_ns, _):
        cycle = round(time_ns / PERIOD_NS)
        if self.raises.get(cycle) == step:
            raise RuntimeError(f"at {cycle}")
        if step == "update" and self.command:
            values = controller.context.references.position
            mine = getattr(controller.context.commands, self.command)
            np.copyto(mine, np.where(np.isnan(values), self.own, values))


def random_graph(dice: random.Random, joints: tuple[str, ...]) -> list[Node]:
    """Return controllers in the order of a file: their ends may come in any order."""
    nodes: list[Node] = []
    for number in range(dice.randint(2, 8)):
        name = f"c{number}"
        exporters = [node for node in nodes if node.reference]
        if exporters and dice.random() < 0.65:
            into = dice.sample(exporters, min(len(exporters), dice.choice((1, 1, 2))))
            offered = [joint for node in into for joint in node.joints]
            able = [joint for joint in joints if offered.count(joint) == 1]
            if not able:
                continue
            chosen = tuple(dice.sample(able, dice.randint(1, len(able))))
            used = tuple(node.name for node in into if set(node.joints) & set(chosen))
            node = Node(name, chosen, "position", used)
        else:
            chosen = tuple(dice.sample(joints, dice.randint(1, len(joints))))
            node = Node(name, chosen, dice.choice(("position", "position", "effort")))
        if dice.random() < 0.6:
            node.reference = ("position",)
        node.own = 0.001 * (number + 1)
        nodes.append(node)
    for node in nodes:
        if dice.random() < 0.4:
            node.fallback = dice.choice([other.name for other in nodes if other is not node] or [""])
    named = {node.name: node for node in nodes}
    for node in dice.sample(nodes, len(nodes)):
        chain = with_below(node.name, named)
        running = {other.name for other in nodes if other.active}
        if dice.random() < 0.5 and clean(chain | running, named):
            for name in chain:
                named[name].active = True
    return dice.sample(nodes, len(nodes))


def with_below(name: str, named: dict[str, Node]) -> set[str]:
    return {name}.union(*(with_below(lower, named) for lower in named[name].into))


def above_of(name: str, named: dict[str, Node]) -> set[str]:
    return {other for other in named if other != name and name in with_below(other, named)}


def commanded(name: str, named: dict[str, Node]) -> list[tuple[str, str]]:
    """Return what a controller commands: servos (''), or references of others, by joint."""
    node = named[name]
    if not node.into:
        return [("", joint) for joint in node.joints]
    return [(low, joint) for low in node.into for joint in node.joints if joint in named[low].joints]


def clean(names: set[str], named: dict[str, Node]) -> bool:
    """Return whether these can be active together."""
    taken = [one for name in names for one in commanded(name, named)]
    return len(taken) == len(set(taken))


def value(name: str, joint: str, active: set[str], named: dict[str, Node]) -> float:
    """Return what a controller commands for a joint, from the top of its chain."""
    for upper in active:
        if (name, joint) in commanded(upper, named):
            return value(upper, joint, active, named)
    return named[name].own


class Judge:
    """Looks at every cycle of a run, and at every answer to a switch."""

    def __init__(self, robot, nodes):
        self.robot, self.named = robot, {node.name: node for node in nodes}
        self.order = [node.name for node in nodes]
        self.asked: dict[int, tuple[int, list[str], list[str]]] = {}
        self.waiting: set[int] = set()
        """Cycles at whose begin controllers wait for modes."""
        self.entered = self.refused = self.switched = 0

    def active(self, cycle: int) -> set[str]:
        if cycle < 0:
            return {name for name in self.order if self.named[name].active}
        mask = self.robot.sink.cycles[cycle]["active"]
        return {name for bit, name in enumerate(self.order) if mask >> bit & 1}

    def judge(self) -> None:
        faults = self.faults()
        answered: dict[int, list[int]] = {}
        for number, (cycle, _, _) in self.asked.items():
            answered.setdefault(cycle, []).append(number)
        before = self.active(-1)
        for cycle in range(len(self.robot.sink.cycles)):
            active = self.active(cycle)
            for name in active:
                assert set(self.named[name].into) <= active, (cycle, name)
            assert clean(active, self.named), (cycle, active)
            self.judge_values(cycle, active, cycle in faults)
            for name in set(faults.get(cycle, ())) - active:  # one that failed as it left may begin anew
                assert not (above_of(name, self.named) & active), (cycle, name)
            if cycle not in faults and cycle not in answered and cycle not in self.waiting:
                assert active == before, cycle
            before = active
        for number, (cycle, activate, deactivate) in self.asked.items():
            self.judge_answer(number, cycle, activate, deactivate, faults)

    def faults(self) -> dict[int, list[str]]:
        found: dict[int, list[str]] = {}
        for name, text in self.robot.events.of(EventCode.CONTROLLER_FAULT):
            found.setdefault(int(text.split(": at ")[1].split()[0]), []).append(name)
        return found

    def judge_values(self, cycle: int, active: set[str], fault: bool) -> None:
        """Everything that is commanded is commanded by one that is active, and by the top of its chain."""
        row = self.robot.sink.cycles[cycle]
        owned = {one: name for name in active for one in commanded(name, self.named)}
        for place, name in enumerate(self.robot.record.layout.references):
            lower, joint, _ = name.split("/")
            given = row["reference"][place]
            owner = owned.get((lower, joint))
            if owner is None:
                assert np.isnan(given), (cycle, name)
            elif not fault:
                assert given == value(owner, joint, active, self.named), (cycle, name)
        for place, joint in enumerate(self.robot.names):
            owner = owned.get(("", joint))
            for interface in ("position", "effort"):
                given = row[interface][place]
                if owner is None or self.named[owner].command != interface:
                    assert np.isnan(given), (cycle, joint)
                elif not fault:
                    assert given == value(owner, joint, active, self.named), (cycle, joint)

    def judge_answer(self, number, cycle, activate, deactivate, faults) -> None:
        answer = self.robot.inbox.answers.get(number)
        if not isinstance(answer, Completion):
            at_once = answer is not None and answer.code not in LATE
            self.refused += at_once
            if at_once and cycle not in faults and self.alone(number, cycle):
                assert self.active(cycle) == self.active(cycle - 1), (number, cycle)
            return
        self.switched += 1
        entered = answer.cycle
        if any(cycle <= at <= entered for at in faults) or not self.alone(number, entered):
            return
        active, was = self.active(entered), self.active(cycle - 1)
        assert set(activate) <= active, number
        chain = set().union(*(with_below(name, self.named) for name in activate))
        assert not (set(deactivate) - chain) & active, number
        if entered == cycle:
            assert active == (was - set(deactivate)) | chain, number
        else:
            self.entered += 1
            for name in activate:  # nothing of it before all of it
                assert not any(name in self.active(between) for between in range(cycle, entered)), number

    def alone(self, number: int, until: int) -> bool:
        """Return whether nothing else changes the cycles from its own to this one: no other switch, no group
        that waited before."""
        cycle = self.asked[number][0]
        others = [at for one, (at, _, _) in self.asked.items() if one != number]
        return not any(cycle <= at <= until for at in others) and cycle not in self.waiting


def storm(seed: int) -> Judge:
    """Run one random graph through random switches and faults, and judge every cycle of it."""
    dice = random.Random(seed)
    robot = Robot(joints=dice.randint(1, 4))
    nodes = random_graph(dice, robot.names)
    for node in nodes:
        robot.script(
            node.name,
            lambda self, step, time_ns, data, node=node: node.act(self, step, time_ns, data),
            joints=node.joints,
            command=(node.command,),
            into=node.into,
            reference=node.reference,
            active=node.active,
            fallback=node.fallback,
        )
        for _ in range(dice.choice((0, 0, 0, 1, 2))):
            node.raises[dice.randrange(CYCLES)] = dice.choice(("update", "update", "activate", "deactivate"))
    robot.build(end_ns=CYCLES * PERIOD_NS)
    for row, joint in enumerate(robot.names):  # as the start-up leaves them
        if any(node.active and node.command == "effort" and joint in node.joints for node in nodes):
            robot.record.states.mode[row] = Mode.EFFORT
    judge = Judge(robot, nodes)
    robot.hardware.mode_cycles = lambda: dice.choice((0, 0, 2, 5))

    def idle(deadline_ns, time_ns):
        cycle = len(robot.sink.cycles)
        if robot.manager.switching.groups:
            judge.waiting.add(cycle)
        if dice.random() < 0.25:
            names = [node.name for node in nodes]
            now = [name for name in names if robot.manager._named[name].active]
            activate = dice.sample(names, min(len(names), dice.choice((0, 1, 1, 2))))
            leave = now if dice.random() < 0.5 else names
            deactivate = dice.sample(leave, min(len(leave), dice.choice((0, 1, 2, len(leave)))))
            number = robot.ask("switch", activate=activate, deactivate=deactivate)
            judge.asked[number] = cycle, activate, deactivate

    robot.hardware.idle = idle
    robot.loop.run()
    judge.judge()
    return judge


@campaign(ci=120, night=1000, release=10_000)
@settings(deadline=None)
@given(seed=st.integers(0, 10**9))
def test_each_cycle_of_a_random_graph_keeps_the_invariants(seed):
    storm(seed)


def test_storms_have_switches_waits_refusals_and_faults():
    """Among some of them are switches that were done, that waited, that were refused, and fallbacks."""
    done = waited = refused = faults = 0
    for seed in range(40):
        judge = storm(seed)
        done, waited, refused = done + judge.switched, waited + judge.entered, refused + judge.refused
        faults += len(judge.faults())
    assert min(done, refused) > 60
    assert waited > 3
    assert faults > 10
