"""Offline servos: servos of one bus that were lost are probed in idle time, checked as at start-up, and
recovered.

A servo returns in its desired mode and with its desired registers. It has torque in three cases only: it kept
its torque; the policy for returned servos gives torque back after a reboot and the servo does not reboot
repeatedly; or it had torque before a reboot that a client requested.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from msgspec.structs import replace

from dxlrun.dynamixel import texts
from dxlrun.dynamixel.findings import Findings
from dxlrun.dynamixel.remedies import CHECK, choose_remedy
from dxlrun.dynamixel.servo import mode_switches, watchdog
from dxlrun.dynamixel.servo.checks import inspect_servo, inspect_states, place_in_turn
from dxlrun.dynamixel.servo.desired import DesiredState
from dxlrun.dynamixel.servo.item_access import Access
from dxlrun.dynamixel.servo.life import Done, Life, OfflineServo, ServoEvent, ServoState
from dxlrun.dynamixel.servo.reboots import Reboots
from dxlrun.dynamixel.servo.registers import write_registers
from dxlwire.bus_plan import RegisterValue, ServoPlan
from dxlwire.modes import Mode
from dxlwire.plan.retry import ATTEMPTS, limit_patience, retry
from dxlwire.transaction import Program, Reply, TransactionOutcome

PROBE_NS = 1_000_000_000  # probe period of an offline servo (failures.md)
FIRST_PROBE_NS = 200_000_000
"""Delay of the first probe after a loss, ns. Most losses are a loose plug or a boot, which is over by then.
"""
REBOOT_NS = 3_000_000_000
"""Timeout (ns) for a servo that a client rebooted to pass the checks again [i]."""


class OfflineRecovery:
    """Probes the offline servos of one bus and recovers those that answer. Servos are indices in the plan."""

    def __init__(self, life: Life, reboots: Reboots, desired: DesiredState) -> None:
        self.life = life
        self.reboots = reboots
        self.desired = desired

    def lose(self, index: int) -> None:
        """Remove a servo that stopped answering from the cyclic reads; send it a goal of 0 if it follows no
        position.
        """
        loss = self.life.lose(index, FIRST_PROBE_NS)
        if loss.had_torque and self.desired.resting(index) is not None:
            loss.kept_goal = False
            self.life.do(index, limit_patience(self._stop(index)), "the stop")

    def _stop(self, index: int) -> Program[None]:
        """Write a goal of 0 to an offline servo that follows no position: it may still receive even if it
        does not answer.
        """
        for _ in range(ATTEMPTS):
            goal = self.desired.resting(index)
            if goal is None or not self.life.offline(index):
                return
            if (yield self.life.access_servo(index).writing(*goal)).answered:
                return

    def schedule_probes(self) -> None:
        """Schedule a ping for each offline servo whose next probe is due; called once a cycle while a servo
        is offline.
        """
        self.expire_reboots()
        now = self.life.now_ns()
        for index, loss in sorted(self.life.losses.items()):
            if not loss.probing and loss.probe_at_ns <= now:
                loss.probing = True
                self.life.do(index, self._probe(index, loss), "the return")

    def expire_reboots(self) -> None:
        """Report failure to the clients whose requested reboot did not bring the servo back in time."""
        now = self.life.now_ns()
        for index, loss in sorted(self.life.losses.items()):
            if loss.reboot is not None and loss.reboot.until_ns <= now:
                text = f"did not answer within {REBOOT_NS * 1e-9:g} s after its reboot"
                remedy = choose_remedy(self.life.bus.plan.port, CHECK)
                self._answer(index, loss, f"{text}: {remedy}; dxlrun probes it until it is ready")

    def switch_off(self, index: int, done: Done) -> None:
        """Switch off the torque of a RELEASED servo in idle time; `done` receives the problem."""
        self.life.do(index, self._switch_off(index, done), "torque off")

    def _switch_off(self, index: int, done: Done) -> Program[None]:
        problem = ""
        # In any other state a client requested torque since then, or the servo is lost; its return keeps it
        # limp.
        if self.life.states[index] is ServoState.RELEASED and not (yield from self.limp(index)):
            problem = f"{self.life.servo_name(index)} did not confirm torque off; dxlrun sends it again"
        done(problem)

    def limp(self, index: int) -> Program[bool]:
        """Write torque off to a servo and read it back; return True if it is confirmed.

        A servo that does not confirm counts as lost, so its return switches its torque off.
        """
        one = self.life.access_servo(index)
        for _ in range(ATTEMPTS):
            # The read-back decides, so the acknowledgement is not worth a long wait.
            yield replace(one.writing(one.servo.torque_address, b"\0"), patience_ns=0)
            back = yield one.reading(one.servo.torque_address, 1)
            if back.answered and back.parameters[0] == 0:
                return True
        self.life.lose(index)
        return False

    def _probe(self, index: int, loss: OfflineServo) -> Program[None]:
        """Ping an offline servo; if it answers, check and recover it, otherwise set the time of the next
        probe.
        """
        life, one = self.life, self.life.access_servo(index)
        reply = yield one.line.ping(one.servo.servo_id)
        if reply.answered and (read := self.reboots.tick_reading(index)) is not None:
            reply = yield from retry(read)
        event = None
        if reply.outcome is TransactionOutcome.GARBLED:
            remedy = choose_remedy(life.bus.plan.port, " If not, check its cable", simulated="")
            event = texts.servo_garbled(life.servo_name(index), remedy)
        if reply.outcome not in (TransactionOutcome.TIMEOUT, TransactionOutcome.GARBLED):
            found = Findings()
            torqued, mode = yield from self._rejoin(index, reply, found)
            if life.losses.get(index) is not loss:
                # The line was lost during the check: the servo counts as lost again, and the next probe
                # decides.
                return
            if not found.problems:
                found.log(life.events)
                self._take_back(index, loss, torqued, mode)
                return
            problems = [each.removeprefix(f"{one} ") for each in found.problems]
            event = texts.servo_unfit(life.servo_name(index), problems)
            self._answer(index, loss, texts.unfit_clause(problems))
        if event is not None and event.text != loss.problem:
            loss.problem = event.text
            life.report_event(index, event)
        loss.probing, loss.probe_at_ns = False, life.now_ns() + PROBE_NS

    def _rejoin(self, index: int, reply: Reply, found: Findings) -> Program[tuple[bool, Mode]]:
        """Bring a servo that answered a probe to its desired registers and mode; return (has torque, mode).
        Problems go to `found`.
        """
        life, one, servo = self.life, self.life.access_servo(index), self.life.bus.plan.servos[index]
        if self.reboots.detect_reboot(index, reply) is None:
            enabled = yield from one.read_torque()
            loss = life.losses.get(index)
            if loss is not None and loss.had_torque and enabled.answered and not enabled.parameters[0]:
                self.reboots.count(index)
        if (loss := life.losses.get(index)) is not None and loss.released:
            # Switch torque off before the mode: a change of the mode would restore it.
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
                life.report_event(index, texts.turns_lost(life.servo_name(index), servo.joint))
        place = partial(self.desired.place_servo, index)
        torqued = yield from rejoin(one, found, mode, self.desired.settings(index), place, torque=torque)
        if not found.problems:
            yield from self.desired.read_limits(index)
            yield from self.desired.restore_torque_limit(index, mode, found)
        if not found.problems and (problem := (yield from watchdog.arm(one))):
            found.problems.append(problem)
        return torqued, mode

    def _may_get_torque(self, index: int) -> bool:
        """Return True if a returning servo without torque gets torque back.

        The policy gives it back after a reboot, unless the servo reboots repeatedly. A requested reboot gives
        it back if the servo had torque before. A released servo gets none.
        """
        loss = self.life.losses.get(index)
        if loss is None or loss.released or not loss.rebooted:
            return False
        if loss.reboot is not None:
            return loss.reboot.had_torque
        return self.life.bus.plan.servos[index].torque_on_return and not self.reboots.exhausted(index)

    def _take_back(self, index: int, loss: OfflineServo, torqued: bool, mode: Mode) -> None:
        life, back = self.life, texts.servo_back_limp
        if loss.released or not torqued:
            life.on(index, ServoEvent.RETURNED_LIMP)
        elif loss.kept_torque and self.desired.mode_shown(index) is mode:
            life.on(index, ServoEvent.RETURNED)
            life.on(index, ServoEvent.TORQUE_ON)
            back = texts.servo_back_with_goal
        else:
            life.on(index, ServoEvent.TORQUE_GIVEN)
            back = texts.servo_back_holding
        if loss.rebooted and life.bus.plan.servos[index].continuous:
            life.reads.samples.restart_count(index)
        self.desired.returned(index, mode)
        life.report_event(index, back(life.servo_name(index)))
        if loss.released:
            life.on(index, ServoEvent.RELEASE)
            if torqued:
                self.switch_off(index, ignore)
        if not (torqued or loss.limp_reported or loss.released):
            life.report_limp(index, 0)
        problem = "" if loss.rebooted else "answers, but did not reboot"
        if loss.reboot is not None and loss.reboot.had_torque and not (torqued or loss.released):
            joint = life.bus.plan.servos[index].joint
            problem = problem or f"is back and limp; switch its torque on with `dxlrun torque on {joint}`"
        self._answer(index, loss, problem)

    def _answer(self, index: int, loss: OfflineServo, problem: str) -> None:
        request, loss.reboot = loss.reboot, None
        if request is not None:
            self.life.answered(index)
            request.done(problem and f"{self.life.servo_name(index)} {problem}")


def ignore(problem: str) -> None:
    """Callback for requests whose result nobody awaits; an event already reports the problem."""


def rejoin(
    one: Access,
    found: Findings,
    mode: Mode,
    registers: Sequence[RegisterValue],
    place: Callable[[ServoPlan], None],
    *,
    torque: bool,
) -> Program[bool]:
    """Bring one servo that was lost or reset into the run again: check it, write its registers and mode, then
    hold it.

    Without `torque` a limp servo stays limp and gets no goal, because a goal may switch torque on
    (protocol.md). A servo that still holds keeps its torque without a write: if it rebooted a moment ago, the
    write would give it torque that no policy permits.

    Args:
        one: The servo.
        found: Collects the problems.
        mode: Desired mode.
        registers: Desired registers, in the order of writing.
        place: Called with the plan of the servo in the turn in which it is now.
        torque: True: switch torque on.

    Returns:
        True if torque enable was read as 1 and no problem was found.
    """
    seen = Findings()  # Drop the events, which a start has logged; but report settings that changed since.
    if (present := (yield from inspect_servo(one, seen, take_over=True))) is not None:
        yield from inspect_states([present], seen)
    if seen.problems:
        found.problems += seen.problems
        return False
    ours = {register.name for register in registers}
    found.deviations += (each for each in seen.deviations if each[2].item.name not in ours)
    yield from write_registers(one, registers, found)
    if not found.problems and (problem := (yield from mode_switches.enter_mode(one, mode, again=False))):
        found.problems.append(f"{one} {problem}")
    if not found.problems:
        placed = yield from place_in_turn(one, found)
        place(placed)
        one = one.placed(placed)
    enabled = yield from one.read_torque()
    if not enabled.answered:
        found.problems.append(f"{one} did not answer when its torque was read")
    if found.problems or not torque:
        return not found.problems and enabled.parameters[0] == 1
    held = yield from mode_switches.hold_servo(one, mode)
    if held.problem:
        found.problems.append(f"{one} {held.problem}")
    return not held.problem
