"""Checks: conditions that a servo must meet before it may get torque, at start-up and when it returns after a
loss.

`CHECKS` is the table of comparisons with the plan: control item, predicate, sentence. The control table
(`deviations.toml`) judges every other setting that differs from the factory's. `inspect_servo` applies both
to one servo; `survey` checks a whole bus: presence, registers, states. All of them only read.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import NamedTuple

import msgspec

from dxlrun.dynamixel import texts
from dxlrun.dynamixel.findings import Findings
from dxlrun.dynamixel.remedies import CHECK, choose_remedy
from dxlrun.dynamixel.servo.item_access import Access, first_reach
from dxlrun.dynamixel.servo.registers import format_item, tripped
from dxlwire.bus_plan import SIMULATED, BusPlan, ServoPlan
from dxlwire.control_table import (
    ControlItem,
    ControlTable,
    FoundDeviation,
    HardwareErrors,
    find_deviations,
    find_table,
)
from dxlwire.exceptions import help_link
from dxlwire.modes import Mode
from dxlwire.plan.line import listen_transaction
from dxlwire.plan.mode_plan import mode_in
from dxlwire.plan.placement import (
    OFFSET,
    nearest_turn,
    place_servo,
    present_offset,
    reaches_goals,
    turns_within_limits,
)
from dxlwire.plan.reads import servo_read
from dxlwire.plan.retry import ATTEMPTS, retry
from dxlwire.transaction import Program, Reply, TransactionOutcome
from dxlwire.wire.protocol1 import describe_error

PINGS = 3  # two servos with one ID collide in most of three answers
LISTEN_NS = 2_000_000
"""Listening time after a ping, for the answer of a second servo with the same ID, whose return delay may be
up to 0.508 ms.
"""
STATUS_ERROR = "status_error"
"""Key under which `InspectedServo.values` holds the error byte of a Protocol 1.0 reply. In Protocol 2.0 an
item has the hardware errors.
"""

_IDENTITY = ("model_number", "firmware_version")
_MODES = {"operating_mode", "control_mode"}
_MOST_NAMED = 4  # servos that one message names, to keep it readable


class InspectedServo(msgspec.Struct, frozen=True):
    """Register values of one servo at its inspection, and the plan with which they are compared."""

    plan: BusPlan
    servo: ServoPlan
    """Plan of the servo, placed with its Homing Offset."""
    table: ControlTable
    items: Mapping[str, ControlItem]
    values: Mapping[str, int]
    """Integers on the wire, by item. A register that the robot file declares counts with its declared value,
    because start-up writes it.
    """
    errors: HardwareErrors
    take_over: bool

    def title(self, name: str) -> str:
        """Return the title of an item, such as `Torque Enable (64)`, for messages."""
        return self.items[name].title


class ReadableServo(NamedTuple):
    """A servo that can be read, as the inspection found it."""

    one: Access
    """Access to the servo as it is placed with its Homing Offset."""
    mode: Mode  # its present mode, which start-up changes to the start mode before torque on
    ahead: int  # ticks by which its position increases when start-up sets its registers and its mode


class Check(NamedTuple):
    """One row of CHECKS: applies to the value of one item, and yields a sentence if the value fails."""

    item: str  # the check applies if the servo has this item
    fails: Callable[[InspectedServo, int], bool]  # predicate on the item's value
    sentence: Callable[[InspectedServo, int], str]
    """Returns the problem and its fix, without the servo's name at the start."""
    refuses: bool = True  # True: the servo gets no torque. False: the difference is only reported


def _limits(low: str, high: str, names: str) -> Check:
    def fails(found: InspectedServo, lowest: int) -> bool:
        servo, highest = found.servo, found.values[high]
        if servo.continuous or servo.extended or (found.plan.protocol == 1.0 and lowest >= highest):
            return False  # not in joint mode yet: start-up switches it
        return lowest > servo.lower_tick or highest < servo.upper_tick

    def sentence(found: InspectedServo, lowest: int) -> str:
        servo, highest = found.servo, found.values[high]
        ends = [servo.position_text(end) for end in sorted(map(servo.joint_position, (lowest, highest)))]
        return (
            f"has {names} {lowest}..{highest}, narrower than the joint's "
            f"{servo.lower_tick}..{servo.upper_tick}: write "
            f"`limits: {{position: [{ends[0]}, {ends[1]}]}}`, or widen its {names}"
        )

    return Check(low, fails, sentence)


