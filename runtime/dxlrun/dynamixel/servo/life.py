"""Life of a servo as one state machine: its states, its events, and the table of transitions.

           engaged          torque on             doubt: back to HOLDING
    LIMP ---------> HOLDING ---------> TORQUED
                       | watchdog         | watchdog    ^
                       v                  v             | caught up
                    STOPPED <-------------'             |
                     ^ ^  '-- torque on --> RETURNING --'     doubt, watchdog: back to STOPPED
            anchored | | returned
      torque given -> GIVEN
      lost ---> OFFLINE -- returned limp --> LIMP
      release -> RELEASED -- requested --> LIMP -- torque given --> GIVEN

TORQUE_GIVEN is the only way to torque after the start, from any state but RELEASED. Only `modes.hold` writes
torque on, after it has set the goal to the measured position. The servo then gets no goal until the loop's
goal equals its position (ANCHORED) and its torque enable has been read once more.

Programs drive the state machine. A program is a generator that yields transactions to a bus and ends in an
event:

| program | file | events |
|---|---|---|
| start-up: check, set up, hold, confirm | `startup.py`, `checks.py` | ENGAGED, TORQUE_ON |
| read torque enable, hardware error, torque limit | `servos.py` | TORQUE_ON, TORQUE_OFF, DOUBT, LOST |
| probe and recover an offline servo | `offline.py` | TORQUE_GIVEN; RETURNED, TORQUE_ON; RETURNED_LIMP |
| read Realtime Tick, which shows a reboot | `offline.py`, `slow_registers.py` | LOST |
| switch torque off, until it is requested | `requests.py` | RELEASE, then LOST where it fails |
| switch torque on at a client's request | `requests.py` | REQUESTED; TORQUE_GIVEN or RELEASE |
| reboot at a client's request | `requests.py` | LOST; its return is that of an offline servo |
| change a mode | `desired.py`, `modes.py` | TORQUE_GIVEN; DOUBT where the mode is not confirmed |
| revive a servo that its watchdog stopped | `watchdog_monitor.py` | WATCHDOG, then LOST where it fails |

The cyclic exchange has three events: a lost reply is DOUBT, many in a row are LOST, and a position near the
goal is CAUGHT_UP. The loop has one: ANCHORED. The state alone decides which servos get goals, how fast they
may follow them, and which servos a cycle reads.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from enum import Enum, unique
from types import MappingProxyType

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.cycle import Floats, Torque
from dxlrun.channels.event_records import EventBody, EventSink
from dxlrun.dynamixel import texts
from dxlrun.dynamixel.bus_part import BusPart
from dxlrun.dynamixel.servo.item_access import Access, access_servo
from dxlrun.dynamixel.servo.watchdog import RETURN_SPEED
from dxlwire.exchange.cyclic_reads import CyclicReads
from dxlwire.exchange.idle import IdleScheduler, Urgency
from dxlwire.transaction import Program


@unique
class ServoState(Enum):
    """State of one servo of a run, as seen by the host: whether it has torque, gets goals, and is read."""

    LIMP = "limp"
    """Read in every cycle, without torque. It gets no goals, because a goal may switch torque on."""
    HOLDING = "holding"
    """Read in every cycle. It holds its last goal, and gets no new goals before its torque enable was read as
    1.
    """
    TORQUED = "torqued"  # torque is confirmed; gets goals
    STOPPED = "stopped"
    """Like HOLDING, after its Bus Watchdog stopped it or after it was offline. Once its torque is confirmed
    it moves to its goal slowly.
    """
    RETURNING = "returning"
    """Torque is confirmed. It moves to its goal at RETURN_SPEED at most, until it has caught up."""
    GIVEN = "given torque"
    """Got torque during the run and holds its position. It gets no goals before the loop's goals equal that
    position.
    """
    OFFLINE = "offline"
    """Lost: not read in the cycles. It is probed periodically, and recovered when it passes the checks."""
    RELEASED = "released"
    """Read in every cycle, without torque, which a client, a policy or the robot file switched off. Only a
    client's request switches it on again.
    """


@unique
class ServoEvent(Enum):
    """Event that changes the state of a servo; see TRANSITIONS."""

    ENGAGED = "engaged"  # start-up: goal = present position, torque on, both read back
    TORQUE_ON = "torque on"  # torque enable was read as 1
    TORQUE_OFF = "torque off"
    """Torque enable was read as 0 for a known reason, or the servo's own shutdown cut its torque."""
    DOUBT = "doubt"
    """Torque may be off: a reply was lost, an error was raised, or a mode change was not confirmed."""
    WATCHDOG = "watchdog"  # its Bus Watchdog has stopped it
    CAUGHT_UP = "caught up"  # it is near its goal again
    LOST = "lost"
    """The servo leaves the cyclic reads: it is silent, it rebooted, its line was lost, or it cannot be
    trusted.
    """
    RETURNED = "returned"  # back in the exchange, and kept its torque and its goal while offline
    RETURNED_LIMP = "returned limp"  # back in the exchange, without torque
    TORQUE_GIVEN = "torque given"
    """The servo's torque was switched on at its present position, or the servo has torque with a goal that
    this run did not send.
    """
    ANCHORED = "anchored"  # the loop's goals for it equal its position
    REQUESTED = "requested"
    """A client requests torque for a servo. TORQUE_GIVEN follows, or RELEASE if the servo cannot get torque.
    """
    RELEASE = "release"  # a client, a policy or the robot file switches its torque off


