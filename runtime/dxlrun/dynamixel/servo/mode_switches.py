"""Modes: programs that switch one servo into an operating mode, and hold it at its present position.

A mode switch has torque off, mode registers, registers that the switch resets, and a goal without motion.
These programs run at start-up and in idle time. A switch keeps the torque as it was: it is switched on again
only if it was on before. A servo that refuses the new mode gets torque back in its old mode.

Sources: e-Manual XM430-W350, Operating Mode (11), for the conditions and side effects of a change; MX-64,
CW/CCW Angle Limit (6, 8) and Torque Control Mode Enable (70).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping

import msgspec

from dxlrun.dynamixel import texts
from dxlrun.dynamixel.findings import Findings
from dxlrun.dynamixel.servo import watchdog
from dxlrun.dynamixel.servo.item_access import Access, access_servo
from dxlrun.dynamixel.servo.torque_limits import SILENT, limits_positions
from dxlrun.plan.loop_plan import LimitedInterface, ServoLimit
from dxlwire.bus_plan import BusPlan, Field, GoalLayout, ModePlan, OwnLimit
from dxlwire.modes import Mode
from dxlwire.plan.mode_plan import in_mode, mode_in
from dxlwire.plan.placement import nearest_turn
from dxlwire.transaction import Program, TransactionOutcome

ENGAGE_SPEED = 0.5
"""Speed limit (rad/s) when a servo gets torque. The goal is the present position; if that was misread, the
servo moves to the goal slowly.
"""
FARTHEST_INWARD = 1.0
"""Distance (rad [i]) from which a continuous servo is still moved back into its limits: after more turns than
its counter holds it would unwind all of them.
"""
LONGEST_BACK = 64  # bytes; items farther apart are read back one by one
STARTED_ANEW = "rebooted while its mode was changed"
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
"""Registers that a change of the operating mode resets and that are restored. It also resets the goals and
the profile velocity.
"""


class HoldResult(msgspec.Struct, frozen=True):
    """Result of `hold_servo`: torque on for one servo at its present position."""

    problem: str  # problem; empty on success
    goal: int | None = None  # goal position in ticks; None if the mode has none


def never() -> Program[bool]:
    """Default of `enter_mode`: return False without a read, because at start-up no reboot is watched."""
    yield from ()
    return False


def enter_mode(
    one: Access,
    mode: Mode,
    *,
    again: bool = True,
    inward: bool = False,
    rebooted: Callable[[], Program[bool]] = never,
) -> Program[str]:
    """Switch one servo into a mode. If it had torque it then holds its position, otherwise it stays limp.

    Args:
        one: The servo.
        mode: Desired mode.
        again: True: a servo that already has torque in this mode gets a new holding goal. False: it is not
            changed.
        inward: As in `hold_servo`.
        rebooted: Finds out whether the servo rebooted during the switch. After a reboot the servo stays
            without torque.

    Returns:
        The problem, empty on success; STARTED_ANEW after a reboot.

    Raises:
        LookupError: The model does not have the mode.
    """
    desired = one.servo.mode_plan(mode)
    torque = yield from one.read_torque()
    found = yield from one.read_items(register.name for register in desired.operating)
    if not torque.answered or found is None:
        return "did not answer when its mode was read"
    enabled = bool(torque.parameters[0])
    problem = ""
    if not in_mode(desired, found):
        problem = yield from _change(one, desired, found, enabled=enabled)
    elif not again:
        return ""
    if enabled and (yield from rebooted()):
        return STARTED_ANEW
    if problem and enabled:
        # A servo that refuses the mode must not let its joint fall.
        now = yield from mode_now(one)
        if now is not Mode.UNKNOWN:
            back = yield from hold_servo(one, now, inward=inward)
            problem += f", and {back.problem}" if back.problem else ""
    elif enabled:
        problem = (yield from hold_servo(one, mode, inward=inward)).problem
    if enabled and (yield from rebooted()):
        # It may have rebooted after the check above and before torque on.
        yield from one.torque_off()
        return STARTED_ANEW
    return problem


def settle_modes(plan: BusPlan, found: Findings) -> Program[list[dict[OwnLimit, int]]]:
    """Switch every servo of a bus into its start mode if it is in another mode, before it gets torque.
    Problems go to `found`.

    Returns:
        The limits in ticks beyond which each servo refuses goals, in the order of the plan's servos.
    """
    limits = []
    for servo in plan.servos:
        one = access_servo(plan, servo)
        limits.append((yield from read_limits(one)))
        desired = servo.mode_plan(servo.start_mode)
        before = yield from one.read_items(register.name for register in desired.operating)
        if before is not None and in_mode(desired, before):
            continue
        # A servo with torque accepts no goal while its tripped watchdog holds it stopped.
        problem = yield from watchdog.disarm(one)
        problem = problem or (yield from enter_mode(one, servo.start_mode))
        if problem or before is None:
            problem = problem or "did not answer when its mode was read"
            found.problems.append(f"{one} {problem}")
            continue
        was = ", ".join(f"{one.items[name].title} was {value}" for name, value in before.items())
        words = servo.start_mode.name.lower().replace("_", "-")
        words = f"extended {words}" if servo.extended else words
        found.add_event(servo.joint, texts.start_mode_set(str(one), was, words))
    return limits


def mode_now(one: Access) -> Program[Mode]:
    """Read the mode registers of a servo and return its mode; UNKNOWN without an answer, or if the plan lacks
    the mode.
    """
    names = dict.fromkeys(register.name for mode in one.servo.modes for register in mode.operating)
    found = yield from one.read_items(names)
    return Mode.UNKNOWN if found is None else mode_in(one.servo, found)


def read_limits(
    one: Access, kinds: Collection[str] = ("speed", "effort", "pwm")
) -> Program[dict[OwnLimit, int]]:
    """Read the servo's limit registers of these kinds, in ticks; a goal beyond one is refused. Registers
    without a reply are omitted.
    """
    found: dict[OwnLimit, int] = {}
    for limit in one.servo.own_limits:
        if limit.of not in kinds:
            continue
        reply = yield from one.read_bytes(limit.address, limit.size)
        if reply.answered:
            found[limit] = reply.word(limit.size)
    return found


def servo_limits(one: Access, limits: Mapping[OwnLimit, int]) -> tuple[ServoLimit, ...]:
    """Return the limit registers of a servo that are tighter than the maximum of its modes, converted to
    joint units and with text.
    """
    servo, table, found = one.servo, one.table, list[ServoLimit]()
    for limit, raw in limits.items():
        scales = [scale for mode in servo.modes if (scale := getattr(mode, limit.of)) is not None]
        if not scales or all(raw >= scale.most for scale in scales):
            continue
        value = min(min(raw, scale.most) * scale.per_tick for scale in scales)
        interface: LimitedInterface = "velocity" if limit.of == "speed" else limit.of
        if interface == "velocity":
            value *= servo.ratio
            written = f"{servo.position_text(value)}/s"
        elif interface == "pwm" or table.effort_unit == "1":
            written = f"{value:.1%}".replace("%", " %")
        else:
            written = f"{value:.3g} {servo.unit.effort_unit(table.effort_unit)}"
        found.append(ServoLimit(interface, value, f"{table.items[limit.name].title} = {raw}, {written}"))
    return tuple(found)


def hold_servo(one: Access, wanted: Mode, *, inward: bool = False) -> Program[HoldResult]:
    """Switch a servo's torque on at its present position: write a goal that causes no motion, then torque on,
    and read both back.

    A servo outside its limits is refused. With `inward` it moves back to them slowly instead: a servo that
    followed an effort may have coasted beyond its limits, and without torque its joint would fall.
    """
    servo, mode, position = one.servo, one.servo.mode_plan(wanted), None
    if mode.goals[-1].position is not None:
        state = yield from one.read_bytes(servo.state.address, servo.state.length)
        if not state.answered:
            return HoldResult("did not answer when torque was to be switched on")
        present = servo.state.position.tick(state.parameters)
        if servo.extended and not mode.lower_tick <= present <= mode.upper_tick:
            servo = nearest_turn(servo, present)  # at the start its turn is not known yet
            mode = servo.mode_plan(wanted)
        position = min(max(present, mode.lower_tick), mode.upper_tick)
        beyond = abs(position - present)
        unwound = servo.continuous and beyond * servo.rad_per_tick > FARTHEST_INWARD
        if beyond > 1 and (unwound or not inward):
            return HoldResult(servo.outside_limits(present, mode.lower_tick, mode.upper_tick))
    slow, most_effort, speed_limits = 0, 0, dict[OwnLimit, int]()
    if mode.speed is not None and any(layout.position and layout.speed for layout in mode.goals):
        speed_limits = yield from read_limits(one, ("speed",))
        slow = round(ENGAGE_SPEED / mode.speed.per_tick)
        # At least 1: Profile Velocity (112) and Moving Speed (32) take 0 for the highest speed.
        slow = max(1, min(slow, mode.speed.most, *speed_limits.values()))
    if position is not None and len(mode.goals) > 1:
        most_effort, problem = yield from _most_effort(one, mode)
        if problem:
            return HoldResult(problem)
    # Write the goal first: torque on with a stale goal would move the joint.
    data = b""
    for layout in mode.goals:
        data = _resting(mode, layout, position, slow, most_effort)
        reply = yield from one.write_bytes(layout.address, data)
        if not reply.answered:
            zero = [one.items[limit.name].title for limit, raw in speed_limits.items() if raw == 0]
            refused = reply.outcome is TransactionOutcome.REFUSED
            hint = f"; raise its {zero[0]} from 0 to 1 or more" if zero and refused else ""
            return HoldResult(f"did not acknowledge its goal{one.reason(reply)}{hint}")
    reply = yield from one.write_bytes(servo.torque_address, b"\x01")
    if not reply.answered:
        return HoldResult(f"did not acknowledge torque enable{one.reason(reply)}")
    problem = yield from _read_back(one, mode.goals[-1], data)
    return HoldResult(problem, None if problem else position)


def _most_effort(one: Access, mode: ModePlan) -> Program[tuple[int, str]]:
    """Read the servo's own effort limit; return (ticks, problem). With a problem it must not become the goal.

    If the goal register is Torque Limit, a value of 0 shows a shutdown, which a goal would undo.
    """
    limits = yield from read_limits(one, ("effort",))
    most = next(iter(limits.values()), 0)
    place = one.servo.torque_limit
    if place is None or not limits_positions(one.servo, mode):
        return most, ""
    reply = yield from one.read_bytes(place.address, place.size)
    if not (most and reply.answered):
        return 0, SILENT
    return most, "" if any(reply.parameters) else f"has {place.name} = 0: it shut itself down"


def _resting(mode: ModePlan, layout: GoalLayout, position: int | None, slow: int, most_effort: int) -> bytes:
    """Return the bytes of a goal block that causes no motion: present position, slow speed, full effort; 0 in
    modes without a position.
    """
    block = bytearray(layout.length)
    goals: list[tuple[Field, int]] = []
    if layout.position is not None and position is not None:
        goals.append((layout.position, position))
        if layout.speed is not None and slow:
            goals.append((layout.speed, slow))
    elif layout.effort is not None and mode.effort is not None:
        # The limit comes from the servo's reply, which may contain any value.
        goals.append((layout.effort, min(most_effort, mode.effort.most)))
    for place, ticks in goals:
        signed = place.encoding == "twos_complement"
        data = ticks.to_bytes(place.size, "little", signed=signed)
        block[place.offset : place.offset + place.size] = data
    return bytes(block)


def _read_back(one: Access, layout: GoalLayout, data: bytes) -> Program[str]:
    torque, place = one.servo.torque_address, layout.leading
    start, end = layout.address + place.offset, layout.address + place.offset + place.size
    if torque < start and end - torque <= LONGEST_BACK and one.table.readable(torque, end):
        replies = [(yield from one.read_bytes(torque, end - torque))]
    else:
        replies = [
            (yield from one.read_bytes(torque, 1)),
            (yield from one.read_bytes(start, place.size)),
        ]
    if not all(reply.answered for reply in replies):
        return "did not answer when its torque was read back"
    enabled, found = replies[0].parameters[0], bytes(replies[-1].parameters[-place.size :])
    desired = data[place.offset : place.offset + place.size]
    if enabled != 1 or found != desired:
        signed = place.encoding == "twos_complement"
        given, has = (int.from_bytes(each, "little", signed=signed) for each in (desired, found))
        return (
            f"has goal {has} and torque enable {enabled} after goal {given} and torque enable 1 were written"
        )
    return ""


def _change(one: Access, desired: ModePlan, found: Mapping[str, int], *, enabled: bool) -> Program[str]:
    """Change the mode registers of a servo with torque off, then restore the registers that this resets.

    A register at its initial value is not restored, unless the robot file declares it. Torque is not
    switched on again.

    Args:
        one: The servo.
        desired: Mode to switch to.
        found: Present values of the mode registers, by name.
        enabled: True if the servo has torque, which is then switched off first.

    Returns:
        The problem; empty on success.
    """
    kept = yield from one.read_items(_forgotten(one, desired, found))
    if kept is None:
        return "did not answer when its gains were read before its mode was changed"
    if enabled:
        reply = yield from one.torque_off()
        if not reply.answered:
            return f"did not acknowledge torque off before its mode was changed{one.reason(reply)}"
    for register in desired.operating:
        if found[register.name] != register.value and (
            problem := (yield from one.write_item(register.name, register.value))
        ):
            return problem
    now = yield from one.read_items(kept)
    if now is None:
        return "did not answer when its gains were read after its mode was changed"
    declared = one.servo.declared
    for name, value in kept.items():
        # A register at its initial value keeps the initial value of the new mode, which may differ.
        if now[name] == value or (value == one.items[name].initial and name not in declared):
            continue
        # A lower limit that was written after power-up would refuse the old value.
        bound = yield from one.read_bound(name)
        kept_value = value if bound is None else max(-bound, min(value, bound))
        if now[name] != kept_value and (problem := (yield from one.write_item(name, kept_value))):
            return problem
    return ""


def _forgotten(one: Access, desired: ModePlan, found: Mapping[str, int]) -> tuple[str, ...]:
    """Return the names of the items that this change of the operating mode resets and that must be
    restored."""
    items = one.items
    if "operating_mode" not in items:
        return ()
    names = [name for name in _RESET if name in items]
    names += [name for name in one.servo.declared if items[name].area == "RAM"]
    if Mode.PWM not in {desired.mode, mode_in(one.servo, found)} and "goal_pwm" in items:
        names.append("goal_pwm")  # it limits the effort in every other mode, also for a policy
    return tuple(dict.fromkeys(names))
