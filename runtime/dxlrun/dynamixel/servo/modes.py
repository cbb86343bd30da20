"""Mode switches of one servo: torque off, what selects the mode, what that resets, a goal that moves nothing.

Programs for the start and for idle time. A switch leaves the torque as it was: on again only where it had
been on, where a servo refuses in the mode that it keeps.

Sources: e-Manual XM430-W350, Operating Mode (11), for what a change needs and what it resets; MX-64, CW/CCW
Angle Limit (6, 8) and Torque Control Mode Enable (70).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import msgspec

from dxlrun.description.modes import Mode
from dxlrun.dynamixel.control_table import ControlItem, control_table, side_by_side
from dxlrun.dynamixel.plan.mode_plan import in_mode, mode_in
from dxlrun.dynamixel.plan.planning import plan_line
from dxlrun.dynamixel.plan.retry import retry
from dxlrun.dynamixel.servo import watchdog
from dxlrun.plan.bus_plan import BusPlan, GoalLayout, ModePlan, OwnLimit, ServoPlan
from dxlrun.plan.transaction import Outcome, Program, Reply

ENGAGE_SPEED = 0.5
"""rad/s. The goal is where the servo stands; should that be misread, it goes there slowly."""
FARTHEST_INWARD = 1.0
"""rad, no farther is a wheel taken back [i]: one that made more turns than its servo counts would wind all of
them up."""
LONGEST_BACK = 64  # Bytes; items farther apart are read back one by one
STARTED_ANEW = "started anew while its mode was changed"
_RESET = (
    "velocity_i_gain",
    "velocity_p_gain",
    "position_d_gain",
    "position_i_gain",
    "position_p_gain",
    "feedforward_2nd_gain",
    "feedforward_1st_gain",
    "profile_acceleration",
)
"""What a change of the operating mode resets, beside the goals and the profile velocity beside them."""


class Held(msgspec.Struct, frozen=True):
    """What came of holding a servo where it stands."""

    problem: str  # What went wrong, or nothing
    goal: int | None = None  # Goal position in ticks; None where the mode has none


def never() -> Program[bool]:
    """Return that a servo did not reboot, without a look: no policy is to be kept yet."""
    yield from ()
    return False


def enter(
    plan: BusPlan,
    servo: ServoPlan,
    mode: Mode,
    *,
    again: bool = True,
    inward: bool = False,
    rebooted: Callable[[], Program[bool]] = never,
) -> Program[str]:
    """Bring one servo into a mode in which it then stands still; return what went wrong, or nothing.

    `again`: also one that has torque in this mode is held anew; without, it is left alone. `inward`: as in
    `hold`. `rebooted` finds out whether the servo rebooted meanwhile: then it is left without torque, and
    what is returned is STARTED_ANEW. Raises LookupError when the model does not have the mode.
    """
    desired, line = servo.mode_plan(mode), plan_line(plan)
    torque = yield from retry(line.read(servo.servo_id, servo.torque_address, 1))
    names = [register.name for register in desired.operating]
    found = yield from _read_items(plan, servo, names)
    if not torque.answered or found is None:
        return "did not answer when its mode was read"
    enabled = bool(torque.parameters[0])
    problem = ""
    if not in_mode(desired, found):
        problem = yield from _change(plan, servo, desired, found, enabled=enabled)
    elif not again:
        return ""
    if enabled and (yield from rebooted()):
        return STARTED_ANEW
    if problem and enabled:
        # a joint that does not change shall not fall for that
        now = yield from mode_now(plan, servo)
        if now is not Mode.UNKNOWN:
            back = yield from hold(plan, servo, servo.mode_plan(now), inward=inward)
            problem += f", and {back.problem}" if back.problem else ""
    elif enabled:
        problem = (yield from hold(plan, servo, desired, inward=inward)).problem
    if enabled and (yield from rebooted()):
        # between that look and torque on
        yield from retry(line.write(servo.servo_id, servo.torque_address, b"\0"))
        return STARTED_ANEW
    return problem


class SettledModes(msgspec.Struct):
    """What came of the modes of one bus' servos before they get torque."""

    problems: list[str] = []  # Why a servo is not in its first mode, one sentence each
    switched: list[tuple[str, str]] = []  # Joint, and what its mode had been
    limits: list[Mapping[OwnLimit, int]] = []
    """Of each servo, in the order of the plan's: the limits beyond which it refuses goals, ticks."""


