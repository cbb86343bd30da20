"""Start-up on one bus, as failures.md has it: look at everything first, then torque on in groups.

Programs of transactions; nothing here waits. What the robot file declares is written by `registers`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

from dxlrun.dynamixel.plan.bus_plan import BusPlan, RegisterValue, ServoPlan
from dxlrun.dynamixel.plan.line import listen
from dxlrun.dynamixel.plan.planning import plan_line
from dxlrun.dynamixel.plan.reads import state_read
from dxlrun.dynamixel.plan.units import joint_position, ticks_in
from dxlrun.dynamixel.registers import modes
from dxlrun.dynamixel.registers.declared import settle
from dxlrun.dynamixel.registers.inspection import Inspector, Survey, persist, who
from dxlrun.dynamixel.registers.inspection1 import Inspector1
from dxlrun.dynamixel.registers.inspection2 import Inspector2
from dxlrun.dynamixel.wire.transaction import Outcome, Program, Reply
from dxlrun.mode import Mode

PINGS = 3
"""Two servos of one ID collide in most of three answers."""
LISTEN_NS = 2_000_000
"""After a ping: a second servo of the same ID may answer with another return delay, at most 0.508 ms."""
GROUP = 3
"""Servos that get torque before the next ones do: eight at once could pull the supply down."""
GROUP_PAUSE_NS = 20_000_000
_INSPECTORS: Mapping[float, type[Inspector]] = MappingProxyType({1.0: Inspector1, 2.0: Inspector2})


@dataclass(slots=True)
class Engagement:
    """What came of torque on."""

    problems: list[str] = field(default_factory=list)
    goals: list[int | None] = field(default_factory=list)
    """Goal position in ticks as it was written, in the order of the plan's servos; None: there is none."""


def survey(plan: BusPlan, take_over: bool) -> Program[Survey]:
    """Look at every servo of the bus; writes nothing, and collects all problems of all servos."""
    inspector = _INSPECTORS[plan.protocol](plan, take_over)
    surveyor = _Surveyor(plan, inspector)
    yield listen(LISTEN_NS)
    if plan.servos and (yield from surveyor.echoes()):
        return inspector.found
    present: list[ServoPlan] = []
    for servo in plan.servos:
        if (yield from surveyor.answers(servo)):
            present.append(servo)
    readable: list[ServoPlan] = []
    for servo in present:
        if (yield from inspector.registers(servo)):
            readable.append(servo)
    yield from surveyor.states(readable)
    return inspector.found


class _Surveyor:
    """Asks who is there and where it stands."""

    def __init__(self, plan: BusPlan, inspector: Inspector) -> None:
        self.found = inspector.found
        self._plan = plan
        self._line = inspector.line
        self._problem = inspector.problem

    def echoes(self) -> Program[bool]:
        """Find out whether the adapter echoes: a read cannot be mistaken for its own answer."""
        reply = yield self._line.read(self._plan.servos[0].servo_id, 0, 3)
        if reply.echoed:
            self.found.problems.append(
                f"bus {self._plan.name}: the adapter at {self._plan.port} echoes what it sends; use one that "
                "switches its receiver off while it sends"
            )
        return reply.echoed

    def answers(self, servo: ServoPlan) -> Program[bool]:
        """Ping three times; name silence and collisions."""
        answered = disturbed = 0
        for _ in range(PINGS):
            reply = yield self._line.ping(servo.servo_id)
            after = yield listen(LISTEN_NS)
            answered += reply.answered
            disturbed += bool(reply.strays or after.strays)
        if disturbed > 1:
            self._problem(
                servo,
                f"answers {disturbed} of {PINGS} pings garbled or twice: do two servos have its ID? "
                "Connect them one by one and give each its own",
            )
        elif answered == 0:
            self._problem(
                servo,
                f"does not answer: check power, cable, ID, and that it runs at {self._plan.baud_rate} bit/s",
            )
        elif answered < PINGS - 1:
            self._problem(servo, f"answers only {answered} of {PINGS} pings: check its cable and power")
        return disturbed <= 1 and answered >= PINGS - 1

    def states(self, servos: list[ServoPlan]) -> Program[None]:
        """Read every state twice: inside the limits, and no jump in between."""
        before: dict[int, tuple[int, int]] = {}
        for again in (False, True):
            for servo in servos:
                reply = yield from persist(state_read(self._line, [servo]))
                if not reply.answered:
                    self._problem(servo, _lost(reply))
                    continue
                raw = ticks_in(servo.state.position, reply.parameters)
                if again and servo.servo_id in before:
                    self._jump(servo, before[servo.servo_id], (raw, reply.last_ns))
                elif not again:
                    before[servo.servo_id] = raw, reply.sent_ns
                    self._place(servo, raw)

    def _place(self, servo: ServoPlan, raw: int) -> None:
        if self.found.modes.get(servo.servo_id) != servo.start_mode:
            return  # what it says counts in another mode; it is looked at again before it gets torque
        if raw > servo.max_tick and not servo.continuous:
            self._problem(servo, f"says that it stands at {raw}, beyond its {servo.max_tick} ticks")
        elif not servo.lower_tick - 1 <= raw <= servo.upper_tick + 1:
            limits = servo.lower_tick, servo.upper_tick
            ends = sorted(math.degrees(joint_position(servo, end)) for end in limits)
            self._problem(
                servo,
                f"stands at {math.degrees(joint_position(servo, raw)):.1f} deg, outside its limits "
                f"{ends[0]:.1f}..{ends[1]:.1f} deg: move the joint inside by hand",
            )

    def _jump(self, servo: ServoPlan, before: tuple[int, int], after: tuple[int, int]) -> None:
        moved = abs(after[0] - before[0]) * servo.rad_per_tick
        fastest = servo.max_speed_tick * servo.rad_s_per_tick * (after[1] - before[1]) * 1e-9
        if moved > fastest + 2 * servo.rad_per_tick:
            self._problem(
                servo,
                f"jumped by {math.degrees(moved):.1f} deg between two readings: two servos of one ID, or a "
                "broken potentiometer?",
            )


