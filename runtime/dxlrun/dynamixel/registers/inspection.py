"""Inspection: what must be known of a servo before it may get torque; what both protocols ask alike.

Programs of transactions; nothing here waits, nothing writes a register.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from dxlrun.dynamixel.control_table import ControlItem, ControlTable, control_table
from dxlrun.dynamixel.plan.bus_plan import BusPlan, ServoPlan
from dxlrun.dynamixel.plan.line import LONGEST_RETURN_DELAY_NS, Line
from dxlrun.dynamixel.plan.mode_plan import mode_in
from dxlrun.dynamixel.plan.units import joint_position
from dxlrun.dynamixel.wire.dialect import dialect_of
from dxlrun.dynamixel.wire.transaction import Outcome, Program, Reply, Transaction
from dxlrun.mode import Mode

ATTEMPTS = 3
RETURN_ALL = 2
"""Status Return Level: every instruction is answered."""


@dataclass(slots=True)
class Survey:
    """What was found on one bus."""

    problems: list[str] = field(default_factory=list)
    """Why the robot must not start, one sentence each."""
    differences: list[tuple[str, str]] = field(default_factory=list)
    """Joint, and what its registers have that the robot file assumes otherwise."""
    servos: list[tuple[str, str]] = field(default_factory=list)
    """Joint, and what answered."""
    modes: dict[int, Mode] = field(default_factory=dict)
    """ID, and the mode in which the servo is; it is brought into its first one before it gets torque."""


def setup_line(plan: BusPlan) -> Line:
    """Return the line before the servos' return delays are known: the longest is assumed."""
    delay_ns = max(plan.return_delay_ns, LONGEST_RETURN_DELAY_NS)
    return Line(plan.baud_rate, plan.latency_ns, delay_ns, dialect_of(plan.protocol))


def persist(transaction: Transaction) -> Program[Reply]:
    """Try a transaction until it is answered, a few times; return the last reply."""
    reply = yield transaction
    for _ in range(ATTEMPTS - 1):
        if reply.answered:
            break
        reply = yield transaction
    return reply


def who(plan: BusPlan, servo: ServoPlan) -> str:
    """Return how messages call a servo."""
    return f"{servo.joint} (ID {servo.servo_id} on bus {plan.name})"


def called(item: ControlItem) -> str:
    """Return an item as the e-Manual writes it: `Torque Enable (24)`."""
    small = {"id": "ID", "cw": "CW", "ccw": "CCW"}
    words = (small.get(word, word.capitalize()) for word in item.name.split("_"))
    return f"{' '.join(words)} ({item.address})"


def shown(item: ControlItem, raw: int) -> str:
    """Return a value of an item as messages show it: that of a tripped Bus Watchdog is `255 (tripped)`.

    e-Manual XM430-W350, Bus Watchdog (98): -1 is "Bus Watchdog Error Status".
    """
    return f"{raw} (tripped)" if tripped(item, raw) else str(raw)


def tripped(item: ControlItem, raw: int) -> bool:
    """Return whether a value is that of a Bus Watchdog that ran out and stopped its servo."""
    return item.name == "bus_watchdog" and raw in (-1, (1 << 8 * item.size) - 1)


