"""One controller under the manager: its private arrays, its rows of the robot's arrays, its rules."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Collection
from typing import Any, ParamSpec

import numpy as np
from numpy.typing import NDArray

from dxlrun.control.controllers.activity import Activity
from dxlrun.control.controllers.controller import Context, Controller
from dxlrun.control.controllers.gathering import Place, place_of
from dxlrun.control.loop_plan import ControllerPlan
from dxlrun.errors import ControllerFault
from dxlrun.run.channels.cycle import Clamp, Commands, CycleRecord, Floats
from dxlrun.run.channels.heartbeat import ControllerMethod

PERIOD_CAP = 5
"""A controller is never told a period longer than this many nominal ones: a law that integrates would jump.
The guardian ends a loop that stands still for as long."""

_TRACEBACK = 6000
P = ParamSpec("P")


class Managed:
    """A configured controller; gathers before its update, checks and scatters after it."""

    def __init__(
        self,
        plan: ControllerPlan,
        controller: Controller[Any],
        context: Context,
        rows: NDArray[np.intp],
        record: CycleRecord,
        *,
        gather: Callable[[], None],
        place: int,
        activity: Activity,
    ) -> None:
        """`gather` brings the context's states and goals up to date; `place` is that of the controller."""
        self.plan = plan
        self.bit = 1 << place
        """Of the record's mask of active controllers."""
        self._place = place
        self._activity = activity
        self.active = False
        self.until_ns = 0
        """When its stream of commands runs out, ns of the clock; 0: there is none."""
        self._controller = controller
        self.gather = gather
        self._rows = rows
        self._record = record
        self._nominal_ns = context.period_ns
        self._every = plan.every
        self._held = False
        self._waiting = False
        self._last_ns = -1
        self._due_number = 0
        self._finite = np.zeros(len(rows), dtype=np.bool_)
        columns = place_of(rows)
        self._claimed = tuple(
            _Claim(name, _array(context.commands, name), _array(record.commands, name), columns)
            for name in plan.command
        )

    def activate(self, time_ns: int) -> None:
        """Let the controller take over its joints. Raises ControllerFault."""
        for claim in self._claimed:
            claim.forget()
        self.gather()
        self._call(ControllerMethod.ON_ACTIVATE, "", self._controller.on_activate, time_ns)
        self._last_ns = -1
        self._due_number = 0
        self._held = False
        self.until_ns = 0
        self.active = True

    def deactivate(self, time_ns: int) -> None:
        """Let the controller let go. Raises ControllerFault; its joints are released all the same."""
        self.release()
        self._call(ControllerMethod.ON_DEACTIVATE, "", self._controller.on_deactivate, time_ns)

    def release(self) -> None:
        """Take its commands out of the robot's: the gate holds what it last let through."""
        self.active = False
        self.until_ns = 0
        self._withdraw()

    def _withdraw(self) -> None:
        for claim in self._claimed:
            claim.withdraw()

    def command(self, kind: str, data: NDArray[np.float64], time_ns: int, until_ns: int = 0) -> None:
        """Hand over a prepared command, which runs out at `until_ns` unless that is 0. Raises
        ControllerFault."""
        self._held = False
        self.until_ns = until_ns
        self.gather()
        self._call(
            ControllerMethod.ON_COMMAND, f" ({kind})", self._controller.on_command, kind, data, time_ns
        )

    def hold(self) -> None:
        """Take its commands out of the robot's, and update it no more, until the next command."""
        self._held = True
        self._withdraw()

    def wait_for(self, lost: Collection[int]) -> bool:
        """Hold its joints as long as one that it claims is lost, of these rows; return whether that changed
        anything for the robot."""
        waiting = bool(self._claimed) and any(row in lost for row in self._rows.tolist())
        changed = waiting != self._waiting
        self._waiting = waiting
        if waiting and self.active:
            self._withdraw()
        return changed and self.active

    @property
    def waiting(self) -> bool:
        """True while one of the joints that it claims is lost."""
        return self._waiting

    def pace(self, period_ns: int, every: int) -> None:
        """Let it be updated in every n-th of the loop's periods."""
        self._every = every
        self._nominal_ns = every * period_ns
        self._due_number = 0  # turns are counted anew

    def due(self, number: int) -> bool:
        """Say whether the controller is updated in this period; a skipped turn is made up in the next one."""
        return number >= self._due_number and not (self._held or self._waiting)

    def update(self, number: int, time_ns: int) -> None:
        """Update and merge its commands into the robot's. Raises ControllerFault."""
        period_ns = self._nominal_ns if self._last_ns < 0 else time_ns - self._last_ns
        self._last_ns = time_ns
        self._due_number = (number // self._every + 1) * self._every
        self.gather()
        capped_ns = min(period_ns, PERIOD_CAP * self._nominal_ns)
        self._call(ControllerMethod.UPDATE, "", self._controller.update, time_ns, capped_ns)
        changed = [claim for claim in self._claimed if not claim.stands()]
        for claim in changed:
            np.isfinite(claim.own, self._finite)
            if np.count_nonzero(self._finite) < self._finite.size:  # a tenth of the time of all()
                self._judge(claim)
            elif not claim.all_seen:
                claim.seen.fill(True)
                claim.all_seen = True
        for claim in changed:
            claim.merge()

    @property
    def rows(self) -> NDArray[np.intp]:
        """Rows of its joints in the robot's arrays."""
        return self._rows

    def _judge(self, claim: _Claim) -> None:
        """Accept NaN where nothing was commanded yet. Raises ControllerFault for everything else."""
        wrong = ~self._finite & (claim.seen | np.isinf(claim.own))
        if wrong.any():
            self._record.clamped[self._rows[wrong]] |= np.uint8(Clamp.NOT_FINITE)
            first = int(np.flatnonzero(wrong)[0])
            after = " after a finite value" if claim.seen[first] else ""
            raise ControllerFault(
                f"controller {self.plan.name} commanded {self.plan.joints[first]}/{claim.interface} = "
                f"{claim.own[first]}{after}"
            )
        claim.seen |= self._finite

    def _call(
        self,
        step: ControllerMethod,
        what: str,
        call: Callable[P, object],
        *arguments: P.args,
        **named: P.kwargs,
    ) -> None:
        """Call a method of the controller. Raises ControllerFault for what it raises and what it starts."""
        self._activity.begin(self._place, step)
        raised: BaseException | None = None
        try:
            call(*arguments, **named)
        except (Exception, SystemExit) as error:  # foreign code: it must not take the loop along
            raised = error
        finally:
            breach = self._activity.end()
        if breach:
            raise self._fault(
                f"{breach} in {step}{what}: while the robot runs that would stop the loop; "
                "start a process in on_configure instead",
                raised,
            ) from raised
        if raised is not None:
            told = " ".join(f"{type(raised).__name__}: {raised}".split())
            raise self._fault(f"raised in {step}{what}: {told}", raised) from raised

    def _fault(self, what: str, raised: BaseException | None) -> ControllerFault:
        fault = ControllerFault(f"controller {self.plan.name} {what}")
        if raised is not None:
            fault.add_note("".join(traceback.format_exception(raised))[-_TRACEBACK:])
        return fault


class _Claim:
    """A claimed interface: the controller's own array, the robot's, and where it was ever finite."""

    __slots__ = ("_merged", "_place", "_shown", "_taken", "all_seen", "interface", "own", "seen")

    def __init__(self, interface: str, own: Floats, merged: Floats, place: Place) -> None:
        self.interface = interface
        self.own = own
        self.seen = np.zeros(len(own), dtype=np.bool_)
        self.all_seen = False
        self._merged = merged
        self._place = place
        self._shown = merged[place] if isinstance(place, slice) else None
        self._taken = b""

    def forget(self) -> None:
        """Begin anew: nothing was commanded yet."""
        self.own.fill(np.nan)
        self.seen.fill(False)
        self.all_seen = False
        self._taken = b""

    def stands(self) -> bool:
        """Say whether what is commanded is what was judged and merged before, and is still in its place."""
        own = self.own.tobytes()
        return own == self._taken and self._shown is not None and self._shown.tobytes() == own

    def merge(self) -> None:
        """Put what was judged into the robot's commands."""
        self._taken = self.own.tobytes()
        if self._shown is None:
            self._merged[self._place] = self.own
        else:
            self._shown[:] = self.own

    def withdraw(self) -> None:
        """Take it out of the robot's commands."""
        self._merged[self._place] = np.nan


def _array(commands: Commands, interface: str) -> Floats:
    array: Floats = getattr(commands, interface)
    return array
