"""Judge of a run with faults: what failures.md promises, held against the simulated buses' own ledger.

1 every byte sent is a legal instruction; 2 no goal outside the limits, no step over the maximum; 3 no
torque-on without a look at the servo first, and neither torque nor goals for a joint that a client let go;
4 each recorded sample is what that servo sent in that cycle; 5 the log has every byte; 6 each accepted
command has a known client and is in the log; 7 each fault that no run bears in silence leaves an event of
its servo or bus, and no event is without a cause; 8 no servo that is reached keeps torque.

The packets are taken apart by wire.py, which has its own addresses and units and nothing of the host's.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.kit.judges import log_has_every_byte, uncaused, unnoticed
from tests.kit.wire import (
    FACTS,
    READ,
    Instruction,
    StateReply,
    angle,
    data_of,
    instructions,
    stands_at,
    states,
    written,
)

from dxlrun.channels.event_records import EventCode
from dxlrun.errors import DxlrunError
from dxlrun.log.log_reader import Log
from dxlrun.testing import VirtualRobot
from dxlrun_analysis.conduct.client_commands import client_commands
from dxlsim.bus.ledger import LedgerEntry
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.script import FaultScript
from dxlsim.servo.simulated_servo import SimulatedServo
from dxlwire.bus_plan import BusPlan

MS = 1_000_000
SOME_CYCLES = 100
"""In so many cycles a servo answers and gets a goal, or there was nothing to judge."""
LATEST = 2
"""Cycles; see `samples_are_what_was_sent`."""
REPLY_NS = 2 * MS
"""No servo here needs longer for an answer: 500 us of return delay and some 20 bytes at 1 Mbit/s."""
SOON_NS = 2_000_000_000
"""Within this time a fault that can be seen is reported."""
BUMP = 0.1
"""rad: so near to where the servo is lies the goal with which it gets its torque again."""
ROUNDING = 1e-9
"""rad, between two orders of the same arithmetic; a tick of an XM430 is 1.5e-3."""
UNDER_WAY_NS = 500 * MS
"""What idle time had begun for a servo when a request came has ended by then."""
IDENTITY = 6
"""An item that begins before this address identifies a servo: model number, firmware, ID."""


@dataclass
class Witness:
    """Sees what the bytes of one bus do not show: servos with torque, every 2 ms, and what was held back."""

    bus: SimulatedBus
    torque: dict[object, int] = field(default_factory=dict)
    found: list[tuple[int, int, float]] = field(default_factory=list)
    """When a servo's torque enable went from 0 to 1, its ID, and where it was, rad from its raw 0."""
    delayed: list[StateReply] = field(default_factory=list)
    """Replies that a fault held back, and since when each is on its way again."""

    def __post_init__(self) -> None:
        bus = self.bus
        alter_next = bus.alter_next

        def seen(servo_id: int, text: str, change: Any, *, delay_ns: int = 0, copies: int = 1) -> None:
            def held_back(reply: bytes) -> bytes:
                if delay_ns:
                    data = data_of(reply, bus.protocol)
                    self.delayed.append(StateReply(bus.now_ns + delay_ns, servo_id, data, bus.now_ns))
                return bytes(change(reply))

            alter_next(servo_id, text, held_back, delay_ns=delay_ns, copies=copies)

        bus.alter_next = seen  # type: ignore[method-assign]
        bus.at(0, self.look)

    def look(self) -> None:
        bus = self.bus
        for servo in alone(bus):
            torque = servo.registers["torque_enable"]
            if torque and not self.torque.get(servo, 0):
                self.found.append((bus.now_ns, servo.servo_id, servo.shaft_angle))
            self.torque[servo] = torque
        bus.at(bus.now_ns + 2 * MS, self.look)


def servos(
    directory: Path, lines: Mapping[str, tuple[float, int]], *, limits: str = "", more: str = ""
) -> Path:
    """Write the file of a robot whose buses have a protocol and so many servos each; `more` follows it."""
    models = {1.0: ("AX-12A", 150), 2.0: ("XM430-W350", 180)}
    buses, joints = [], []
    for bus, (protocol, count) in lines.items():
        model, middle = models[protocol]
        line = f"port: sim, protocol: {protocol}, baud_rate: 1_000_000, return_delay_time: 100 us"
        buses.append(f"  {bus}: {{{line}}}")
        for number in range(len(joints) + 1, len(joints) + 1 + count):
            placed = f"bus: {bus}, id: {number}, model: {model}, reference: {middle} deg"
            direction = -1 if limits and number % 2 == 0 else 1
            joints.append(f"  j{number}: {{{placed}, direction: {direction}{limits}}}")
    path = directory / "servos.yaml"
    path.write_text(
        "\n".join(["name: servos", "loop: {rate: 50}", "buses:", *buses, "joints:", *joints, more])
    )
    return path


def alone(bus: SimulatedBus) -> list[SimulatedServo]:
    """Return the servos whose ID no other servo has: of two, one answers and the other obeys, unseen."""
    ids = [servo.servo_id for servo in bus.servos]
    return [servo for servo in bus.servos if ids.count(servo.servo_id) == 1]


