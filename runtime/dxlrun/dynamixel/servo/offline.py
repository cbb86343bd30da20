"""Offline servos of one bus: probed in idle time, checked as at the start, and taken back.

A servo returns in its desired mode and with its desired registers. It has torque only when it kept it, when
the policy for returned servos gives it back after a reboot and the servo does not reboot repeatedly, or when
it had torque before a reboot that a client requested.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from dxlrun.channels.events import EventCode, Severity
from dxlrun.description.modes import Mode
from dxlrun.dynamixel.exchange.idle import IdleScheduler, Urgency
from dxlrun.dynamixel.plan.planning import plan_line
from dxlrun.dynamixel.plan.retry import ATTEMPTS, retry
from dxlrun.dynamixel.servo import modes, watchdog
from dxlrun.dynamixel.servo.checks import BusSurvey, inspect, inspect_states
from dxlrun.dynamixel.servo.desired import DesiredState
from dxlrun.dynamixel.servo.life import Done, Life, Loss, ServoEvent, ServoState
from dxlrun.dynamixel.servo.reboots import Reboots
from dxlrun.dynamixel.servo.registers import settle
from dxlrun.plan.bus_plan import BusPlan, RegisterValue
from dxlrun.plan.transaction import Outcome, Program, Reply

PROBE_NS = 1_000_000_000  # An offline servo is probed once a second (failures.md)
FIRST_PROBE_NS = 200_000_000
"""The first time a little earlier: most losses are a loose plug or a boot, which is over by then."""
REBOOT_NS = 3_000_000_000
"""How long a servo that a client rebooted may take until it is in order again [i]."""
_NOT_RECEIVED = frozenset((Outcome.TIMEOUT, Outcome.GARBLED))
_OTHER_TURN = (
    "lost count of its turns when it rebooted, so its goal would be turns away: it gets no torque again in "
    "this mode; start the run anew"
)


class Rejoined(msgspec.Struct, frozen=True):
    """What came of a servo that answers again."""

    problems: tuple[str, ...]  # Why it may take no part, one sentence each
    torqued: bool  # True when torque enable was read as 1
    written: tuple[tuple[str, str], ...]  # Joint, and what was written into its registers
    mode: Mode = Mode.UNKNOWN  # In which it is; UNKNOWN where there are problems


class Offline:
    """Probes the offline servos of one bus and takes them back."""

    def __init__(
        self, plan: BusPlan, idle: IdleScheduler, life: Life, reboots: Reboots, desired: DesiredState
    ) -> None:
        self._plan = plan
        self._idle = idle
        self._life = life
        self._reboots = reboots
        self._desired = desired

    def lose(self, index: int) -> None:
        """Take a silent servo out of the exchange, and stop it where it would go on without an end."""
        loss = self._life.lose(index, FIRST_PROBE_NS)
        if loss.had_torque and self._desired.resting(index) is not None:
            name = f"the stop of {self._plan.servos[index].joint}"
            self._idle.add(self._stop(index), Urgency.REPAIR, name, index)

    def _stop(self, index: int) -> Program[None]:
        """Write a goal of 0 to a servo that follows a velocity, an effort or a PWM: it may hear that."""
        servo = self._plan.servos[index]
        for _ in range(ATTEMPTS):
            goal = self._desired.resting(index)
            if goal is None or not self._life.offline(index):
                return
            if (yield plan_line(self._plan).write(servo.servo_id, *goal)).answered:
                return

    def look(self) -> None:
        """Let the coming idle time probe the servos that are due; called while one is offline."""
        self.expire()
        now = self._idle.now_ns()
        for index, loss in enumerate(self._life.losses):
            if loss is not None and not loss.probing and loss.probe_at_ns <= now:
                loss.probing = True
                name = f"the return of {self._plan.servos[index].joint}"
                self._idle.add(self._probe(index, loss), Urgency.REPAIR, name, index)

    def expire(self) -> None:
        """Answer the clients whose reboots take too long."""
        now = self._idle.now_ns()
        for index, loss in enumerate(self._life.losses):
            if loss is not None and loss.reboot is not None and loss.reboot.until_ns <= now:
                text = f"did not come back within {REBOOT_NS * 1e-9:g} s after its reboot: check its cable"
                self._answer(index, loss, f"{text} and power; it is probed until it is in order")

    def switch_off(self, index: int, done: Done) -> None:
        """Switch the torque of a RELEASED servo off in the coming idle time."""
        name = f"torque off of {self._plan.label(self._plan.servos[index])}"
        self._idle.add(self._switch_off(index, done), Urgency.REPAIR, name, index)

    def _switch_off(self, index: int, done: Done) -> Program[None]:
        problem = ""
        # in another state torque was requested since, or it is lost: its return keeps it limp
        if self._life.states[index] is ServoState.RELEASED and not (yield from self.limp(index)):
            problem = "did not confirm torque off; it is tried again"
        done(f"{self._plan.label(self._plan.servos[index])} {problem}" if problem else "")

    def limp(self, index: int) -> Program[bool]:
        """Switch a servo's torque off and read it back; where that fails, again when it is in order."""
        servo = self._plan.servos[index]
        for _ in range(3):
            yield plan_line(self._plan).write(servo.servo_id, servo.torque_address, b"\0")
            back = yield self._plan.torque_reads[index]
            if back.answered and back.parameters[0] == 0:
                return True
        self._life.lose(index)
        return False

    def _probe(self, index: int, loss: Loss) -> Program[None]:
        """Ping a servo; when it answers, see what became of it and take it back."""
        reply = yield plan_line(self._plan).ping(self._plan.servos[index].servo_id)
        if reply.answered and (read := self._reboots.read(index)) is not None:
            reply = yield from retry(read)
        problem = ""
        if reply.outcome in _NOT_RECEIVED:
            if reply.outcome is Outcome.GARBLED:
                problem = "answers garbled or twice: do two servos have its ID? If not, check its cable"
        else:
            rejoined = yield from self._rejoin(index, reply)
            if self._life.losses[index] is not loss:
                return  # the line was gone meanwhile: it counts as lost anew, and the next probe decides
            if not rejoined.problems:
                self._take_back(index, loss, rejoined)
                return
            problem = f"answers again, but cannot take part: {'; '.join(rejoined.problems)}"
            self._answer(index, loss, problem)
        if problem and problem != loss.problem:
            loss.problem = problem
            self._life.report(EventCode.SERVO_LOST, Severity.ERROR, index, problem)
        loss.probing, loss.probe_at_ns = False, self._idle.now_ns() + PROBE_NS

    def _rejoin(self, index: int, reply: Reply) -> Program[Rejoined]:
        """Bring a servo that answered to its desired state, with or without torque."""
        plan, servo = self._plan, self._plan.servos[index]
        if self._reboots.judge(index, reply) is None:
            enabled = yield from retry(plan.torque_reads[index])
            loss = self._life.losses[index]
            if loss is not None and loss.had_torque and enabled.answered and not enabled.parameters[0]:
                self._reboots.count(index)
        if (loss := self._life.losses[index]) is not None and loss.released:
            # before its mode: a change of it leaves the torque as it was
            yield from retry(plan_line(plan).write(servo.servo_id, servo.torque_address, b"\0"))
        if problem := (yield from watchdog.disarm(plan, servo)):
            return Rejoined((problem,), False, ())
        torque, mode = self._may_get_torque(index), self._desired.mode(index)
        if torque and servo.continuous and servo.mode_plan(mode).goals[-1].position is not None:
            torque = False
            self._life.report(EventCode.SERVO_LIMP, Severity.ERROR, index, _OTHER_TURN)
        rejoined = yield from rejoin(plan, index, torque, mode, self._desired.registers(index))
        for last in (self._desired.unlimit(index, mode), watchdog.arm(plan, servo)):
            if not rejoined.problems and (problem := (yield from last)):
                rejoined = Rejoined((problem,), False, rejoined.written)
        return rejoined

    def _may_get_torque(self, index: int) -> bool:
        """Return whether a servo gets torque back: by the policy once after a reboot, and after a reboot that
        a client requested where it had torque; not if released."""
        loss = self._life.losses[index]
        if loss is None or loss.released or not loss.rebooted:
            return False
        if loss.reboot is not None:
            return loss.reboot.had_torque
        return self._plan.servos[index].torque_on_return and not self._reboots.exhausted(index)

    def _take_back(self, index: int, loss: Loss, rejoined: Rejoined) -> None:
        life = self._life
        life.on(index, ServoEvent.RETURNED if rejoined.torqued else ServoEvent.RETURNED_LIMP)
        self._desired.returned(index, rejoined.mode)
        self._desired.report_written(rejoined.written)
        holds = rejoined.torqued and not loss.released
        how = "holding where it stands" if holds else "limp: it gets no goals"
        life.report(EventCode.SERVO_BACK, Severity.INFO, index, f"is in order and takes part again, {how}")
        if loss.released:
            life.on(index, ServoEvent.RELEASE)
            if rejoined.torqued:
                self.switch_off(index, ignore)
        elif holds:
            life.on(index, ServoEvent.TORQUE_ON)
        if not (rejoined.torqued or loss.limp_reported or loss.released):
            life.report_limp(index, 0)
        problem = "" if loss.rebooted else "answers, but did not start anew"
        if loss.reboot is not None and loss.reboot.had_torque and not (rejoined.torqued or loss.released):
            problem = problem or f"is back without torque; `dxlrun torque on {self._joint(index)}` gives it"
        self._answer(index, loss, problem)

    def _joint(self, index: int) -> str:
        return self._plan.servos[index].joint

    def _answer(self, index: int, loss: Loss, problem: str) -> None:
        request, loss.reboot = loss.reboot, None
        if request is not None:
            self._life.answered(index)
            request.done(f"{self._plan.label(self._plan.servos[index])} {problem}" if problem else "")


