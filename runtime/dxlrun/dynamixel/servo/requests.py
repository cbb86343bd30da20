"""Requests of clients for single servos of one bus: torque on or off, reboot; carried out in idle time.

Torque is switched on as for a servo that returns: check, registers, mode, goal := where it stands, torque,
read back, Bus Watchdog; it then goes to its goal slowly. A servo without torque on request stays so whatever
happens to it, until it is requested.
"""

from __future__ import annotations

from dxlrun.channels.events import EventCode, Severity
from dxlrun.description.modes import Mode
from dxlrun.dynamixel.control_table import control_table
from dxlrun.dynamixel.exchange.idle import IdleScheduler, Urgency
from dxlrun.dynamixel.plan.planning import plan_line
from dxlrun.dynamixel.plan.retry import retry
from dxlrun.dynamixel.servo import modes, watchdog
from dxlrun.dynamixel.servo.desired import DesiredState
from dxlrun.dynamixel.servo.life import (
    IN_DOUBT,
    POWERLESS,
    Done,
    Life,
    RequestedReboot,
    ServoEvent,
    ServoState,
)
from dxlrun.dynamixel.servo.offline import FIRST_PROBE_NS, REBOOT_NS, Offline, rejoin
from dxlrun.dynamixel.servo.reboots import Reboots
from dxlrun.dynamixel.wire import protocol2
from dxlrun.plan.bus_plan import BusPlan
from dxlrun.plan.transaction import Outcome, Program


class Requests:
    """Torque and reboots of the servos of one bus, as clients request them; each is answered once."""

    def __init__(  # noqa: PLR0917  what a bus consists of
        self,
        plan: BusPlan,
        idle: IdleScheduler,
        life: Life,
        reboots: Reboots,
        desired: DesiredState,
        offline: Offline,
    ) -> None:
        self._plan = plan
        self._idle = idle
        self._life = life
        self._reboots = reboots
        self._desired = desired
        self._offline = offline

    def torque_off(self, index: int, done: Done) -> None:
        """Switch a servo's torque off, and keep it off; of an offline one when it is back."""
        if self._life.on(index, ServoEvent.RELEASE) is ServoState.RELEASED:
            self._offline.switch_off(index, done)
        else:
            done(f"{self._name(index)} does not answer: its torque stays off when it is back")

    def torque_on(self, index: int, done: Done) -> None:
        """Switch a servo's torque on where it stands, if it has none."""
        state = self._life.states[index]
        if state is ServoState.OFFLINE:
            done(f"{self._name(index)} does not answer")
            return
        if state in POWERLESS:
            self._life.on(index, ServoEvent.REQUESTED)
        self._add(self._torque_on(index, done), "torque on", index)

    def reboot(self, index: int, done: Done) -> None:
        """Reboot a servo of Protocol 2.0; it comes back with the torque that it has now."""
        servo = self._plan.servos[index]
        if "reboot" not in control_table(servo.model, self._plan.protocol).capabilities:
            done(f"{self._name(index)} knows no reboot instruction: switch its power off and on")
        elif self._life.offline(index):
            done(f"{self._name(index)} does not answer")
        else:
            self._add(self._reboot(index, done), "the reboot", index)

    def _add(self, program: Program[None], what: str, index: int) -> None:
        self._idle.add(program, Urgency.REPAIR, f"{what} of {self._name(index)}", index)

    def _name(self, index: int) -> str:
        return self._plan.label(self._plan.servos[index])

    def _torque_on(self, index: int, done: Done) -> Program[None]:
        life = self._life
        if life.states[index] is not ServoState.LIMP:
            done((yield from self._torqued(index)))
            return
        problem, mode = yield from self._hold(index)
        if life.states[index] is not ServoState.LIMP:
            problem = problem or "was lost or switched off again meanwhile"
        elif problem:
            life.on(index, ServoEvent.RELEASE)
            yield from self._offline.limp(index)
        else:
            life.on(index, ServoEvent.RETURNED)
            self._desired.returned(index, mode)
            life.on(index, ServoEvent.TORQUE_ON)
            text = "has torque, as requested: it holds where it stands"
            life.report(EventCode.TORQUE_ON, Severity.INFO, index, text)
        if problem:
            life.report(EventCode.TORQUE_ON, Severity.WARNING, index, f"gets no torque: it {problem}")
            problem = f"{self._name(index)} {problem}"
        done(problem)

    def _torqued(self, index: int) -> Program[str]:
        if self._life.offline(index):
            return f"{self._name(index)} was lost meanwhile"
        if self._life.states[index] is ServoState.RELEASED:
            return f"{self._name(index)} was switched off again meanwhile"
        if self._life.states[index] not in IN_DOUBT:
            return ""
        back = yield from retry(self._plan.torque_reads[index])
        if back.answered and back.parameters[0] == 1:
            return ""
        return f"{self._name(index)} did not confirm its torque; ask again when it answers"

    def _hold(self, index: int) -> Program[tuple[str, Mode]]:
        """Bring a limp servo in order, and hold it; return what went wrong, behind its name, and its mode."""
        plan, servo, name = self._plan, self._plan.servos[index], f"{self._name(index)} "
        yield from self._reboots.tick(index)
        yield from watchdog.disarm(plan, servo)
        mode = self._desired.mode(index)
        found = yield from rejoin(plan, index, False, mode, self._desired.registers(index))
        self._desired.report_written(found.written)
        if found.problems:
            return "; ".join(one.removeprefix(name) for one in found.problems), mode
        if (yield from self._reboots.tick(index)):
            return "started anew while it was checked; ask again", mode
        held = yield from modes.hold(plan, servo, servo.mode_plan(mode))
        problem = held.problem or (yield from watchdog.arm(plan, servo)).removeprefix(name)
        return problem, mode

    def _reboot(self, index: int, done: Done) -> Program[None]:
        life, servo = self._life, self._plan.servos[index]
        if life.offline(index):
            done(f"{self._name(index)} was lost before it was rebooted")
            return
        had_torque = life.states[index] not in POWERLESS
        yield from self._reboots.tick(index)  # so that the next reading shows the reboot, however long ago
        packet = protocol2.reboot(servo.servo_id)
        reply = yield from retry(plan_line(self._plan).instruct(servo.servo_id, packet))
        if reply.outcome is Outcome.REFUSED:
            why = plan_line(self._plan).dialect.describe_error(reply.error)
            done(f"{self._name(index)} refuses to reboot: {why}")
        elif not life.offline(index):
            # an acknowledgement may be lost: its clock will tell whether it started anew
            request = RequestedReboot(had_torque, self._idle.now_ns() + REBOOT_NS, done)
            loss = life.reboot(index, request, FIRST_PROBE_NS)
            loss.rebooted = self._reboots.read(index) is None
        else:
            done(f"{self._name(index)} was lost while it was rebooted")