_ONLINE = {ServoEvent.LOST: ServoState.OFFLINE, ServoEvent.RELEASE: ServoState.RELEASED}
"""Transitions that every state except OFFLINE has."""
_ENGAGED = {**_ONLINE, ServoEvent.TORQUE_GIVEN: ServoState.GIVEN}
"""Transitions that every state has in which a servo may have torque."""
_S, _E = ServoState, ServoEvent

TRANSITIONS: Mapping[ServoState, Mapping[ServoEvent, ServoState]] = MappingProxyType(
    {
        _S.LIMP: {
            **_ENGAGED,
            **dict.fromkeys((_E.REQUESTED, _E.TORQUE_OFF, _E.DOUBT, _E.WATCHDOG), _S.LIMP),
            _E.ENGAGED: _S.HOLDING,
        },
        _S.HOLDING: {
            **_ENGAGED,
            _E.DOUBT: _S.HOLDING,
            _E.TORQUE_ON: _S.TORQUED,
            _E.TORQUE_OFF: _S.LIMP,
            _E.WATCHDOG: _S.STOPPED,
        },
        _S.TORQUED: {**_ENGAGED, _E.DOUBT: _S.HOLDING, _E.WATCHDOG: _S.STOPPED},
        _S.STOPPED: {
            **_ENGAGED,
            **dict.fromkeys((_E.DOUBT, _E.WATCHDOG), _S.STOPPED),
            _E.TORQUE_ON: _S.RETURNING,
            _E.TORQUE_OFF: _S.LIMP,
        },
        _S.RETURNING: {
            **_ENGAGED,
            **dict.fromkeys((_E.DOUBT, _E.WATCHDOG), _S.STOPPED),
            _E.CAUGHT_UP: _S.TORQUED,
        },
        _S.GIVEN: {
            **_ENGAGED,
            **dict.fromkeys((_E.DOUBT, _E.WATCHDOG), _S.GIVEN),
            _E.TORQUE_OFF: _S.LIMP,
            _E.ANCHORED: _S.STOPPED,
        },
        _S.OFFLINE: {
            # RELEASE sets `Loss.released`, which takes effect when the servo is back.
            **dict.fromkeys((_E.DOUBT, _E.LOST, _E.RELEASE), _S.OFFLINE),
            _E.RETURNED: _S.STOPPED,
            _E.TORQUE_GIVEN: _S.GIVEN,
            _E.RETURNED_LIMP: _S.LIMP,
        },
        _S.RELEASED: {
            **_ONLINE,
            **dict.fromkeys((_E.TORQUE_OFF, _E.DOUBT, _E.WATCHDOG), _S.RELEASED),
            _E.REQUESTED: _S.LIMP,
        },
    }
)
"""Next state by present state and event. An event that a state does not list is a bug in this program."""