@dataclass
class Trial:
    """A robot in a storm, and what is seen of it from outside."""

    robot: VirtualRobot
    faults: FaultScript
    witnesses: list[Witness]
    refusal: tuple[str, ...] = ()
    """The sentences of a start that failed; empty: it went well."""

    @classmethod
    def of(cls, robot: VirtualRobot, faults: Sequence[str]) -> Trial:
        """Plan the faults on a robot that has not run yet, and look on."""
        witnesses = [Witness(bus) for bus in robot.buses]
        script = FaultScript([parse_fault(fault) for fault in faults])
        script.attach(robot.buses)
        return cls(robot, script, witnesses)

    def run(self) -> bool:
        """Run the robot to its end; return whether its start went well."""
        try:
            self.robot.run()
        except DxlrunError as error:
            self.refusal = error.sentences
        return not self.refusal

    @property
    def torque_was_given(self) -> bool:
        """True when any servo got torque."""
        return any(witness.found for witness in self.witnesses)

    def judge(self, log: Log) -> None:
        """Hold everything against the ledger, after a failed start too."""
        entries = self.robot.ledger.entries
        for number, (bus, witness) in enumerate(zip(self.robot.plan.buses, self.witnesses, strict=True)):
            mine = [entry for entry in entries if entry.bus == bus.name]
            sent = list(instructions(mine, bus))
            replies = list(states(mine, bus))
            goals_are_within_limits(sent, bus, self.robot)
            no_servo_wakes_without_a_look(sent, witness, bus, log)
            no_joint_wakes_that_was_let_go(sent, bus, log)
            if not self.refusal:
                samples_are_what_was_sent(replies, witness, bus, log)
            everybody_who_hears_is_limp(self.robot, number, (*self.robot.failures, *self.refusal))
        log_has_every_byte(log, entries)
        faults_and_events_answer_each_other(entries, log)


# Invariants 2 and 3


def goals_are_within_limits(sent: Sequence[Instruction], bus: BusPlan, robot: VirtualRobot) -> None:
    """No goal is beyond a limit, and none is further from the one before than the joint may go."""
    joints, period_ns = robot.plan.loop.joints, robot.plan.loop.period_ns
    before: dict[int, tuple[int, float]] = {}
    count = 0
    woken = {(t_ns, servo.servo_id) for t_ns, servo, on in written(sent, bus, "torque_enable") if on}
    last_on = dict.fromkeys((servo.servo_id for servo in bus.servos), -1)
    for t_ns, servo, raw in written(sent, bus, "goal_position"):
        goal, joint, tick = angle(servo, raw), joints[servo.row], FACTS[servo.model].rad_per_tick
        assert joint.lower - tick <= goal <= joint.upper + tick, (t_ns, joint.name)
        on_ns = max((at for at, one in woken if one == servo.servo_id and at <= t_ns), default=-1)
        if on_ns != last_on[servo.servo_id]:  # it was away meanwhile, and its goal is where it is
            last_on[servo.servo_id] = on_ns
            before.pop(servo.servo_id, None)
        if joint.velocity is not None and servo.servo_id in before:
            before_ns, last = before[servo.servo_id]
            # goals of two cycles are sent up to a period nearer to each other than the cycles begin
            most = joint.velocity * (t_ns - before_ns + period_ns) * 1e-9 + tick
            assert abs(goal - last) <= most, (t_ns, joint.name)
        before[servo.servo_id] = t_ns, goal
        count += 1
    assert count or robot.result is None or robot.result.cycles < SOME_CYCLES


def no_servo_wakes_without_a_look(
    sent: Sequence[Instruction], witness: Witness, bus: BusPlan, log: Log
) -> None:
    """After the set-up torque comes only by policy, to a servo that was looked at, and where it is."""
    started = [event.t_ns for event in log.events if event.code == EventCode.LOOP_STARTED]
    if not started:
        return
    by_id = {servo.servo_id: servo for servo in bus.servos}
    goals = list(written(sent, bus, "goal_position"))
    wanted = torque_requests(log)
    for t_ns, servo_id, shaft_rad in witness.found:
        if t_ns <= started[0] + 2 * MS:
            continue
        servo = by_id[servo_id]
        assert servo.torque_on_return or was_requested(wanted, servo.joint, t_ns), (t_ns, servo.joint)
        looks = [
            one
            for one in sent
            if t_ns - SOON_NS < one.t_ns <= t_ns
            and (one.servo_id, one.instruction) == (servo_id, READ)
            and one.parameters[0] < IDENTITY
        ]
        assert looks, (t_ns, servo.joint)
        goal = [raw for at_ns, one, raw in goals if one is servo and at_ns <= t_ns][-1]
        where = angle(servo, goal)
        assert abs(where - servo.direction * (shaft_rad - servo.reference)) < BUMP, (t_ns, servo.joint)
    asked = {(t_ns, servo.servo_id) for t_ns, servo, on in written(sent, bus, "torque_enable") if on}
    for t_ns, servo_id in asked:
        servo = by_id[servo_id]
        may = servo.torque_on_return or was_requested(wanted, servo.joint, t_ns)
        assert t_ns <= started[0] or may, (t_ns, servo_id)


