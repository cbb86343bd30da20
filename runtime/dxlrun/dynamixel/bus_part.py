"""Bus part: the share of a feature on one bus, next to its servos, and the stages that ask for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Protocol

from dxlrun.dynamixel.findings import Findings
from dxlrun.features import stages
from dxlwire.bus_plan import BusPlan
from dxlwire.exchange.bus import Lines
from dxlwire.transaction import Program

if TYPE_CHECKING:  # the guardian makes the robot safe without numpy
    from dxlrun.channels.cycle import Floats
    from dxlrun.channels.events import EventSink
    from dxlwire.exchange.cyclic_reads import CyclicReads
    from dxlwire.exchange.idle import IdleScheduler
    from dxlwire.exchange.samples import BusSamples


@dataclass(frozen=True, slots=True)
class BusContext:
    """One bus, as the part of a feature sees it."""

    idle: IdleScheduler
    """Programs for the time between two cycles; it has the plan of the bus, too."""
    reads: CyclicReads
    """The reads of each cycle."""
    samples: BusSamples
    """Newest samples of the bus."""
    commands: Floats
    """Commands of all sources in the cycle's record, SI units; NaN is not commanded."""
    events: EventSink


class BusPart(Protocol):
    """Part of a feature on one bus. All methods are called in the loop's thread, and none of them waits."""

    def judge_replies(self, now_ns: int) -> None:
        """Report what changed with the replies of this cycle.

        Called in the cycles in which the parser read, which has every unexpected reply.
        """

    def recover_line(self) -> None:
        """Assume that whatever is on the bus was without power: its line was gone and is open again."""

    def schedule_idle_work(self) -> None:
        """Add programs to the idle time after this cycle."""


@dataclass(frozen=True)
class BusStage:
    """`STAGE` of `runtime.py`: the part of a feature in the loop's process."""

    FILE: ClassVar[str] = "runtime"

    inspect: Callable[[BusPlan, Findings], Program[None]]
    """Reads at the start, after the servos were inspected and before any of them gets torque."""
    attach: Callable[[BusContext], BusPart | None]
    """Called once for each bus before the start. None if the feature has nothing on this bus."""


@dataclass(frozen=True)
class SafeStage:
    """`STAGE` of `safe.py`: what a feature leaves safe at the end of a run.

    Called in the loop's process, or in the guardian after the loop died, so it imports no numpy.
    """

    FILE: ClassVar[str] = "safe"

    make_safe: Callable[[Lines], tuple[str, ...]]
    """Returns a sentence for each failure, and raises nothing."""


def load_safe_stages() -> None:
    """Import now what `make_safe` needs: when it is called, an import may not be possible any more."""
    for _ in stages(SafeStage):
        pass


def make_safe(lines: Lines) -> tuple[str, ...]:
    """Leave everything on the lines safe that is not a servo; return a sentence for each failure."""
    return tuple(problem for _, stage in stages(SafeStage) for problem in stage.make_safe(lines))