def settle_modes(plan: BusPlan) -> Program[SettledModes]:
    """Bring every servo into its first mode, where it is in another one, and read its own limits."""
    settled = SettledModes()
    for servo in plan.servos:
        settled.limits.append((yield from read_limits(plan, servo)))
        desired = servo.mode_plan(servo.start_mode)
        found = yield from _read_items(plan, servo, [register.name for register in desired.operating])
        if found is not None and in_mode(desired, found):
            continue
        # one that has torque takes no goal while its watchdog has stopped it
        problem = yield from watchdog.disarm(plan, servo)
        problem = problem or (yield from enter(plan, servo, servo.start_mode))
        if problem or found is None:
            problem = problem or "did not answer when its mode was read"
            settled.problems.append(f"{plan.label(servo)} {problem}")
            continue
        items = _items(plan, servo)
        was = ", ".join(f"{items[name].title} was {value}" for name, value in found.items())
        words = servo.start_mode.name.lower().replace("_", "-")
        settled.switched.append((servo.joint, f"{was}: {plan.label(servo)} was brought into {words} mode"))
    return settled


def mode_now(plan: BusPlan, servo: ServoPlan) -> Program[Mode]:
    """Read in which mode a servo is; UNKNOWN where it does not answer, or the plan has none for it."""
    names = dict.fromkeys(register.name for mode in servo.modes for register in mode.operating)
    found = yield from _read_items(plan, servo, list(names))
    return Mode.UNKNOWN if found is None else mode_in(servo, found)


def read_limits(plan: BusPlan, servo: ServoPlan) -> Program[dict[OwnLimit, int]]:
    """Read the limits beyond which a servo refuses goals, ticks; what it does not answer is left out."""
    found: dict[OwnLimit, int] = {}
    for limit in servo.own_limits:
        reply = yield from retry(plan_line(plan).read(servo.servo_id, limit.address, limit.size))
        if reply.answered:
            found[limit] = reply.word(limit.size)
    return found


def hold(plan: BusPlan, servo: ServoPlan, mode: ModePlan, *, inward: bool = False) -> Program[Held]:
    """Hold a servo where it stands: a goal that moves nothing, torque on, both read back.

    One that stands outside its limits is refused; `inward`: it goes back to them, slowly, because one that
    followed an effort may have coasted over them, and without torque it would fall.
    """
    line, position = plan_line(plan), None
    if mode.goals[-1].position is not None:
        block = servo.state
        state = yield from retry(line.read(servo.servo_id, block.address, block.length))
        if not state.answered:
            return Held("did not answer when torque was to be switched on")
        present = servo.state.position.tick(state.parameters)
        position = min(max(present, mode.lower_tick), mode.upper_tick)
        beyond = abs(position - present)
        unwound = servo.continuous and beyond * servo.rad_per_tick > FARTHEST_INWARD
        if beyond > 1 and (unwound or not inward):
            return Held("stands outside its limits, or left them before torque was switched on")
    most_effort = 0
    if position is not None and len(mode.goals) > 1:
        most_effort, problem = yield from _most_effort(plan, servo, mode)
        if problem:
            return Held(problem)
    # the goal comes first: torque on a stale goal would move the joint
    writes = [(layout, _resting(mode, layout, position, most_effort)) for layout in mode.goals]
    for layout, data in writes:
        reply = yield from retry(line.write(servo.servo_id, layout.address, data))
        if not reply.answered:
            return Held("did not acknowledge its goal" + _reason(plan, reply))
    reply = yield from retry(line.write(servo.servo_id, servo.torque_address, b"\x01"))
    if not reply.answered:
        return Held("did not acknowledge torque enable" + _reason(plan, reply))
    problem = yield from _read_back(plan, servo, *writes[-1])
    return Held(problem, None if problem else position)


