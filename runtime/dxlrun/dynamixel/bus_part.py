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
    """One bus, as the part of a feature sees it.

    Writes and reads of a part are programs: generators that yield transactions of `plan_line(idle.plan)` and
    get a `Reply` for each. `idle` executes them between two cycles, by their `Urgency`.
    """

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
    """`Contribution.plan` of the feature; empty if it has none."""
    events: EventSink
    """Events for the log."""


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

        Called only in cycles that the parser read: the exchange kernel reads the others, in which every reply
        came as planned. What is due by time belongs in `schedule_idle_work`.

        Args:
            now_ns: Time of the run's clock, that of `Reply.last_ns`.
        """

    def recover_line(self) -> None:
        """Assume that whatever is on the bus was without power: its line was gone and is open again.

        Its servos answer later, each with a call of `recover_servo`.
        """

    def recover_servo(self, servo: int) -> None:
        """Assume that a servo has forgotten its registers: it was lost or rebooted, and is in order again.

        Also called when a client gave the servo torque, because a limp servo may have rebooted unnoticed.

        Args:
            servo: Index in the plan's servos.
        """

    def schedule_idle_work(self, time_ns: int) -> None:
        """Add programs to the idle time before the coming cycle; called once a cycle.

        A program that is added in each cycle fills the bus: add one when it has something to do and the one
        before has ended.

        Args:
            time_ns: Controllers' time of the coming cycle, from 0. It stands still while the run is paused.
        """


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
    """Reads at the start, after the servos were inspected and before any of them gets torque. What it adds to
    `Findings.problems`, one sentence each, refuses the start. It does not get `Contribution.plan`."""


@dataclass(frozen=True)
class SafeStage:
    """`STAGE` of `safe.py`: what a feature leaves safe at the end of a run.

    Called at every end of a run, after torque off, or after the joints were stopped where torque stays on.
    The loop's process does that, or the guardian after the loop died, so the file imports no numpy and uses
    nothing that `runtime.py` has found.
    """

    FILE: ClassVar[str] = "safe"

    make_safe: Callable[[Lines, bytes], tuple[str, ...]]
    """Gets the lines and `Contribution.plan` of the feature. Returns a sentence for each failure: they
    become warnings in the log. Raises nothing. `lines.run` executes one program for each of `lines.plans`."""


@dataclass(frozen=True, slots=True)
class SafeEnd:
    """The stages that make a robot safe, each with its feature and the plan of that."""

    stages: tuple[tuple[Feature, SafeStage, bytes], ...]

    @classmethod
    def of(cls, features: Iterable[Feature], plans: Mapping[str, bytes]) -> SafeEnd:
        """Import what `make_safe` needs: when that is called, an import may not be possible any more."""
        found = stages(SafeStage, features)
        return cls(tuple((feature, stage, plans.get(feature.name, b"")) for feature, stage in found))

    def make_safe(self, lines: Lines) -> tuple[str, ...]:
        """Leave safe what features have on the lines; return a sentence for each failure."""
        sentences: list[str] = []
        for feature, stage, plan in self.stages:
            try:
                sentences += stage.make_safe(lines, plan)
            except Exception as error:  # foreign code: the other features are made safe all the same
                author = (
                    f"; report it to the author of {feature.distribution}" if feature.distribution else ""
                )
                sentences.append(
                    f"the section {feature.name} was not left safe ({type(error).__name__}: {error}){author}"
                )
        return tuple(sentences)