@dataclass(frozen=True)
class TorqueRequest:
    """A request of a client that the loop accepted: torque off or on, or a reboot, which may give it back."""

    t_ns: int
    joint: str
    off: bool


def torque_requests(log: Log) -> list[TorqueRequest]:
    """Return what clients requested of each joint's torque, in order."""
    found = []
    for one in client_commands(log):
        command = one.command
        if command.for_loop and command.kind in {"torque", "reboot"} and not one.refusal:
            data = json.loads(command.data)
            off = command.kind == "torque" and not data["on"]
            found += [TorqueRequest(command.t_ns, joint, off) for joint in data["joints"]]
    return found


def was_requested(requests: Sequence[TorqueRequest], joint: str, t_ns: int) -> bool:
    """Return whether a client may have given a joint torque by now."""
    return any(one.joint == joint and not one.off and one.t_ns <= t_ns for one in requests)


def no_joint_wakes_that_was_let_go(sent: Sequence[Instruction], bus: BusPlan, log: Log) -> None:
    """From torque off on until the next torque on, no goal, and no torque but what was on its way.

    What had begun in idle time when the request came ends first: a change of a mode, torque on.
    """
    requests = torque_requests(log)
    goals = [(t_ns, servo.joint) for t_ns, servo, _ in written(sent, bus, "goal_position")]
    torque = [(t_ns, servo.joint) for t_ns, servo, on in written(sent, bus, "torque_enable") if on]
    for number, one in enumerate(requests):
        if not one.off:
            continue
        later = [two.t_ns for two in requests[number + 1 :] if two.joint == one.joint and not two.off]
        until = min(later, default=1 << 62)
        after = one.t_ns + UNDER_WAY_NS
        woken = [t_ns for t_ns, joint in [*goals, *torque] if joint == one.joint and after < t_ns < until]
        assert not woken, (one, woken)


# Invariant 4: each recorded sample equals what that servo sent in that cycle


def samples_are_what_was_sent(
    replies: Sequence[StateReply], witness: Witness, bus: BusPlan, log: Log
) -> None:
    """Look for each sample among the intact states of its cycle; what was asked for earlier is none.

    A limit of today's runtime: it knows a late reply by its length, and asks for three lengths in turn. One
    that is LATEST cycles late is always known; one that is later, on a line that keeps losing replies, may
    pass for current.
    """
    asked_ns = held_back(replies, witness.delayed)
    judged = {servo.servo_id for servo in alone(witness.bus)}
    at = 0
    valid = 0
    for number, cycle in enumerate(log.cycles):
        since_ns = int(log.cycles["woken_ns"][max(0, number - LATEST)])
        begin_ns = int(cycle["woken_ns"])
        while at < len(replies) and replies[at].t_ns < begin_ns:
            at += 1
        end = at
        while end < len(replies) and replies[end].t_ns <= cycle["read_ns"]:
            end += 1
        for servo in bus.servos:
            if not cycle["valid"][servo.row] or servo.servo_id not in judged:
                continue
            valid += 1
            sent = [
                stands_at(servo, each.data)
                for each in replies[at:end]
                if each.servo_id == servo.servo_id and not since_ns <= asked_ns.get(each, -1) < begin_ns
            ]
            recorded = float(cycle["position"][servo.row])
            assert any(abs(recorded - each) < ROUNDING for each in sent), (
                int(cycle["woken_ns"]),
                servo.joint,
            )
    assert valid or not judged or len(log.cycles) < SOME_CYCLES


def held_back(replies: Sequence[StateReply], delayed: Sequence[StateReply]) -> dict[StateReply, int]:
    """Return the states that a fault held back, and when the host had asked for each."""
    asked_ns: dict[StateReply, int] = {}
    for late in delayed:
        for each in replies:
            on_time = late.t_ns <= each.t_ns <= late.t_ns + REPLY_NS
            if on_time and (each.servo_id, each.data) == (late.servo_id, late.data):
                asked_ns[each] = late.asked_ns
                break  # a later one of the same bytes is a new one
    return asked_ns


# Invariant 8


def everybody_who_hears_is_limp(robot: VirtualRobot, number: int, sentences: Sequence[str]) -> None:
    """Look for torque after the end; a servo that did not confirm torque off is in a sentence of its own."""
    bus = robot.buses[number]
    bus.advance_to(robot.clock.now_ns())
    on = {servo.servo_id for servo in alone(bus) if servo.registers["torque_enable"]}
    replies = {
        servo.servo_id
        for servo in robot.plan.buses[number].servos
        if any(f"{servo.joint} (ID " in sentence and "torque off" in sentence for sentence in sentences)
    }
    assert on <= replies


# Invariant 7


def faults_and_events_answer_each_other(entries: Sequence[LedgerEntry], log: Log) -> None:
    """Look for the events of the faults that no run bears in silence, and for a fault behind each event."""
    missing = unnoticed(log, entries)
    assert not missing, missing
    causeless = uncaused(log, entries)
    assert not causeless, [(event.t_ns, event.name, event.source) for event in causeless]
