"""A servo's life as one state machine: its states, the events that lead from one to the next, the table.

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

TORQUE_GIVEN is the one way to torque after the start, from any state but RELEASED. Only `modes.hold` writes
torque on: it sets the goal to the measured position first. The servo then gets no goal until the loop's goal
is where the joint is, too (ANCHORED), and its torque was read once more.

What drives it are programs, generators that yield transactions to a bus and end in an event:

| program | file | events |
|---|---|---|
| start-up: check, set up, hold, confirm | `startup.py`, `checks.py` | ENGAGED, TORQUE_ON |
| read torque enable, hardware error, torque limit | `servos.py` | TORQUE_ON, TORQUE_OFF, DOUBT, LOST |
| probe an offline servo, and take it back | `offline.py` | TORQUE_GIVEN; RETURNED, TORQUE_ON; RETURNED_LIMP |
| read Realtime Tick, which shows a reboot | `offline.py`, `slow_registers.py` | LOST |
| switch torque off, until it is requested | `requests.py` | RELEASE, then LOST where it fails |
| switch torque on at a client's request | `requests.py` | REQUESTED; TORQUE_GIVEN or RELEASE |
| reboot at a client's request | `requests.py` | LOST; its return is that of an offline servo |
| change a mode | `desired.py`, `modes.py` | TORQUE_GIVEN; DOUBT where the mode is not confirmed |
| revive a servo its watchdog stopped | `watchdog_monitor.py` | WATCHDOG, then LOST where it fails |

The cyclic exchange itself has three events: a lost reply is DOUBT, many in a row are LOST, and a position
near the goal is CAUGHT_UP. The loop has one: ANCHORED. Which servos get goals, how fast they may follow them,
and which are read in a cycle follows from the state, and is changed nowhere else.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from enum import Enum, unique
from types import MappingProxyType

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.cycle import Floats, Torque
from dxlrun.channels.events import EventCode, EventSink, Severity
from dxlrun.dynamixel.bus_part import BusPart
from dxlrun.dynamixel.servo.access import Access, reach
from dxlrun.dynamixel.servo.watchdog import RETURN_SPEED
from dxlwire.exchange.cyclic_reads import CyclicReads
from dxlwire.exchange.idle import IdleScheduler, Urgency
from dxlwire.transaction import Program


@unique
class ServoState(Enum):
    """What a servo is doing."""

    LIMP = "limp"
    """Read in every cycle, without torque; it gets no goals, because a goal may switch torque on."""
    HOLDING = "holding"
    """Read in every cycle; holds its last goal, and gets no other before its torque enable was read as 1."""
    TORQUED = "torqued"  # Has torque for certain, and gets goals
    STOPPED = "stopped"
    """As HOLDING, after its watchdog stopped it or it was offline: it will go to its goal slowly."""
    RETURNING = "returning"
    """Has torque for certain, and goes to its goal at RETURN_SPEED at most, until it has caught up."""
    GIVEN = "given torque"
    """Has torque again, and holds where it is: it gets no goals before the loop's goals are there, too."""
    OFFLINE = "offline"
    """Out of the cyclic reads; probed now and then, and taken back when it is in order."""
    RELEASED = "released"
    """Read in every cycle; its torque was switched off by a client, a policy or the robot file, and stays off
    whatever policies say, until a client requests it."""


@unique
class ServoEvent(Enum):
    """What happens to a servo."""

    ENGAGED = "engaged"  # Start-up: its goal is where it stands, torque is on, both were read back
    TORQUE_ON = "torque on"  # Torque enable was read as 1
    TORQUE_OFF = "torque off"
    """Torque enable was read as 0 for a reason that is known, or a shutdown made it powerless."""
    DOUBT = "doubt"
    """Torque may be off: a reply was lost, an error raised, a mode changed without a confirmation."""
    WATCHDOG = "watchdog"  # Its Bus Watchdog has stopped it
    CAUGHT_UP = "caught up"  # It is near its goal again
    LOST = "lost"
    """It leaves the cyclic reads: silent, rebooted, its line was gone, or it cannot be trusted."""
    RETURNED = "returned"  # It takes part again, and kept its torque and its goal meanwhile
    RETURNED_LIMP = "returned limp"  # It is in order again, without torque
    TORQUE_GIVEN = "torque given"
    """Its torque was switched on where it is, or it has torque with a goal that this run did not give it."""
    ANCHORED = "anchored"  # The loop's goals for it are where it is
    REQUESTED = "requested"
    """A client requests torque: TORQUE_GIVEN follows, or RELEASE when the servo cannot get it."""
    RELEASE = "release"  # A client, a policy or the robot file switches its torque off