def _newer(found: InspectedServo, firmware: int) -> list[ControlItem]:
    declared = (found.items[name] for name in found.servo.declared)
    return [item for item in declared if item.firmware > firmware]


def _newer_sentence(found: InspectedServo, firmware: int) -> str:
    newer = _newer(found, firmware)
    titles = " and ".join(item.title for item in newer)
    return (
        f"has firmware {firmware}, but `registers` in the robot file has {titles}, available from firmware "
        f"{max(item.firmware for item in newer)}: remove it, or update the servo"
    )


def _return_delay_sentence(found: InspectedServo, raw: int) -> str:
    plan = found.plan
    total_ns = plan.budget.total_ns + (raw * 2_000 - plan.return_delay_ns) * len(plan.servos)
    return (
        f"{found.title('return_delay_time')} is {raw}, {raw * 2} us instead of the planned "
        f"{plan.return_delay_ns / 1000:g} us; with it on all servos of bus {plan.name}, a cycle takes "
        f"{total_ns / 1e6:.1f} ms instead of {plan.budget.total_ns / 1e6:.1f} ms (at most "
        f"{1e9 / total_ns:.0f} Hz)"
    )


def _watchdog_sentence(found: InspectedServo, raw: int) -> str:
    item = found.items["bus_watchdog"]
    what = f"would stop the servo after {raw * 20} ms without an instruction"
    if tripped(item, raw):
        what = "has stopped the servo"
    return f"{item.title} is {format_item(item, raw)} and {what}; each start clears it"


def _offset_sentence(found: InspectedServo, offset: int) -> str:
    title, wanted, port = found.title(OFFSET), found.servo.homing_offset, found.plan.port
    command = f"dxlrun servo {port} {found.servo.servo_id} set {OFFSET} {wanted}"
    how = "" if port == SIMULATED else f" (`{command}`)"
    link = help_link("another-homing-offset")
    if found.servo.expected:
        return (
            f"has {title} = {offset}, but `{OFFSET}` in the robot file is {wanted}: another program changed "
            f"it since; write {wanted}{how}, or check `reference` and correct `{OFFSET}`; {link}"
        )
    return (
        f"has {title} = {offset} instead of {wanted} as at the start: another program changed it, or this "
        f"is another servo; write {wanted}{how}, or start again; {link}"
    )


def _goals_sentence(found: InspectedServo, offset: int) -> str:
    servo = found.servo
    return (
        f"has {found.title(OFFSET)} = {offset}, which moves its goals to {servo.lower_tick}.."
        f"{servo.upper_tick}, beyond its {found.items['goal_position'].title}: write 0"
    )


