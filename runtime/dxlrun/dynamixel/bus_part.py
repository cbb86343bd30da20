"""Bus part: the share of a feature on one bus, next to its servos, and the stages that ask for it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Protocol

from dxlrun.dynamixel.findings import Findings
from dxlrun.features import stages
from dxlrun.features.feature import Feature
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
    command_names: Sequence[str]
    """Names of these commands, such as `light/led`."""
    plan: bytes
    """`Contribution.plan` of the feature."""
    events: EventSink


@dataclass(frozen=True, slots=True)
class FeatureParts:
    """Features of a robot, and the commands that they execute on its buses."""

    features: Sequence[Feature]
    command_names: Sequence[str]
    """Names of the commands of all sources, in the order of the cycle's record."""
    commands: Floats
    """These commands in the record."""
    plans: Mapping[str, bytes]
    """`Contribution.plan` by feature."""

    def attach(
        self, idle: IdleScheduler, reads: CyclicReads, samples: BusSamples, events: EventSink
    ) -> tuple[BusPart, ...]:
        """Return the parts of features on one bus, in the order of the features."""
        found: list[BusPart] = []
        for feature, stage in stages(BusStage, self.features):
            plan = self.plans.get(feature.name, b"")
            context = BusContext(idle, reads, samples, self.commands, self.command_names, plan, events)
            if (part := stage.attach(context)) is not None:
                found.append(part)
        return tuple(found)


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


def inspect_nothing(plan: BusPlan, found: Findings) -> Program[None]:
    """Read nothing at the start."""
    yield from ()


@dataclass(frozen=True)
class BusStage:
    """`STAGE` of `runtime.py`: the part of a feature in the loop's process."""

    FILE: ClassVar[str] = "runtime"

    attach: Callable[[BusContext], BusPart | None]
    """Called once for each bus before the start. None if the feature has nothing on this bus."""
    inspect: Callable[[BusPlan, Findings], Program[None]] = inspect_nothing
    """Reads at the start, after the servos were inspected and before any of them gets torque."""


@dataclass(frozen=True)
class SafeStage:
    """`STAGE` of `safe.py`: what a feature leaves safe at the end of a run.

    Called in the loop's process, or in the guardian after the loop died, so it imports no numpy.
    """

    FILE: ClassVar[str] = "safe"

    make_safe: Callable[[Lines], tuple[str, ...]]
    """Returns a sentence for each failure, and raises nothing."""


def safe_stages(features: Iterable[Feature]) -> tuple[SafeStage, ...]:
    """Import what `make_safe` needs: when that is called, an import may not be possible any more."""
    return tuple(stage for _, stage in stages(SafeStage, features))


def make_safe(lines: Lines, features: Iterable[SafeStage]) -> tuple[str, ...]:
    """Leave everything on the lines safe that is not a servo; return a sentence for each failure."""
    return tuple(problem for stage in features for problem in stage.make_safe(lines))