_ONLINE = {ServoEvent.LOST: ServoState.OFFLINE, ServoEvent.RELEASE: ServoState.RELEASED}
"""From every state in which a servo is read."""
_ENGAGED = {**_ONLINE, ServoEvent.TORQUE_GIVEN: ServoState.GIVEN}
"""From every state in which a servo may have torque."""
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
            # of RELEASE, `Loss.released` is kept until the servo is back
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
"""Every legal transition; another event in a state is a mistake of this program."""

GETS_GOALS = frozenset((ServoState.TORQUED, ServoState.RETURNING))
IN_DOUBT = frozenset((ServoState.HOLDING, ServoState.STOPPED))
"""Their torque enable is read as soon as there is time for it."""
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
"""What the robot's states have of a servo's state."""

Done = Callable[[str], None]
"""Takes what came of a request for a servo: what went wrong, or an empty text."""


class IllegalTransition(LookupError):
    """An event in a state that does not have it."""


class RequestedReboot(msgspec.Struct):
    """A reboot that a client requested, until the servo is back or the time for that is over."""

    had_torque: bool  # It had torque before, and gets it back
    until_ns: int  # When the client gets its answer at the latest
    done: Done  # Takes what went wrong, or an empty text


class Loss(msgspec.Struct):
    """What is known of a servo while it is OFFLINE."""

    had_torque: bool
    """It had torque when it was lost: torque that is off now shows a reboot, where no clock does."""
    kept_goal: bool  # Its goal is the last one that the loop sent
    limp_reported: bool  # That it has no torque was reported already
    released: bool  # It is to be RELEASED when it is back
    rebooted: bool  # A reboot was counted since it took part
    probe_at_ns: int  # When it is probed next
    probing: bool = False  # A probe is under way, or waits for idle time
    problem: str = ""  # Why it could not be taken back, as reported last
    reboot: RequestedReboot | None = None  # The client's request that it is offline for

    @property
    def kept_torque(self) -> bool:
        """True where torque that is still on is the torque that the servo had, with the goal that it had."""
        return self.had_torque and self.kept_goal and not self.rebooted