CHECKS: tuple[Check, ...] = (
    Check(
        STATUS_ERROR,
        lambda found, error: bool(error & found.errors.mask),
        lambda found, error: f"reports an error: {describe_error(error & found.errors.mask)}",
    ),
    Check(
        "model_number",
        lambda found, number: number != found.servo.model_number,
        lambda found, number: (
            f"is model number {number}, not a {found.servo.model} ({found.servo.model_number}): correct "
            f"`model` or the ID in the robot file; {help_link('the-model-is-another-one')}"
        ),
    ),
    Check("firmware_version", lambda found, firmware: bool(_newer(found, firmware)), _newer_sentence),
    Check(
        "return_delay_time",
        lambda found, raw: abs(raw * 2_000 - found.plan.return_delay_ns) >= 2_000,
        _return_delay_sentence,
        refuses=False,
    ),
    Check(OFFSET, lambda found, offset: offset != found.servo.homing_offset, _offset_sentence),
    Check(OFFSET, lambda found, _: not reaches_goals(found.servo, found.table), _goals_sentence),
    _limits("min_position_limit", "max_position_limit", "position limits"),
    _limits("cw_angle_limit", "ccw_angle_limit", "angle limits"),
    *(
        Check(
            item,
            lambda found, raw: raw != 0 and not found.errors.is_warning(raw),
            lambda found, raw: (
                f"reports in {found.title(found.errors.item)}: {found.errors.describe_errors(raw)}; "
                f"find the cause, then reboot it; {help_link('a-servo-reports-an-error')}"
            ),
        )
        for item in ("hardware_error_status", "error_code")
    ),
    Check(
        "error_code",
        lambda found, raw: found.errors.is_warning(raw),
        lambda found, raw: (
            f"reports in {found.title(found.errors.item)}: {found.errors.describe_errors(raw)}"
        ),
        refuses=False,
    ),
    Check(  # Start-up clears a watchdog that an earlier run left armed; report it if this run arms none.
        "bus_watchdog",
        lambda found, raw: raw != 0 and not found.plan.watchdog_ticks,
        _watchdog_sentence,
        refuses=False,
    ),
    Check(
        "torque_enable",
        lambda found, enabled: enabled != 0 and not found.take_over,
        lambda *_: (
            "holds torque already; another program may be moving it: end that program and switch the torque "
            f"off, or keep the torque with --take-over; {help_link('a-servo-holds-torque-already')}"
        ),
    ),
    Check(
        "torque_limit",
        lambda found, raw: raw == 0 and found.plan.protocol == 1.0,
        lambda found, _: (
            f"has {found.title('torque_limit')} = 0: it shut itself down after overload or overheating; find "
            "the cause, then switch its power off and on"
        ),
    ),
)
"""Checks of a servo's registers in the order in which problems are reported; failures.md lists the condition
that each refuses.
"""


def survey(plan: BusPlan, take_over: bool, found: Findings) -> Program[tuple[ServoPlan, ...]]:
    """Check that every servo of a bus is present and fit for torque; add the problems of all servos to
    `found`. Only reads.

    Returns:
        The plans of the servos as they are placed with their Homing Offsets; without problems those of all.
    """
    yield listen_transaction(LISTEN_NS)
    every = [first_reach(plan, servo) for servo in plan.servos]
    if every and (yield from _echoes(every[0], found)):
        return ()
    present: list[Access] = []
    silent: list[ServoPlan] = []
    for one in every:
        answered = yield from _answers(one, found)
        if answered is None:
            silent.append(one.servo)
        elif answered:
            present.append(one)
    if silent:
        found.problems.insert(0, _silence(plan, silent))
    readable: list[ReadableServo] = []
    for one in present:
        inspected = yield from inspect_servo(one, found, take_over=take_over)
        if inspected is not None:
            readable.append(inspected)
    yield from inspect_states(readable, found)
    return tuple(each.one.servo for each in readable)


