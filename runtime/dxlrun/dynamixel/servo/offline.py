"""Offline servos of one bus: probed in idle time, checked as at the start, and taken back.

A servo returns in its desired mode and with its desired registers. It has torque only when it kept it, when
the policy for returned servos gives it back after a reboot and the servo does not reboot repeatedly, or when
it had torque before a reboot that a client requested.
"""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import replace

from dxlrun.channels.events import EventCode, Severity
from dxlrun.dynamixel.findings import Findings
from dxlrun.dynamixel.remedies import CHECK, choose_remedy
from dxlrun.dynamixel.servo import modes, watchdog
from dxlrun.dynamixel.servo.access import Access
from dxlrun.dynamixel.servo.checks import inspect, inspect_states
from dxlrun.dynamixel.servo.desired import DesiredState
from dxlrun.dynamixel.servo.life import Done, Life, Loss, ServoEvent, ServoState
from dxlrun.dynamixel.servo.reboots import Reboots
from dxlrun.dynamixel.servo.registers import settle
from dxlwire.bus_plan import RegisterValue
from dxlwire.modes import Mode
from dxlwire.plan.retry import ATTEMPTS, limit_patience, retry
from dxlwire.transaction import Outcome, Program, Reply

PROBE_NS = 1_000_000_000  # An offline servo is probed once a second (failures.md)
FIRST_PROBE_NS = 200_000_000
"""The first time a little earlier: most losses are a loose plug or a boot, which is over by then."""
REBOOT_NS = 3_000_000_000
"""How long a servo that a client rebooted may take until it is in order again [i]."""


