"""Bus part: the runtime of a feature on one bus, and the stages that create it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar, Protocol

import msgspec

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


class BusContext(msgspec.Struct, frozen=True):
    """One bus with the objects that a feature's part uses on it.

    A part reads and writes with programs: generators that yield transactions of `plan_line(idle.plan)` and
    receive a `Reply` for each. `idle` executes them between two cycles, in the order of their `Urgency`.
    """

    idle: IdleScheduler
    """Scheduler of the time between two cycles; it also has the plan of the bus."""
    reads: CyclicReads
    """The reads of every cycle."""
    samples: BusSamples
    """The newest samples of the bus."""
    commands: Floats
    """Commands of all sources in the cycle's record, SI units; NaN where nothing is commanded."""
    command_names: Sequence[str]
    """Names of these commands, such as `light/led`."""
    plan: bytes
    """`Contribution.plan` of the feature; empty if it has none."""
    events: EventSink
    """Sink of events for the log."""


class FeatureParts(msgspec.Struct, frozen=True):
    """Features of a robot and the commands that they execute on its buses."""

    features: Sequence[Feature]
    command_names: Sequence[str]
    """Names of the commands of all sources, in the order of the cycle's record."""
    commands: Floats
    """Values of these commands in the record, SI units."""
    plans: Mapping[str, bytes]
    """`Contribution.plan` of each feature, by its name."""

    def attach(
        self, idle: IdleScheduler, reads: CyclicReads, samples: BusSamples, events: EventSink
    ) -> tuple[BusPart, ...]:
        """Return the features' parts on one bus, in the order of the features."""
        found: list[BusPart] = []
        for feature, stage in stages(BusStage, self.features):
            plan = self.plans.get(feature.name, b"")
            context = BusContext(idle, reads, samples, self.commands, self.command_names, plan, events)
            if (part := stage.attach(context)) is not None:
                found.append(part)
        return tuple(found)


class BusPart(Protocol):
    """Part of a feature on one bus. The loop's thread calls all methods; none of them may block."""

    def judge_replies(self, now_ns: int) -> None:
        """Report changes that the replies of this cycle show.

        Called only in cycles that the parser read. The exchange kernel reads the other cycles, in which every
        reply came as planned. Work that is due at a certain time belongs in `schedule_idle_work`.

        Args:
            now_ns: Time of the run's clock, the same as `Reply.last_ns`.
        """

    def recover_line(self) -> None:
        """Assume that all nodes of the bus lost power: their line was lost and has been opened again.

        The servos answer later; `recover_servo` is called for each.
        """

    def recover_servo(self, servo: int) -> None:
        """Assume that a servo has lost its RAM registers: it was lost or rebooted, and has been checked
        again.

        Also called when a client switched the servo's torque on, because a limp servo may have rebooted
        unnoticed.

        Args:
            servo: Index in the plan's servos.
        """

    def schedule_idle_work(self, time_ns: int) -> None:
        """Add programs to the idle time before the coming cycle; called once a cycle.

        A program that is added in every cycle fills the bus. Add a program only when it has work to do and
        the previous one has ended.

        Args:
            time_ns: Controllers' time of the coming cycle, from 0. It does not advance while the run is
                paused.
        """


def inspect_nothing(plan: BusPlan, found: Findings) -> Program[None]:
    """Read nothing at start-up."""
    yield from ()


class BusStage(msgspec.Struct, frozen=True):
    """`STAGE` of `runtime.py`: creates the part of a feature in the loop's process."""

    FILE: ClassVar[str] = "runtime"

    attach: Callable[[BusContext], BusPart | None]
    """Called once for each bus before the start. Returns None if the feature has nothing on this bus."""
    inspect: Callable[[BusPlan, Findings], Program[None]] = inspect_nothing
    """Reads at start-up, after the servos were inspected and before any of them gets torque. A sentence that
    it adds to `Findings.problems` refuses the start. It does not receive `Contribution.plan`."""


class SafeStage(msgspec.Struct, frozen=True):
    """`STAGE` of `safe.py`: makes the outputs of a feature safe at the end of a run.

    Called at every end of a run: after torque off, or after the joints were stopped if torque stays on. The
    caller is the loop's process, or the guardian after the loop process died. The file therefore does not
    import numpy and uses nothing that `runtime.py` has found.
    """

    FILE: ClassVar[str] = "safe"

    make_safe: Callable[[Lines, bytes], tuple[str, ...]]
    """Receives the lines and `Contribution.plan` of the feature. Returns a sentence for each failure, which
    becomes a warning in the log. Must not raise. `lines.run` executes one program for each of `lines.plans`.
    """


class SafeEnd(msgspec.Struct, frozen=True):
    """The stages that make a robot safe, each with its feature and that feature's plan."""

    stages: tuple[tuple[Feature, SafeStage, bytes], ...]

    @classmethod
    def of(cls, features: Iterable[Feature], plans: Mapping[str, bytes]) -> SafeEnd:
        """Import the code of every `make_safe` now: at the end of a run an import may be impossible."""
        found = stages(SafeStage, features)
        return cls(tuple((feature, stage, plans.get(feature.name, b"")) for feature, stage in found))

    def make_safe(self, lines: Lines) -> tuple[str, ...]:
        """Make the features' outputs on the lines safe; return a sentence for each failure."""
        sentences: list[str] = []
        for feature, stage, plan in self.stages:
            try:
                sentences += stage.make_safe(lines, plan)
            # Foreign code may raise anything; the other features must be made safe all the same.
            except (Exception, SystemExit) as error:
                author = (
                    f"; report it to the author of {feature.distribution}" if feature.distribution else ""
                )
                sentences.append(
                    f"the section {feature.name} was not left safe ({type(error).__name__}: {error}){author}"
                )
        return tuple(sentences)