def inspect_servo(one: Access, found: Findings, *, take_over: bool) -> Program[ReadableServo | None]:
    """Read the registers of a servo that matter for a start, and add the problems, events and unusual
    settings to `found`. Returns None if the servo cannot be read.
    """
    plan, servo = one.plan, one.servo
    wanted: tuple[str, ...] = _IDENTITY
    # Read the firmware version first: an older firmware may refuse to read items that came later.
    read, reply = yield from one.read_near(wanted)
    if reply.answered:
        items = one.table.with_firmware(read["firmware_version"]).items
        essential, optional = _inspected(servo.model, plan.protocol)
        wanted = tuple(name for name in (*essential, *optional) if name in items)
        more, reply = yield from one.read_near(wanted, optional)
        read |= more
    if not reply.answered:
        title = next(one.items[name].title for name in wanted if name not in read)
        found.problems.append(f"{one} {_unreadable(one, title, reply)}")
        return None
    declared = servo.declared
    values = {name: declared.get(name, raw) for name, raw in read.items()}
    if plan.protocol == 1.0:
        values[STATUS_ERROR] = reply.error
    firmware = values["firmware_version"]
    found.add_event(servo.joint, texts.servo_found(servo.model, servo.servo_id, plan.name, firmware))
    if servo.homing_offset is None:
        servo = place_servo(servo, one.table, values.get(OFFSET, 0))
    inspected = InspectedServo(plan, servo, one.table, one.items, values, one.table.errors, take_over)
    for check in CHECKS:
        if check.item in values and check.fails(inspected, values[check.item]):
            sentence = check.sentence(inspected, values[check.item])
            if check.refuses:
                found.problems.append(f"{one} {sentence}")
            else:
                found.add_event(servo.joint, texts.register_check_failed(sentence))
    # Torque control mode of Protocol 1.0 is in RAM, and only some models have it: it is not read here.
    mode = mode_in(servo, {"torque_ctrl_mode_enable": 0, **values})
    known = declared if one.servo.homing_offset is None else {*declared, OFFSET}
    for each in deviations(one, values, mode, known):
        if each.refused:
            found.problems.append(f"{one} {_refusal(one, each)}")
        else:
            found.deviations.append((servo.joint, f"ID {servo.servo_id} on bus {plan.name}", each))
    ahead = (servo.homing_offset or 0) - present_offset(one.table, read)
    return ReadableServo(one.placed(servo), mode, ahead)


def deviations(
    one: Access, values: Mapping[str, int], mode: Mode, declared: Collection[str] = ()
) -> tuple[FoundDeviation, ...]:
    """Return the settings of a servo that differ from the factory's and matter to a run.

    `declared` items are not judged, nor are the goals of the present mode or the start mode: all of these are
    written before torque on.
    """
    known = one.servo.modes
    goals = [goal for each in known if each.mode in (mode, one.servo.start_mode) for goal in each.goals]
    return find_deviations(
        (
            item
            for item in one.items.values()
            if item.name not in declared
            # It counts in multi-turn mode only (e-Manual MX-28, Resolution Divider (22)).
            and (item.name != "multi_turn_offset" or one.servo.continuous)
            and not any(goal.address <= item.address < goal.address + goal.length for goal in goals)
        ),
        values,
    )


