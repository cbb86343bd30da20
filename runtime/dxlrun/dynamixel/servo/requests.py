"""Requests of clients for single servos of one bus: torque on, torque off and reboot, executed in idle time.

Torque is switched on as for a returning servo: check, registers, mode, goal := measured position, torque,
read back, Bus Watchdog. The loop's goal also becomes the measured position. A servo whose torque a client
switched off stays limp until a client requests torque again.
"""

from __future__ import annotations

from functools import partial

from dxlrun.dynamixel import texts
from dxlrun.dynamixel.findings import Findings
from dxlrun.dynamixel.servo import mode_switches, watchdog
from dxlrun.dynamixel.servo.life import (
    IN_DOUBT,
    POWERLESS,
    Done,
    RequestedReboot,
    ServoEvent,
    ServoState,
)
from dxlrun.dynamixel.servo.offline import FIRST_PROBE_NS, REBOOT_NS, OfflineRecovery, rejoin
from dxlwire.modes import Mode
from dxlwire.plan.retry import retry
from dxlwire.transaction import Program, TransactionOutcome
from dxlwire.wire import protocol2


class Requests:
    """Executes clients' torque and reboot requests for the servos of one bus; `done` receives the problem of
    each, once.
    """

    def __init__(self, offline: OfflineRecovery) -> None:
        self._offline = offline
        self._life = offline.life
        self._reboots = offline.reboots
        self._desired = offline.desired

    def torque_off(self, index: int, done: Done) -> None:
        """Switch a servo's torque off until a client requests it again; an offline servo gets torque off when
        it is back.
        """
        if self._life.on(index, ServoEvent.RELEASE) is ServoState.RELEASED:
            self._offline.switch_off(index, done)
        else:
            name = self._life.servo_name(index)
            done(f"{name} does not answer; dxlrun switches its torque off when it is back")

    def torque_on(self, index: int, done: Done) -> None:
        """Switch a limp servo's torque on at its present position; a servo that already has torque only
        confirms it.
        """
        state = self._life.states[index]
        if state is ServoState.OFFLINE:
            done(f"{self._life.servo_name(index)} does not answer")
            return
        if state in POWERLESS:
            self._life.on(index, ServoEvent.REQUESTED)
        self._life.do(index, self._torque_on(index, done), "torque on")

    def queue_reboot(self, index: int, done: Done) -> None:
        """Reboot a servo of Protocol 2.0; it gets torque again when it is back if it has torque now."""
        one = self._life.access_servo(index)
        if "reboot" not in one.table.capabilities:
            done(f"{one} has no reboot instruction: switch its power off and on")
        elif self._life.offline(index):
            done(f"{one} does not answer")
        else:
            self._life.do(index, self._reboot(index, done), "the reboot")

    def _torque_on(self, index: int, done: Done) -> Program[None]:
        life, name = self._life, self._life.servo_name(index)
        if life.states[index] is not ServoState.LIMP:
            done((yield from self._torqued(index)))
            return
        problem, mode = yield from self._hold(index)
        if life.states[index] is not ServoState.LIMP:
            problem = problem or "was lost or switched off again during the request"
        elif problem:
            life.on(index, ServoEvent.RELEASE)
            yield from self._offline.limp(index)
        else:
            life.on(index, ServoEvent.TORQUE_GIVEN)
            self._desired.returned(index, mode)
            life.report_event(index, texts.torque_on_as_requested(name))
        if problem:
            life.report_event(index, texts.torque_refused(name, problem))
        done(problem and f"{name} {problem}")

    def _torqued(self, index: int) -> Program[str]:
        life, name = self._life, self._life.servo_name(index)
        if life.offline(index):
            return f"{name} was lost during the request"
        if life.states[index] is ServoState.RELEASED:
            return f"{name} was switched off again during the request"
        if life.states[index] not in IN_DOUBT:
            return ""
        back = yield from life.access_servo(index).read_torque()
        if back.answered and back.parameters[0] == 1:
            return ""
        return f"{name} did not confirm its torque; repeat the request when it answers"

    def _hold(self, index: int) -> Program[tuple[str, Mode]]:
        """Check a limp servo, write its registers and mode, and switch its torque on; return (problem without
        the servo's name, mode).
        """
        one, name, found = self._life.access_servo(index), f"{self._life.servo_name(index)} ", Findings()
        yield from self._reboots.tick(index)
        yield from watchdog.disarm(one)
        mode = self._desired.mode(index)
        place = partial(self._desired.place_servo, index)
        yield from rejoin(one, found, mode, self._desired.settings(index), place, torque=False)
        one = self._life.access_servo(index)
        found.log(self._life.events)
        if found.problems:
            return "; ".join(problem.removeprefix(name) for problem in found.problems), mode
        if (yield from self._reboots.tick(index)):
            return "rebooted during the check; repeat the request", mode
        problem = (yield from mode_switches.hold_servo(one, mode)).problem or (yield from watchdog.arm(one))
        return problem.removeprefix(name), mode

    def _reboot(self, index: int, done: Done) -> Program[None]:
        life, one = self._life, self._life.access_servo(index)
        if life.offline(index):
            done(f"{one} was lost before it was rebooted")
            return
        had_torque = life.states[index] not in POWERLESS
        yield from self._reboots.tick(index)  # Read the tick now, so the next reading can show the reboot.
        servo_id = one.servo.servo_id
        reply = yield from retry(one.line.instruct(servo_id, protocol2.reboot(servo_id)))
        if reply.outcome is TransactionOutcome.REFUSED:
            done(f"{one} rejected the reboot{one.reason(reply)}")
        elif not life.offline(index):
            # The acknowledgement may be lost: the servo's clock will show whether it rebooted.
            request = RequestedReboot(had_torque, life.now_ns() + REBOOT_NS, done)
            loss = life.begin_reboot(index, request, FIRST_PROBE_NS)
            loss.rebooted = self._reboots.tick_reading(index) is None
        else:
            done(f"{one} was lost while it was rebooted")