class Inspector:
    """Looks at the servos of one bus, one after the other, and collects what it finds."""

    def __init__(self, plan: BusPlan, take_over: bool, line: Line | None = None) -> None:
        self.found = Survey()
        self.plan = plan
        self.take_over = take_over
        self.line = setup_line(plan) if line is None else line

    def registers(self, servo: ServoPlan) -> Program[bool]:
        """Read what must fit the plan; return False when the servo cannot be read."""
        raise NotImplementedError

    def problem(self, servo: ServoPlan, text: str) -> None:
        """Note why the robot must not start."""
        self.found.problems.append(f"{who(self.plan, servo)} {text}")

    def table(self, servo: ServoPlan) -> ControlTable:
        """Return the control table of a servo."""
        return control_table(servo.model, self.plan.protocol)

    def after_start(self, servo: ServoPlan, name: str, raw: int) -> int:
        """Return what an item will hold when the start has written the registers that the file declares."""
        return next((one.value for one in servo.registers if one.name == name), raw)

    def unreadable(self, servo: ServoPlan, reply: Reply) -> None:
        """Say why a servo that answers pings cannot be read."""
        if reply.outcome is Outcome.TIMEOUT:
            level = called(self.table(servo).items["status_return_level"])
            self.problem(
                servo,
                f"answers pings but no read: its {level} is 0; write "
                f"{RETURN_ALL} there (writes are carried out, though not acknowledged)",
            )
        elif reply.outcome is Outcome.REFUSED:
            self.problem(servo, f"refuses to be read: {self.line.dialect.describe_error(reply.error)}")
        else:
            self.problem(
                servo, "answers reads garbled: do two servos have its ID? If not, check cable and ground"
            )

    def identity(self, servo: ServoPlan, number: int, firmware: int) -> None:
        """Compare the model, note who answered."""
        if number != servo.model_number:
            self.problem(
                servo,
                f"is model number {number}, not a {servo.model} ({servo.model_number}): correct `model` or "
                "the ID in the robot file",
            )
        self.found.servos.append(
            (servo.joint, f"{servo.model}, ID {servo.servo_id} on bus {self.plan.name}, firmware {firmware}")
        )

    def limits(self, servo: ServoPlan, lowest: int, highest: int, names: str) -> None:
        """Make sure that the servo accepts every goal of the joint."""
        if lowest <= servo.lower_tick and highest >= servo.upper_tick:
            return
        ends = sorted(math.degrees(joint_position(servo, raw)) for raw in (lowest, highest))
        self.problem(
            servo,
            f"has {names} {lowest}..{highest}, narrower than the joint's "
            f"{servo.lower_tick}..{servo.upper_tick}, and would refuse goals: write "
            f"`limits: {{position: [{ends[0]:.1f} deg, {ends[1]:.1f} deg]}}` or wider {names}",
        )

    def return_delay(self, servo: ServoPlan, raw: int) -> None:
        """Tell what a return delay beside the plan costs."""
        plan = self.plan
        more_ns = raw * 2_000 - plan.return_delay_ns
        if abs(more_ns) < 2_000:
            return
        total_ns = plan.budget.total_ns + more_ns * len(plan.servos)
        item = called(self.table(servo).items["return_delay_time"])
        self.found.differences.append(
            (
                servo.joint,
                f"{item} is {raw}, {raw * 2} us, where the robot file assumes "
                f"{plan.return_delay_ns / 1000:g} us; if all servos of bus {plan.name} have it, a cycle "
                f"takes {total_ns / 1e6:.1f} ms instead of {plan.budget.total_ns / 1e6:.1f} ms, at most "
                f"{1e9 / total_ns:.0f} Hz",
            )
        )

    def return_level(self, servo: ServoPlan, level: int) -> None:
        """Make sure that writes are acknowledged."""
        if level != RETURN_ALL:
            item = called(self.table(servo).items["status_return_level"])
            self.problem(
                servo, f"has {item} = {level}, so it acknowledges no write: write {RETURN_ALL} there"
            )

    def torque(self, servo: ServoPlan, enabled: int) -> None:
        """Refuse a servo that somebody else may be moving."""
        if enabled and not self.take_over:
            self.problem(
                servo,
                "holds torque already, so another program may be moving it: stop that one and switch the "
                "torque off, or take the robot over as it is with --take-over",
            )

    def mode(self, servo: ServoPlan, found: Mapping[str, int]) -> None:
        """Note the mode that registers, by name, select."""
        self.found.modes[servo.servo_id] = mode_in(servo, found)

    def neutral(self, servo: ServoPlan, item: ControlItem, raw: int, wanted: int, why: str) -> None:
        """Refuse a register that has not the one value that the plan counts on."""
        if raw != wanted:
            self.problem(servo, f"has {called(item)} = {raw}, {why}: write {wanted} there")
