"""Start-up on one bus, as failures.md has it: look at everything first, then torque on in groups.

Programs of transactions; nothing here waits, nothing writes a register that survives power-off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from dxlrun.control_table import ControlTable, control_table
from dxlrun.dynamixel.bus_plan import BusPlan, ServoPlan
from dxlrun.dynamixel.line import LONGEST_RETURN_DELAY_NS, Line, listen
from dxlrun.dynamixel.plan import STATE_LENGTH
from dxlrun.dynamixel.protocol1 import StatusError, describe_error
from dxlrun.dynamixel.transaction import Outcome, Program, Reply, Transaction
from dxlrun.dynamixel.units import joint_position, speed_ticks

PINGS = 3
"""Two servos of one ID collide in most of three answers."""
ATTEMPTS = 3
LISTEN_NS = 2_000_000
"""After a ping: a second servo of the same ID may answer with another return delay, at most 0.508 ms."""
GROUP = 3
"""Servos that get torque before the next ones do: eight at once could pull the supply down."""
GROUP_PAUSE_NS = 20_000_000
ENGAGE_SPEED = 0.5
"""rad/s. The goal is where the servo stands; should that be misread, it goes there slowly."""
FORBIDDEN = StatusError.INPUT_VOLTAGE | StatusError.OVERHEATING | StatusError.OVERLOAD
"""States of a servo in which it gets no torque; the other bits tell of one instruction."""
RETURN_ALL = 2
"""Status Return Level (16): every instruction is answered."""


@dataclass(slots=True)
class Survey:
    """What was found on one bus."""

    problems: list[str] = field(default_factory=list)
    """Why the robot must not start, one sentence each."""
    differences: list[tuple[str, str]] = field(default_factory=list)
    """Joint, and what its registers have that the robot file assumes otherwise."""
    servos: list[tuple[str, str]] = field(default_factory=list)
    """Joint, and what answered."""


@dataclass(slots=True)
class Engagement:
    """What came of torque on."""

    problems: list[str] = field(default_factory=list)
    goals: list[int] = field(default_factory=list)
    """Goal position in ticks, in the order of the plan's servos, as it was written."""


def setup_line(plan: BusPlan) -> Line:
    """Return the line before the servos' return delays are known: the longest is assumed."""
    return Line(plan.baud_rate, plan.latency_ns, max(plan.return_delay_ns, LONGEST_RETURN_DELAY_NS))


def persist(transaction: Transaction) -> Program[Reply]:
    """Try a transaction until it is answered, a few times; return the last reply."""
    reply = yield transaction
    for _ in range(ATTEMPTS - 1):
        if reply.answered:
            break
        reply = yield transaction
    return reply


def survey(plan: BusPlan, take_over: bool) -> Program[Survey]:
    """Look at every servo of the bus; writes nothing, and collects all problems of all servos."""
    surveyor = _Surveyor(plan, take_over)
    yield listen(LISTEN_NS)
    if plan.servos and (yield from surveyor.echoes()):
        return surveyor.found
    present: list[ServoPlan] = []
    for servo in plan.servos:
        if (yield from surveyor.answers(servo)):
            present.append(servo)
    readable: list[ServoPlan] = []
    for servo in present:
        if (yield from surveyor.registers(servo)):
            readable.append(servo)
    yield from surveyor.states(readable)
    return surveyor.found