@functools.cache
def _inspected(model: str, protocol: float) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return (essential, optional) items: those that can refuse a start, and those only reported."""
    items = find_table(model, protocol).items
    essential = {check.item for check in CHECKS} | _MODES
    optional = set[str]()
    for item in items.values():
        if item.access == "RW" and item.deviation is not None and item.deviation.judgement != "harmless":
            (essential if item.deviation.may_refuse else optional).add(item.name)
            optional.add(item.limited_by)
    essential -= {*_IDENTITY}
    return (
        tuple(name for name in items if name in essential),
        tuple(name for name in items if name in optional - essential),
    )


def _refusal(one: Access, found: FoundDeviation) -> str:
    item = found.item
    command = f"dxlrun servo {one.plan.port} {one.servo.servo_id} set {item.name} {found.factory}"
    how = "" if one.plan.port == SIMULATED else f" (`{command}`)"
    link = help_link("a-setting-of-another-program-is-refused")
    wrong = f"has {item.title} = {found.found}, and this value {found.effect}"
    return f"{wrong}: write {found.factory}{how}; {link}"


def inspect_states(servos: Sequence[ReadableServo], found: Findings) -> Program[None]:
    """Read the position of every servo twice; add a problem if it is outside the limits or jumps faster than
    the servo can move.

    Args:
        servos: The servos that can be read.
        found: Collects the problems.
    """
    before: dict[int, tuple[int, int]] = {}
    # Two rounds over all servos, so that time passes between the two readings of each servo.
    for again in (False, True):
        for one, mode, ahead in servos:
            servo = one.servo
            if again and servo.servo_id not in before:
                continue  # Its first reading failed, which is reported already.
            reply = yield from retry(servo_read(one.line, servo))
            problem = ""
            if not reply.answered:
                problem = "sends garbled replies when its state is read: do two servos have its ID?"
                if reply.outcome is TransactionOutcome.TIMEOUT:
                    problem = f"no longer answers: {choose_remedy(one.plan.port, CHECK)}"
            else:
                raw = servo.state.position.tick(reply.parameters)
                if again:
                    problem = _jump(servo, before[servo.servo_id], (raw, reply.last_ns))
                else:
                    before[servo.servo_id] = raw, reply.asked_ns
                    # In another mode the turn may be another one; the position is checked before torque on.
                    if servo.extended or mode == servo.start_mode:
                        problem = find_turn(servo, raw + ahead)[1]
            if problem:
                found.problems.append(f"{one} {problem}")


def _echoes(one: Access, found: Findings) -> Program[bool]:
    """Return True, and add a problem, if the adapter receives what it sends. A read is sent because it cannot
    be mistaken for its own answer.
    """
    reply = yield one.reading(0, 3)
    if reply.echoed:
        found.problems.append(
            f"bus {one.plan.name}: the adapter at {one.plan.port} echoes every instruction; use an adapter "
            f"without echo, such as a U2D2; {help_link('the-adapter-echoes')}"
        )
    return reply.echoed


def _answers(one: Access, found: Findings) -> Program[bool | None]:
    """Ping a servo three times; return True if it answers well, False if a problem (two servos with one ID,
    loose contact) was added, None without any answer.
    """
    answered = disturbed = 0
    for _ in range(PINGS):
        reply = yield one.line.ping(one.servo.servo_id)
        after = yield listen_transaction(LISTEN_NS)
        answered += reply.answered
        disturbed += bool(reply.strays or after.strays)
    problem = ""
    if disturbed > 1:
        problem = (
            f"answers {disturbed} of {PINGS} pings garbled or twice: do two servos have its ID? "
            "Connect them one by one, and give each servo its own ID; "
            f"{help_link('two-servos-have-one-id')}"
        )
    elif answered == 0:
        return None
    elif answered < PINGS - 1:
        remedy = choose_remedy(one.plan.port, CHECK)
        problem = f"answers only {answered} of {PINGS} pings: {remedy}"
    if problem:
        found.problems.append(f"{one} {problem}")
    return not problem


def _silence(plan: BusPlan, silent: Sequence[ServoPlan]) -> str:
    """Return one sentence that names all servos of a bus that do not answer, with the remedy and the command
    that finds them.
    """
    look = "" if plan.port == SIMULATED else f"; list the servos with `dxlrun scan {plan.port}`"
    rate = f"baud rate ({plan.baud_rate} bit/s){look}"
    if len(silent) == 1:
        remedy = choose_remedy(
            plan.port, f"check power, cable, ID and {rate}", simulated=f"check its ID and {rate}"
        )
        return f"{plan.label(silent[0])} does not answer: {remedy}; {help_link('one-servo-does-not-answer')}"
    named = [f"{servo.own_name} (ID {servo.servo_id})" for servo in silent[:_MOST_NAMED]]
    more = ", ".join(str(servo.servo_id) for servo in silent[_MOST_NAMED:])
    names = ", ".join(named) + (f" and ID{'s' * (len(silent) > _MOST_NAMED + 1)} {more}" if more else "")
    if len(silent) == len(plan.servos):
        remedy = choose_remedy(
            plan.port, f"check its power, cable, port and {rate}", simulated=f"check its {rate}"
        )
        link = help_link("no-servo-answers")
        return f"none of the {len(silent)} servos on bus {plan.name} answers: {names}; {remedy}; {link}"
    remedy = choose_remedy(
        plan.port, f"check power, cables, IDs and {rate}", simulated=f"check the IDs and {rate}"
    )
    link = help_link("one-servo-does-not-answer")
    return f"{len(silent)} servos on bus {plan.name} do not answer: {names}; {remedy}; {link}"


def _unreadable(one: Access, title: str, reply: Reply) -> str:
    """Return the reason why a servo that answered its pings could not be read; `title` is the item.

    A timeout is not evidence against a certain register.
    """
    if reply.outcome is TransactionOutcome.TIMEOUT:
        level = one.items["status_return_level"].title
        remedy = choose_remedy(one.plan.port, f"{CHECK}, and its {level}")
        return f"answered pings, but did not answer {ATTEMPTS} reads of {title}: {remedy}"
    if reply.outcome is TransactionOutcome.REFUSED:
        return f"rejects reads{one.reason(reply)}"
    remedy = choose_remedy(one.plan.port, " If not, check cable and ground", simulated="")
    return f"sends garbled replies to reads: do two servos have its ID?{remedy}"


def find_turns(plan: BusPlan, found: Findings) -> Program[list[ServoPlan]]:
    """Find the turn of each servo of a bus that counts turns, in its start mode; problems go to `found`.

    Returns:
        The plans of all servos of the bus, as they are placed.
    """
    placed: list[ServoPlan] = []
    for servo in plan.servos:
        placed.append((yield from place_in_turn(first_reach(plan, servo), found)))
    return placed


def place_in_turn(one: Access, found: Findings) -> Program[ServoPlan]:
    """Read the position of a servo that counts turns, and return its plan in the turn that it is in.

    Problems and an event with the turn go to `found`. Any other servo is not read.
    """
    servo = one.servo
    if not servo.extended:
        return servo
    reply = yield from retry(servo_read(one.line, servo))
    if not reply.answered:
        found.problems.append(f"{one} did not answer when its turn was read")
        return servo
    raw = servo.state.position.tick(reply.parameters)
    placed, problem = find_turn(servo, raw)
    if problem:
        found.problems.append(f"{one} {problem}")
    turn = (placed.lower_tick - servo.lower_tick) // servo.turn_ticks
    if turn:
        found.add_event(servo.joint, texts.turn_found(str(one), raw, turn))
    return placed


def find_turn(servo: ServoPlan, raw: int) -> tuple[ServoPlan, str]:
    """Return the plan of a servo in the turn in which `raw` ticks are within its limits, and the problem,
    empty if there is none.

    A servo that starts limp may be beyond its limits, because a person may move it anywhere; `hold` checks it
    before torque on.
    """
    if servo.extended:
        turns = turns_within_limits(servo, raw)
        if len(turns) > 1:
            return servo, _ambiguous(turns, raw)
        servo = turns[0] if turns else nearest_turn(servo, raw)
    least, most = servo.lower_tick - 1, servo.upper_tick + 1
    if not servo.torque_at_start or least <= raw <= most:
        return servo, ""
    if not (servo.continuous or servo.extended) and raw - (servo.homing_offset or 0) > servo.max_tick:
        return servo, f"reports position {raw}, beyond its {servo.max_tick} ticks"
    return servo, servo.outside_limits(raw, servo.lower_tick, servo.upper_tick)


def _ambiguous(turns: Sequence[ServoPlan], raw: int) -> str:
    one, turn = turns[0], turns[0].turn_ticks
    found = sorted(each.joint_position(raw) for each in turns)
    ends = sorted(map(one.joint_position, (one.upper_tick - turn + 1, one.lower_tick + turn - 1)))
    least, most = map(one.position_text, ends)
    return (
        f"is at {' or '.join(map(one.position_text, found))}, each within its limits, and does not know its "
        f"turn: move it between {least} and {most} by hand; {help_link('a-joint-does-not-know-its-turn')}"
    )


def _jump(servo: ServoPlan, before: tuple[int, int], after: tuple[int, int]) -> str:
    """Return the problem if a servo moved faster between two readings, each (ticks, time in ns), than it can;
    otherwise an empty string.
    """
    moved = abs(after[0] - before[0]) * servo.rad_per_tick
    fastest = servo.max_speed_tick * servo.rad_s_per_tick * (after[1] - before[1]) * 1e-9
    # Allow a rounding error of one tick in each reading.
    if moved <= fastest + 2 * servo.rad_per_tick:
        return ""
    return (
        f"jumped by {math.degrees(moved):.1f} deg between two readings: two servos with one ID, or a broken "
        "potentiometer?"
    )