def unlimit(plan: BusPlan, servo: ServoPlan, mode: Mode) -> Program[str]:
    """Give a servo all of its torque again in a mode without a limit, where another one has limited it.

    It holds already: with an old goal it would spring back. Returns what went wrong, or nothing. One that
    shut itself down is left alone: the write would revive it.
    """
    place = servo.torque_limit
    limited = any(_in_torque_limit(servo, one) for one in servo.modes)
    if place is None or not limited or _in_torque_limit(servo, servo.mode_plan(mode)):
        return ""
    full = yield from retry(plan_line(plan).read(servo.servo_id, place.full_address, place.size))
    now = yield from retry(plan_line(plan).read(servo.servo_id, place.address, place.size))
    if not (full.answered and now.answered):
        return "did not answer when its torque limit was read"
    most, present = (reply.word(place.size) for reply in (full, now))
    if present in {0, most}:
        return ""
    most = min(most, _items(plan, servo)["torque_limit"].maximum)  # its answer may be anything
    return (yield from _write(plan, servo, "torque_limit", most))


def _in_torque_limit(servo: ServoPlan, mode: ModePlan) -> bool:
    """Return whether the effort of positions is limited by what policies reduce, too: Torque Limit (34)."""
    place = servo.torque_limit
    return (
        mode.mode is Mode.EFFORT_POSITION
        and place is not None
        and any(goal.address == place.address for goal in mode.goals)
    )


def _most_effort(plan: BusPlan, servo: ServoPlan, mode: ModePlan) -> Program[tuple[int, str]]:
    """Return the servo's own limit of the effort, ticks, and why it must not be its goal, or nothing.

    Where the goal is its Torque Limit, 0 shows a shutdown, which a goal would undo.
    """
    limits = yield from read_limits(plan, servo)
    most = next((value for limit, value in limits.items() if limit.of == "effort"), 0)
    place = servo.torque_limit
    if place is None or not _in_torque_limit(servo, mode):
        return most, ""
    reply = yield from retry(plan_line(plan).read(servo.servo_id, place.address, place.size))
    if not (most and reply.answered):
        return 0, "did not answer when its torque limit was read"
    return most, "" if any(reply.parameters) else f"has {place.name} = 0: it shut itself down"


def _resting(mode: ModePlan, layout: GoalLayout, position: int | None, most_effort: int) -> bytes:
    """Return a block of goals that moves nothing: the present position with full effort, else 0."""
    block = bytearray(layout.length)
    goals = []
    if layout.position is not None and position is not None:
        goals.append((layout.position, position))
        if layout.speed is not None and mode.speed is not None:
            slow = max(1, round(ENGAGE_SPEED / mode.speed.per_tick))
            goals.append((layout.speed, min(slow, mode.speed.most)))
    elif layout.effort is not None and mode.effort is not None:
        # the limit was read of the servo, whose answer may be anything
        goals.append((layout.effort, min(most_effort, mode.effort.most)))
    for place, ticks in goals:
        signed = place.encoding == "twos_complement"
        data = ticks.to_bytes(place.size, "little", signed=signed)
        block[place.offset : place.offset + place.size] = data
    return bytes(block)


def _read_back(plan: BusPlan, servo: ServoPlan, layout: GoalLayout, data: bytes) -> Program[str]:
    line, torque = plan_line(plan), servo.torque_address
    place = layout.position or layout.speed or layout.effort or layout.pwm
    assert place is not None  # noqa: S101  a block of goals has one
    start, end = layout.address + place.offset, layout.address + place.offset + place.size
    table = control_table(servo.model, plan.protocol)
    if torque < start and end - torque <= LONGEST_BACK and table.readable(torque, end):
        replies = [(yield from retry(line.read(servo.servo_id, torque, end - torque)))]
    else:
        replies = [
            (yield from retry(line.read(servo.servo_id, torque, 1))),
            (yield from retry(line.read(servo.servo_id, start, place.size))),
        ]
    if not all(reply.answered for reply in replies):
        return "did not answer when its torque was read back"
    enabled, found = replies[0].parameters[0], bytes(replies[-1].parameters[-place.size :])
    desired = data[place.offset : place.offset + place.size]
    if enabled != 1 or found != desired:
        signed = place.encoding == "twos_complement"
        given, has = (int.from_bytes(each, "little", signed=signed) for each in (desired, found))
        return f"was given goal {given} and torque, but has goal {has} and torque enable {enabled}"
    return ""