class _Surveyor:
    def __init__(self, plan: BusPlan, take_over: bool) -> None:
        self.found = Survey()
        self._plan = plan
        self._take_over = take_over
        self._line = setup_line(plan)

    def _problem(self, servo: ServoPlan, text: str) -> None:
        self.found.problems.append(f"{_who(self._plan, servo)} {text}")

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

    def registers(self, servo: ServoPlan) -> Program[bool]:
        """Read what must fit the plan; return False when the servo cannot be read."""
        table = control_table(servo.model)
        blocks: dict[str, Reply] = {}
        for first, last in (
            ("model_number", "firmware_version"),
            ("return_delay_time", "ccw_angle_limit"),
            ("status_return_level", "status_return_level"),
            ("torque_enable", "torque_limit"),
        ):
            start, end = table.items[first].address, table.items[last].address + table.items[last].size
            blocks[first] = yield from persist(self._line.read(servo.servo_id, start, end - start))
            if not blocks[first].answered:
                self._unreadable(servo, blocks[first])
                return False
        error = blocks["torque_enable"].error & FORBIDDEN
        if error:
            self._problem(servo, f"reports an error: {describe_error(error)}")
        self._identity(servo, blocks["model_number"])
        self._angle_limits(servo, blocks["return_delay_time"])
        self._return_delay(servo, blocks["return_delay_time"].parameters[0])
        level = blocks["status_return_level"].parameters[0]
        if level != RETURN_ALL:
            self._problem(
                servo,
                f"has Status Return Level (16) = {level}, so it acknowledges no write: write "
                f"{RETURN_ALL} there",
            )
        self._torque(servo, table, blocks["torque_enable"])
        return True

    def _unreadable(self, servo: ServoPlan, reply: Reply) -> None:
        if reply.outcome is Outcome.TIMEOUT:
            self._problem(
                servo,
                "answers pings but no read: its Status Return Level (16) is 0; write "
                f"{RETURN_ALL} there (writes are carried out, though not acknowledged)",
            )
        elif reply.outcome is Outcome.REFUSED:
            self._problem(servo, f"refuses to be read: {describe_error(reply.error)}")
        else:
            self._problem(
                servo, "answers reads garbled: do two servos have its ID? If not, check cable and ground"
            )

    def _identity(self, servo: ServoPlan, block: Reply) -> None:
        number, firmware = block.word(), block.parameters[2]
        if number != servo.model_number:
            self._problem(
                servo,
                f"is model number {number}, not a {servo.model} ({servo.model_number}): correct `model` or "
                "the ID in the robot file",
            )
        self.found.servos.append(
            (servo.joint, f"{servo.model}, ID {servo.servo_id} on bus {self._plan.name}, firmware {firmware}")
        )

    def _angle_limits(self, servo: ServoPlan, block: Reply) -> None:
        clockwise, counter = block.word(2, 1), block.word(2, 3)
        if clockwise == counter == 0:
            self._problem(
                servo,
                "is in wheel mode (CW and CCW Angle Limit are 0) and would turn without end: write 0 to (6) "
                f"and {servo.max_tick} to (8)",
            )
        elif clockwise > servo.lower_tick or counter < servo.upper_tick:
            ends = sorted(math.degrees(joint_position(servo, raw)) for raw in (clockwise, counter))
            self._problem(
                servo,
                f"has angle limits {clockwise}..{counter}, narrower than the joint's "
                f"{servo.lower_tick}..{servo.upper_tick}, and would refuse goals: write "
                f"`limits: {{position: [{ends[0]:.1f} deg, {ends[1]:.1f} deg]}}` or wider angle limits",
            )

    def _return_delay(self, servo: ServoPlan, raw: int) -> None:
        plan = self._plan
        more_ns = raw * 2_000 - plan.return_delay_ns
        if abs(more_ns) < 2_000:
            return
        total_ns = plan.budget.total_ns + more_ns * len(plan.servos)
        self.found.differences.append(
            (
                servo.joint,
                f"Return Delay Time (5) is {raw}, {raw * 2} us, where the robot file assumes "
                f"{plan.return_delay_ns / 1000:g} us; if all servos of bus {plan.name} have it, a cycle "
                f"takes {total_ns / 1e6:.1f} ms instead of {plan.budget.total_ns / 1e6:.1f} ms, at most "
                f"{1e9 / total_ns:.0f} Hz",
            )
        )

    def _torque(self, servo: ServoPlan, table: ControlTable, block: Reply) -> None:
        if block.parameters[0] and not self._take_over:
            self._problem(
                servo,
                "holds torque already, so another program may be moving it: stop that one and switch the "
                "torque off, or take the robot over on purpose",
            )
        limit = block.word(2, table.items["torque_limit"].address - table.items["torque_enable"].address)
        if limit == 0:
            self._problem(
                servo,
                "has Torque Limit (34) = 0: it shut itself down after overload or overheating; find the "
                "cause, then switch its power off and on",
            )

    def states(self, servos: list[ServoPlan]) -> Program[None]:
        """Read every state twice: inside the limits, and no jump in between."""
        before: dict[int, tuple[int, int]] = {}
        for again in (False, True):
            for servo in servos:
                reply = yield from persist(_state_read(self._line, servo))
                if not reply.answered:
                    self._problem(servo, _lost(reply))
                    continue
                raw = reply.word()
                if again and servo.servo_id in before:
                    self._jump(servo, before[servo.servo_id], (raw, reply.last_ns))
                elif not again:
                    before[servo.servo_id] = raw, reply.last_ns
                    self._place(servo, raw)

    def _place(self, servo: ServoPlan, raw: int) -> None:
        if raw > servo.max_tick:
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
    line, result = setup_line(plan), Engagement()
    for index, servo in enumerate(plan.servos):
        if index and index % GROUP == 0:
            yield listen(GROUP_PAUSE_NS)
        problem = yield from _engage_one(line, servo, result)
        if problem:
            result.problems.append(f"{_who(plan, servo)} {problem}")
            break
    return result


def _engage_one(line: Line, servo: ServoPlan, result: Engagement) -> Program[str]:
    items = control_table(servo.model).items
    state = yield from persist(_state_read(line, servo))
    if not state.answered:
        return "did not answer when torque was to be switched on"
    goal = min(max(state.word(), servo.lower_tick), servo.upper_tick)
    if abs(goal - state.word()) > 1:
        return "left its limits before torque was switched on"
    wanted = goal.to_bytes(2, "little")
    # the goal comes first: torque on a stale goal would move the joint
    for item, data in (
        ("goal_position", wanted + speed_ticks(servo, ENGAGE_SPEED).to_bytes(2, "little")),
        ("torque_enable", b"\x01"),
    ):
        reply = yield from persist(line.write(servo.servo_id, items[item].address, data))
        if not reply.answered:
            return f"did not acknowledge {item.replace('_', ' ')}"
    torque = items["torque_enable"].address
    offset = items["goal_position"].address - torque
    back = yield from persist(line.read(servo.servo_id, torque, offset + 2))
    if not back.answered:
        return "did not answer when its torque was read back"
    if back.parameters[0] != 1 or back.parameters[offset : offset + 2] != wanted:
        return (
            f"was given goal {goal} and torque, but has goal {back.word(2, offset)} and torque enable "
            f"{back.parameters[0]}"
        )
    result.goals.append(goal)
    return ""


def _lost(reply: Reply) -> str:
    if reply.outcome is Outcome.TIMEOUT:
        return "does not answer any more: check cable and power"
    return "answers the reading of its state garbled: do two servos have its ID?"


def _state_read(line: Line, servo: ServoPlan) -> Transaction:
    address = control_table(servo.model).items["present_position"].address
    return line.read(servo.servo_id, address, STATE_LENGTH)


def _who(plan: BusPlan, servo: ServoPlan) -> str:
    return f"{servo.joint} (ID {servo.servo_id} on bus {plan.name})"