GETS_GOALS = frozenset((ServoState.TORQUED, ServoState.RETURNING))
IN_DOUBT = frozenset((ServoState.HOLDING, ServoState.STOPPED))
"""States of servos that may have torque; their torque enable is read as soon as idle time permits."""
POWERLESS = frozenset((ServoState.LIMP, ServoState.RELEASED))
_SLOW = frozenset((ServoState.STOPPED, ServoState.RETURNING, ServoState.OFFLINE))
_SHOWN: Mapping[ServoState, Torque] = {
    **dict.fromkeys(GETS_GOALS, Torque.ON),
    **dict.fromkeys(IN_DOUBT, Torque.DOUBT),
    ServoState.GIVEN: Torque.GIVEN,
    ServoState.LIMP: Torque.OFF,
    ServoState.OFFLINE: Torque.LOST,
    ServoState.RELEASED: Torque.RELEASED,
}
"""Value in `torque` of the robot's states for each servo state."""

Done = Callable[[str], None]
"""Callback for the result of a request for a servo: the problem; empty on success."""


class IllegalTransition(LookupError):
    """A servo event that the servo's present state does not allow."""


class RequestedReboot(msgspec.Struct):
    """A reboot of a servo that a client requested, until the servo is back or the timeout has passed."""

    had_torque: bool  # had torque before, and gets it back
    until_ns: int  # deadline for the answer to the client
    done: Done  # receives the problem, or an empty text


class OfflineServo(msgspec.Struct):
    """Record of one servo while it is OFFLINE; it decides about torque on the servo's return."""

    had_torque: bool
    """True if the servo had torque when it was lost. Torque off on its return then shows a reboot, which
    matters for servos without Realtime Tick.
    """
    kept_goal: bool  # its goal is the last one that the loop sent
    limp_reported: bool  # the missing torque has been reported
    released: bool  # becomes RELEASED when it is back
    rebooted: bool  # a reboot was counted since the loss
    probe_at_ns: int  # time of the next probe
    probing: bool = False  # a probe runs or waits for idle time
    problem: str = ""  # last reported reason why it could not be recovered
    reboot: RequestedReboot | None = None  # the client's reboot request that caused the loss

    @property
    def kept_torque(self) -> bool:
        """True if the servo, when it still has torque, follows its old goal: it had torque and that goal when
        lost, and no reboot was seen.
        """
        return self.had_torque and self.kept_goal and not self.rebooted