class Life:
    """The state of each servo of one bus, and what follows from it; programs that drive it wait in `idle`."""

    def __init__(
        self, idle: IdleScheduler, reads: CyclicReads, events: EventSink, parts: Sequence[BusPart] = ()
    ) -> None:
        """`parts`: of features, which learn that a servo returned."""
        count = len(idle.plan.servos)
        self._all_torqued = b"\1" * count
        self.plan = idle.plan
        self.events = events
        self.parts = parts
        self.idle = idle
        self.reads = reads  # The cyclic reads, without the servos that are OFFLINE
        self.states = [ServoState.LIMP] * count  # The state of each servo
        self.losses: dict[int, Loss] = {}  # Of each servo that is OFFLINE, by its index
        self.torqued: NDArray[np.bool_] = np.zeros(count, dtype=np.bool_)
        """Shape (servos,): the servos that get goals; memory that the exchange kernel shares."""
        self.torque: NDArray[np.uint8] = np.full(count, Torque.OFF, dtype=np.uint8)
        """Shape (servos,), a Torque: what the robot's states have of each servo from the next read on."""
        self.torque_changed = True  # It is another one than the robot's states show
        self.ceiling: Floats = np.full(count, np.nan)
        """Shape (servos,): the highest speeds toward positions, rad/s; NaN: no limit but that of the goal."""

    def on(self, index: int, event: ServoEvent) -> ServoState:
        """Change a servo's state by an event, and return it; raises IllegalTransition."""
        before = self.states[index]
        after = TRANSITIONS[before].get(event)
        if after is None:
            raise IllegalTransition(
                f"{self.name(index)} is {before.value}, where {event.value} cannot happen"
            )
        self.states[index] = after
        self.torqued[index] = after in GETS_GOALS
        if after is not before:
            self._show(index, _SHOWN[after])
        slow = RETURN_SPEED * self.plan.servos[index].ratio
        self.ceiling[index] = slow if after in _SLOW else np.nan
        loss = self.losses.get(index)
        if event is ServoEvent.LOST:
            self.losses[index] = self._loss(before, loss)
            self.reads.leave(index)
        elif loss is not None and event is ServoEvent.RELEASE:
            loss.released = True
        elif loss is not None and after is not ServoState.OFFLINE:
            del self.losses[index]
            self.reads.join(index)
        return after

    def give_torque(self, index: int) -> None:
        """Record that `modes.hold` gave a servo torque where it is; of a lost one: its goal is another."""
        if self.offline(index):
            self.losses[index].kept_goal = False
        elif self.states[index] not in POWERLESS:
            self.on(index, ServoEvent.TORQUE_GIVEN)

    def lose(self, index: int, probe_after_ns: int = 0) -> Loss:
        """Take a servo out of the exchange, to be probed after a while until it is in order."""
        self.on(index, ServoEvent.LOST)
        loss = self.losses[index]
        loss.probe_at_ns += probe_after_ns
        return loss

    def reboot(self, index: int, request: RequestedReboot, probe_after_ns: int) -> Loss:
        """Take a servo that reboots by request out of the exchange, until it is back or `answered`."""
        loss = self.lose(index, probe_after_ns)
        loss.reboot = request
        self._show(index, Torque.REBOOTING)
        return loss

    def answered(self, index: int) -> None:
        """Show a servo whose requested reboot is over and that is still OFFLINE as lost."""
        if self.offline(index):
            self._show(index, Torque.LOST)

    def _show(self, index: int, torque: Torque) -> None:
        self.torque[index] = torque
        self.torque_changed = True

    def _loss(self, before: ServoState, earlier: Loss | None) -> Loss:
        """Return what is known of a servo that is lost, in a state or once more."""
        powerless = before in POWERLESS if earlier is None else earlier.limp_reported
        return Loss(
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
        """True when every servo gets goals: none is offline, none in doubt."""
        return self.torqued.tobytes() == self._all_torqued  # a tenth of the time of looking at the states

    def offline(self, index: int) -> bool:
        """Return whether a servo is out of the exchange."""
        return self.states[index] is ServoState.OFFLINE

    def now_ns(self) -> int:
        """Return the time."""
        return self.idle.now_ns()

    def reach(self, index: int) -> Access:
        """Return the access to a servo."""
        return reach(self.plan, self.plan.servos[index])

    def name(self, index: int) -> str:
        """Return what messages call a servo."""
        return self.plan.label(self.plan.servos[index])

    def do(self, index: int, program: Program[None], what: str, urgency: Urgency = Urgency.REPAIR) -> None:
        """Let a program about a servo be carried out in idle time; `what`: as `torque enable`."""
        self.idle.add(program, urgency, f"{what} of {self.name(index)}", index)

    def report(self, code: EventCode, severity: Severity, index: int, text: str) -> None:
        """Log an event of a servo; `text` stands behind its name."""
        self.events.emit(code, severity, self.plan.servos[index].joint, f"{self.name(index)} {text}")

    def report_limp(self, index: int, enabled: int) -> None:
        """Log that a servo was found without torque."""
        item = f"Torque Enable ({self.plan.servos[index].torque_address})"
        text = f"has {item} = {enabled}: it was reset or its torque was cut; it gets no goals"
        self.report(EventCode.SERVO_LIMP, Severity.ERROR, index, text)