def _change(
    plan: BusPlan, servo: ServoPlan, desired: ModePlan, found: Mapping[str, int], *, enabled: bool
) -> Program[str]:
    """Change the mode with torque off, and give the servo again what it forgets over that."""
    line = plan_line(plan)
    kept = yield from _read_items(plan, servo, _forgotten(plan, servo, desired, found))
    if kept is None:
        return "did not answer when its gains were read before its mode was changed"
    if enabled:
        reply = yield from retry(line.write(servo.servo_id, servo.torque_address, b"\0"))
        if not reply.answered:
            return "did not acknowledge torque off before its mode was changed" + _reason(plan, reply)
    for register in desired.operating:
        if found[register.name] != register.value and (
            problem := (yield from _write(plan, servo, register.name, register.value))
        ):
            return problem
    now = yield from _read_items(plan, servo, list(kept))
    if now is None:
        return "did not answer when its gains were read after its mode was changed"
    items, declared = _items(plan, servo), {register.name for register in servo.registers}
    for name, value in kept.items():
        # what had its initial value begins with the one of the new mode, which may be another
        if (
            now[name] != value
            and (value != items[name].initial or name in declared)
            and (problem := (yield from _write(plan, servo, name, value)))
        ):
            return problem
    return ""


def _forgotten(
    plan: BusPlan, servo: ServoPlan, desired: ModePlan, found: Mapping[str, int]
) -> tuple[str, ...]:
    """Return the items whose values a change of the operating mode resets, and that outlive it."""
    items = _items(plan, servo)
    if "operating_mode" not in items:
        return ()
    names = [name for name in _RESET if name in items]
    names += [register.name for register in servo.registers if not register.eeprom]
    if Mode.PWM not in {desired.mode, mode_in(servo, found)} and "goal_pwm" in items:
        names.append("goal_pwm")  # it limits every other mode, for a policy too
    return tuple(dict.fromkeys(names))


def _write(plan: BusPlan, servo: ServoPlan, name: str, value: int) -> Program[str]:
    line, item = plan_line(plan), _items(plan, servo)[name]
    reply = yield from retry(line.write(servo.servo_id, item.address, item.encode(value)))
    if reply.outcome is Outcome.REFUSED:
        return f"refuses {item.title} = {value}" + _reason(plan, reply)
    back = yield from retry(line.read(servo.servo_id, item.address, item.size))
    if not back.answered:
        return f"did not answer when {item.title} was read back"
    has = item.decode(back.parameters)
    return "" if has == value else f"was given {item.title} = {value}, but has {has}"


def _read_items(plan: BusPlan, servo: ServoPlan, names: Sequence[str]) -> Program[dict[str, int] | None]:
    """Read items, those side by side at once; None when one of them does not come."""
    values: dict[str, int] = {}
    for block in side_by_side(_items(plan, servo)[name] for name in names):
        start, end = block[0].address, block[-1].address + block[-1].size
        if end - start == 1 and control_table(servo.model, plan.protocol).readable(start, end + 1):
            end += 1  # torque enable is one byte, too: a late answer to that is none to this
        reply = yield from retry(plan_line(plan).read(servo.servo_id, start, end - start))
        if not reply.answered:
            return None
        for item in block:
            at = item.address - start
            values[item.name] = item.decode(reply.parameters[at : at + item.size])
    return values


def _items(plan: BusPlan, servo: ServoPlan) -> Mapping[str, ControlItem]:
    return control_table(servo.model, plan.protocol).items


def _reason(plan: BusPlan, reply: Reply) -> str:
    dialect = plan_line(plan).dialect
    return f": {dialect.describe_error(reply.error)}" if reply.outcome is Outcome.REFUSED else ""