class Life:
    """The state machine of each servo of one bus, by index in the plan; it updates reads, goals and shown
    torque when a state changes.
    """

    def __init__(
        self, idle: IdleScheduler, reads: CyclicReads, events: EventSink, parts: Sequence[BusPart] = ()
    ) -> None:
        """Start with every servo LIMP; `parts` are the features' parts on this bus, called when a servo
        returns.
        """
        count = len(idle.plan.servos)
        self._all_torqued = b"\1" * count
        self.events = events
        self.parts = parts
        self.idle = idle
        self.bus = idle.bus  # its plan has the servos as they are placed now
        self.reads = reads  # the cyclic reads, without OFFLINE servos
        self.states = [ServoState.LIMP] * count  # state of each servo
        self.losses: dict[int, OfflineServo] = {}  # record of each OFFLINE servo, by index
        self.torqued: NDArray[np.bool_] = np.zeros(count, dtype=np.bool_)
        """True for servos that get goals, shape (servos,); memory shared with the exchange kernel."""
        self.torque: NDArray[np.uint8] = np.full(count, Torque.OFF, dtype=np.uint8)
        """Torque value per servo for the robot's states, shape (servos,); copied there before the next cycle.
        """
        self.torque_changed = True  # `torque` differs from the robot's states
        self.ceiling: Floats = np.full(count, np.nan)
        """Highest speed toward a position goal, rad/s, shape (servos,), for the exchange kernel; NaN: only
        the goal's own limit.
        """

    def on(self, index: int, event: ServoEvent) -> ServoState:
        """Apply an event to a servo, update what depends on its state, and return the new state.

        Raises:
            IllegalTransition: The present state does not allow the event.
        """
        before = self.states[index]
        after = TRANSITIONS[before].get(event)
        if after is None:
            raise IllegalTransition(
                f"{self.servo_name(index)} is {before.value}; {event.value} is invalid in this state"
            )
        self.states[index] = after
        self.torqued[index] = after in GETS_GOALS
        if after is not before:
            self._show(index, _SHOWN[after])
        slow = RETURN_SPEED * self.bus.plan.servos[index].ratio
        self.ceiling[index] = slow if after in _SLOW else np.nan
        loss = self.losses.get(index)
        if event is ServoEvent.LOST:
            self.losses[index] = self._loss(before, loss)
            self.reads.stop_reading(index)
        elif loss is not None and event is ServoEvent.RELEASE:
            loss.released = True
        elif loss is not None and after is not ServoState.OFFLINE:
            del self.losses[index]
            self.reads.join(index)
        return after

    def give_torque(self, index: int) -> None:
        """Record that `modes.hold` switched a servo's torque on at its present position.

        An OFFLINE servo stays lost, but its old goal counts as replaced. A limp or released servo does not
        change.
        """
        if self.offline(index):
            self.losses[index].kept_goal = False
        elif self.states[index] not in POWERLESS:
            self.on(index, ServoEvent.TORQUE_GIVEN)

    def lose(self, index: int, probe_after_ns: int = 0) -> OfflineServo:
        """Remove a servo from the cyclic reads and return its record. It is first probed after
        `probe_after_ns`.
        """
        self.on(index, ServoEvent.LOST)
        loss = self.losses[index]
        loss.probe_at_ns += probe_after_ns
        return loss

    def begin_reboot(self, index: int, request: RequestedReboot, probe_after_ns: int) -> OfflineServo:
        """Remove a servo from the cyclic reads for a reboot that a client requested; the states show it as
        rebooting.
        """
        loss = self.lose(index, probe_after_ns)
        loss.reboot = request
        self._show(index, Torque.REBOOTING)
        return loss

    def answered(self, index: int) -> None:
        """End the display of a requested reboot: a servo that is still OFFLINE is shown as lost."""
        if self.offline(index):
            self._show(index, Torque.LOST)

    def _show(self, index: int, torque: Torque) -> None:
        self.torque[index] = torque
        self.torque_changed = True

    def _loss(self, before: ServoState, earlier: OfflineServo | None) -> OfflineServo:
        """Return the record of a servo that is lost in state `before`; `earlier` is its record if it was
        OFFLINE already.
        """
        powerless = before in POWERLESS if earlier is None else earlier.limp_reported
        return OfflineServo(
            had_torque=not powerless,
            kept_goal=before is not ServoState.GIVEN if earlier is None else earlier.kept_goal,
            limp_reported=powerless,
            released=before is ServoState.RELEASED if earlier is None else earlier.released,
            rebooted=earlier is not None and earlier.rebooted,
            probe_at_ns=self.now_ns(),
            reboot=None if earlier is None else earlier.reboot,
        )

    @property
    def calm(self) -> bool:
        """True if every servo of the bus gets goals: none is limp, offline, or in doubt."""
        return self.torqued.tobytes() == self._all_torqued  # ten times faster than comparing the states

    def offline(self, index: int) -> bool:
        """Return True if a servo is OFFLINE, so no cycle reads it."""
        return self.states[index] is ServoState.OFFLINE

    def now_ns(self) -> int:
        """Return the time of the run's clock, ns."""
        return self.idle.now_ns()

    def access_servo(self, index: int) -> Access:
        """Return access to a servo's items with the timeouts of the plan."""
        return access_servo(self.bus.plan, self.bus.plan.servos[index])

    def servo_name(self, index: int) -> str:
        """Return the label of a servo for messages: joint, ID and bus."""
        return self.bus.plan.label(self.bus.plan.servos[index])

    def do(self, index: int, program: Program[None], what: str, urgency: Urgency = Urgency.REPAIR) -> None:
        """Schedule a program for a servo in idle time; `what` names its object in messages, such as `torque
        enable`.
        """
        self.idle.add(program, urgency, f"{what} of {self.servo_name(index)}", index)

    def report_event(self, index: int, event: EventBody) -> None:
        """Log an event of a servo; its source is the servo's joint."""
        self.events.emit_event(self.bus.plan.servos[index].joint, event)

    def report_limp(self, index: int, enabled: int) -> None:
        """Log that a servo was found without torque; `enabled` is the value of its torque enable."""
        address = self.bus.plan.servos[index].torque_address
        self.report_event(index, texts.torque_lost(self.servo_name(index), address, enabled))