class Offline:
    """Probes the offline servos of one bus and takes them back."""

    def __init__(self, life: Life, reboots: Reboots, desired: DesiredState) -> None:
        self.life = life
        self.reboots = reboots
        self.desired = desired

    def lose(self, index: int) -> None:
        """Take a silent servo out of the exchange, and stop it where it would go on without an end."""
        loss = self.life.lose(index, FIRST_PROBE_NS)
        if loss.had_torque and self.desired.resting(index) is not None:
            loss.kept_goal = False
            self.life.do(index, limit_patience(self._stop(index)), "the stop")

    def _stop(self, index: int) -> Program[None]:
        """Write a goal of 0 to a servo that follows a velocity, an effort or a PWM: it may hear that."""
        for _ in range(ATTEMPTS):
            goal = self.desired.resting(index)
            if goal is None or not self.life.offline(index):
                return
            if (yield self.life.reach(index).writing(*goal)).answered:
                return

    def look(self) -> None:
        """Let the coming idle time probe the servos that are due; called while one is offline."""
        self.expire()
        now = self.life.now_ns()
        for index, loss in sorted(self.life.losses.items()):
            if not loss.probing and loss.probe_at_ns <= now:
                loss.probing = True
                self.life.do(index, self._probe(index, loss), "the return")

    def expire(self) -> None:
        """Answer the clients whose reboots take too long."""
        now = self.life.now_ns()
        for index, loss in sorted(self.life.losses.items()):
            if loss.reboot is not None and loss.reboot.until_ns <= now:
                text = f"did not come back within {REBOOT_NS * 1e-9:g} s after its reboot"
                remedy = choose_remedy(self.life.plan.port, CHECK)
                self._answer(index, loss, f"{text}: {remedy}; it is probed until it is in order")

    def switch_off(self, index: int, done: Done) -> None:
        """Switch the torque of a RELEASED servo off in the coming idle time."""
        self.life.do(index, self._switch_off(index, done), "torque off")

    def _switch_off(self, index: int, done: Done) -> Program[None]:
        problem = ""
        # in another state torque was requested since, or it is lost: its return keeps it limp
        if self.life.states[index] is ServoState.RELEASED and not (yield from self.limp(index)):
            problem = f"{self.life.name(index)} did not confirm torque off; it is tried again"
        done(problem)

    def limp(self, index: int) -> Program[bool]:
        """Switch a servo's torque off and read it back; where that fails, again when it is in order."""
        one = self.life.reach(index)
        for _ in range(ATTEMPTS):
            yield replace(one.writing(one.servo.torque_address, b"\0"), patience_ns=0)
            back = yield one.reading(one.servo.torque_address, 1)
            if back.answered and back.parameters[0] == 0:
                return True
        self.life.lose(index)
        return False

    def _probe(self, index: int, loss: Loss) -> Program[None]:
        """Ping a servo; when it answers, see what became of it and take it back."""
        life, one = self.life, self.life.reach(index)
        reply = yield one.line.ping(one.servo.servo_id)
        if reply.answered and (read := self.reboots.read(index)) is not None:
            reply = yield from retry(read)
        problem = ""
        if reply.outcome is Outcome.GARBLED:
            remedy = choose_remedy(life.plan.port, " If not, check its cable", simulated="")
            problem = f"answers garbled or twice: do two servos have its ID?{remedy}"
        if reply.outcome not in (Outcome.TIMEOUT, Outcome.GARBLED):
            found = Findings()
            torqued, mode = yield from self._rejoin(index, reply, found)
            if life.losses.get(index) is not loss:
                return  # the line was gone meanwhile: it counts as lost anew, and the next probe decides
            if not found.problems:
                found.log(life.events)
                self._take_back(index, loss, torqued, mode)
                return
            problems = (each.removeprefix(f"{one} ") for each in found.problems)
            problem = f"answers again, but cannot take part: it {'; it '.join(problems)}"
            self._answer(index, loss, problem)
        if problem and problem != loss.problem:
            loss.problem = problem
            life.report(EventCode.SERVO_LOST, Severity.ERROR, index, problem)
        loss.probing, loss.probe_at_ns = False, life.now_ns() + PROBE_NS

    def _rejoin(self, index: int, reply: Reply, found: Findings) -> Program[tuple[bool, Mode]]:
        """Bring a servo that answered to its desired state; return whether it has torque, and its mode."""
        life, one, servo = self.life, self.life.reach(index), self.life.plan.servos[index]
        if self.reboots.judge(index, reply) is None:
            enabled = yield from one.read_torque()
            loss = life.losses.get(index)
            if loss is not None and loss.had_torque and enabled.answered and not enabled.parameters[0]:
                self.reboots.count(index)
        if (loss := life.losses.get(index)) is not None and loss.released:
            # before its mode: a change of it leaves the torque as it was
            yield from one.torque_off()
        if problem := (yield from watchdog.disarm(one)):
            found.problems.append(problem)
            return False, Mode.UNKNOWN
        yield from self._stop(index)  # it may not have received the stop when it was lost
        torque, mode = self._may_get_torque(index), self.desired.mode(index)
        if torque and servo.continuous and servo.mode_plan(mode).goals[-1].position is not None:
            torque = False
            loss = life.losses.get(index)
            if loss is not None and not loss.limp_reported:
                loss.limp_reported = True
                text = (
                    "lost count of its turns when it rebooted, so it stays limp where it is and counts from "
                    f"there; `dxlrun torque on {servo.joint}` gives it torque"
                )
                life.report(EventCode.SERVO_LIMP, Severity.ERROR, index, text)
        torqued = yield from rejoin(one, found, mode, self.desired.settings(index), torque=torque)
        if not found.problems:
            yield from self.desired.read_limits(index)
            yield from self.desired.restore_torque_limit(index, mode, found)
        if not found.problems and (problem := (yield from watchdog.arm(one))):
            found.problems.append(problem)
        return torqued, mode

    def _may_get_torque(self, index: int) -> bool:
        """Return whether a servo gets torque back: by the policy once after a reboot, and after a reboot that
        a client requested where it had torque; not if released."""
        loss = self.life.losses.get(index)
        if loss is None or loss.released or not loss.rebooted:
            return False
        if loss.reboot is not None:
            return loss.reboot.had_torque
        return self.life.plan.servos[index].torque_on_return and not self.reboots.exhausted(index)

    def _take_back(self, index: int, loss: Loss, torqued: bool, mode: Mode) -> None:
        life, how = self.life, "limp: it gets no goals"
        if loss.released or not torqued:
            life.on(index, ServoEvent.RETURNED_LIMP)
        elif loss.kept_torque and self.desired.mode_shown(index) is mode:
            life.on(index, ServoEvent.RETURNED)
            life.on(index, ServoEvent.TORQUE_ON)
            how = "with the torque and the goal that it kept"
        else:
            life.on(index, ServoEvent.TORQUE_GIVEN)
            how = "holding where it is"
        if loss.rebooted and life.plan.servos[index].continuous:
            life.reads.samples.restart_count(index)
        self.desired.returned(index, mode)
        life.report(EventCode.SERVO_BACK, Severity.INFO, index, f"is in order and takes part again, {how}")
        if loss.released:
            life.on(index, ServoEvent.RELEASE)
            if torqued:
                self.switch_off(index, ignore)
        if not (torqued or loss.limp_reported or loss.released):
            life.report_limp(index, 0)
        problem = "" if loss.rebooted else "answers, but did not start anew"
        if loss.reboot is not None and loss.reboot.had_torque and not (torqued or loss.released):
            joint = life.plan.servos[index].joint
            problem = problem or f"is back, limp; `dxlrun torque on {joint}` gives it torque"
        self._answer(index, loss, problem)

    def _answer(self, index: int, loss: Loss, problem: str) -> None:
        request, loss.reboot = loss.reboot, None
        if request is not None:
            self.life.answered(index)
            request.done(problem and f"{self.life.name(index)} {problem}")


def ignore(problem: str) -> None:
    """Take what came of a request that no client made; an event reports what went wrong."""


def rejoin(
    one: Access, found: Findings, mode: Mode, registers: Sequence[RegisterValue], *, torque: bool
) -> Program[bool]:
    """Take one servo back that was lost or was reset, as at the start: check, set registers, then hold it.

    `torque`: switch it on; without, a limp servo stays limp and gets no goal, as a goal may switch torque on
    (protocol.md), and one that still holds keeps its torque: were torque written to it, a reboot a moment ago
    would be a way to torque that no policy gave. Returns whether torque enable was read as 1, and it is in
    order.
    """
    seen = Findings()  # its events are those of a start; settings may have changed since
    if (present := (yield from inspect(one, seen, take_over=True))) is not None:
        yield from inspect_states([(one, present)], seen)
    if seen.problems:
        found.problems += seen.problems
        return False
    ours = {register.name for register in registers}
    found.deviations += (each for each in seen.deviations if each[2].item.name not in ours)
    yield from settle(one, registers, found)
    if not found.problems and (problem := (yield from modes.enter(one, mode, again=False))):
        found.problems.append(f"{one} {problem}")
    enabled = yield from one.read_torque()
    if not enabled.answered:
        found.problems.append(f"{one} did not answer when its torque was read")
    if found.problems or not torque:
        return not found.problems and enabled.parameters[0] == 1
    held = yield from modes.hold(one, mode)
    if held.problem:
        found.problems.append(f"{one} {held.problem}")
    return not held.problem