def ignore(problem: str) -> None:
    """Take what came of a request that no client made; an event reports what went wrong."""


def rejoin(
    plan: BusPlan,
    servo_index: int,
    torque: bool,
    mode: Mode | None = None,
    registers: Sequence[RegisterValue] | None = None,
) -> Program[Rejoined]:
    """Take one servo back that was lost or was reset, as at the start: check, set registers, then hold it.

    `torque`: switch it on; without, a limp servo stays limp and gets no goal, as a goal may switch torque on
    (protocol.md), and one that still holds keeps its torque: were torque written to it, a reboot a moment ago
    would be a way to torque that no policy gave. `mode`: None is its first one. `registers`: None are those
    that the robot file declares; see `DesiredState`.
    """
    servo = plan.servos[servo_index]
    line, mode = plan_line(plan), servo.start_mode if mode is None else mode
    found = BusSurvey()
    if (yield from inspect(plan, servo, line, found, take_over=True)):
        yield from inspect_states(plan, [servo], line, found)
    if found.problems:
        return Rejoined(tuple(found.problems), False, ())
    settled = yield from settle(plan, servo, servo.registers if registers is None else registers, line)
    written = tuple(settled.written)
    if not settled.problems and (problem := (yield from modes.enter(plan, servo, mode, again=False))):
        settled.problems.append(f"{plan.label(servo)} {problem}")
    enabled = yield from retry(plan.torque_reads[servo_index])
    if not enabled.answered:
        settled.problems.append(f"{plan.label(servo)} did not answer when its torque was read")
    if settled.problems or not torque:
        holds = not settled.problems and enabled.parameters[0] == 1
        return Rejoined(tuple(settled.problems), holds, written, mode)
    held = yield from modes.hold(plan, servo, servo.mode_plan(mode))
    if held.problem:
        return Rejoined((f"{plan.label(servo)} {held.problem}",), False, written)
    return Rejoined((), True, written, mode)