def engage(plan: BusPlan) -> Program[Engagement]:
    """Hold every servo where it stands: goal := present, torque on, both read back, group by group.

    Ends at the first problem; the caller takes back the torque.
    """
    result = Engagement()
    for index, servo in enumerate(plan.servos):
        if index and index % GROUP == 0:
            yield listen(GROUP_PAUSE_NS)
        problem = yield from _engage_one(plan, servo, result)
        if problem:
            result.problems.append(f"{who(plan, servo)} {problem}")
            break
    return result


def _engage_one(plan: BusPlan, servo: ServoPlan, result: Engagement) -> Program[str]:
    """Hold one servo where it stands; return what went wrong, or nothing."""
    held = yield from modes.hold(plan, servo, servo.mode_plan(servo.start_mode))
    if not held.problem:
        result.goals.append(held.goal)
    return held.problem


@dataclass(frozen=True, slots=True)
class Rejoined:
    """What came of a servo that answers again."""

    problems: tuple[str, ...]
    """Why it may take no part, one sentence each."""
    torqued: bool
    """True when torque enable was read as 1, and a goal that was written as `goal`."""
    goal: int | None
    """Goal position in ticks as it was written; None: it is limp, its mode has none, or none was."""
    written: tuple[tuple[str, str], ...]
    """Joint, and what was written into its registers."""
    mode: Mode = Mode.UNKNOWN
    """In which it is; UNKNOWN where there are problems."""


def rejoin(
    plan: BusPlan,
    servo_index: int,
    torque: bool,
    mode: Mode | None = None,
    registers: Sequence[RegisterValue] | None = None,
) -> Program[Rejoined]:
    """Take one servo back that was lost or was reset, as at the start: look, mend registers, then hold it.

    `torque`: switch it on; without, who is limp stays limp and gets no goal, as a goal may switch torque on
    (protocol.md), and who holds torque still goes on: were torque written to it, a reboot a moment ago would
    be a way to torque that no policy gave. `mode`: in which it shall be, None: its
    first one. `registers`: what it shall hold, None: what the robot file declares; see `SteeredRegisters`.
    """
    servo = plan.servos[servo_index]
    line, mode = plan_line(plan), servo.start_mode if mode is None else mode
    inspector = _INSPECTORS[plan.protocol](plan, True, line)
    found = inspector.found
    if (yield from inspector.registers(servo)):
        yield from _Surveyor(plan, inspector).states([servo])
    if found.problems:
        return Rejoined(tuple(found.problems), False, None, ())
    settled = yield from settle(plan, servo, servo.registers if registers is None else registers, line)
    written = tuple(settled.written)
    if not settled.problems and (problem := (yield from modes.enter(plan, servo, mode, again=False))):
        settled.problems.append(f"{who(plan, servo)} {problem}")
    enabled = yield from persist(plan.torque_reads[servo_index])
    if not enabled.answered:
        settled.problems.append(f"{who(plan, servo)} did not answer when its torque was asked for")
    if settled.problems or not torque:
        holds = not settled.problems and enabled.parameters[0] == 1
        return Rejoined(tuple(settled.problems), holds, None, written, mode)
    held = yield from modes.hold(plan, servo, servo.mode_plan(mode))
    if held.problem:
        return Rejoined((f"{who(plan, servo)} {held.problem}",), False, None, written)
    return Rejoined((), True, held.goal, written, mode)


def confirm(plan: BusPlan) -> Program[list[str]]:
    """Read torque enable of everybody again, after the last one got torque; return what is wrong.

    Torque on draws current: a servo that browned out meanwhile answers again, limp, before the first cycle.
    """
    problems: list[str] = []
    for servo, read in zip(plan.servos, plan.torque_reads, strict=True):
        reply = yield from persist(read)
        if not reply.answered:
            problems.append(f"{who(plan, servo)} did not answer after torque was switched on")
        elif reply.parameters[0] != 1:
            problems.append(
                f"{who(plan, servo)} lost its torque again while the others got theirs (Torque Enable "
                f"({servo.torque_address}) is {reply.parameters[0]}): is its supply strong enough?"
            )
    return problems


def _lost(reply: Reply) -> str:
    if reply.outcome is Outcome.TIMEOUT:
        return "does not answer any more: check cable and power"
    return "answers the reading of its state garbled: do two servos have its ID?"
