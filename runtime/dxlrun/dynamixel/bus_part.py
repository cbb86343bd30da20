"""Bus part: interface for features (sections of the robot file, such as lights) that read or write on a bus
during a run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar, Protocol

import msgspec

from dxlrun.dynamixel.findings import Findings
from dxlrun.features import stages
from dxlrun.features.feature import Feature
from dxlwire.bus_plan import BusPlan
from dxlwire.exchange.bus_engine import Lines
from dxlwire.transaction import Program

if TYPE_CHECKING:  # the guardian makes the robot safe without numpy
    from dxlrun.channels.cycle import Floats
    from dxlrun.channels.event_records import EventSink
    from dxlwire.exchange.cyclic_reads import CyclicReads
    from dxlwire.exchange.idle import IdleScheduler
    from dxlwire.exchange.samples import BusSamples


class BusContext(msgspec.Struct, frozen=True):
    """One bus with the objects that a feature may use on it; passed to `BusStage.attach`.

    A part reads and writes with programs: generators that yield transactions of `plan_line(idle.plan)` and
    receive a `Reply` for each. `idle` executes them between two cycles, in the order of their `Urgency`.
    """

    idle: IdleScheduler
    """Executes programs on this bus in the time between two cycles; `idle.plan` is the plan of the bus."""
    reads: CyclicReads
    """Reads every servo and device of the bus in each cycle."""
    samples: BusSamples
    """Newest values that the servos and devices of this bus returned."""
    commands: Floats
    """Commands of all clients and controllers to features, SI units, in the order of `command_names`; NaN: no
    command.
    """
    command_names: Sequence[str]
    """Names of these commands, such as `light/led`."""
    plan: bytes
    """Bytes that the feature returned as `Contribution.plan` when the robot file was read; empty if it has
    none.
    """
    events: EventSink
    """Receives events for the log of the run."""


class FeatureParts(msgspec.Struct, frozen=True):
    """The features of a robot with their plans and commands; creates the parts of these features on each
    bus."""

    features: Sequence[Feature]
    command_names: Sequence[str]
    """Names of the commands of all sources, such as `light/led`, in the order of `commands`."""
    commands: Floats
    """Values of these commands in the present cycle, SI units; NaN: no command."""
    plans: Mapping[str, bytes]
    """`Contribution.plan` of each feature, by its name."""

    def attach(
        self, idle: IdleScheduler, reads: CyclicReads, samples: BusSamples, events: EventSink
    ) -> tuple[BusPart, ...]:
        """Return the parts that the features have on one bus, in the order of the features; a feature without
        work there has none.
        """
        found: list[BusPart] = []
        for feature, stage in stages(BusStage, self.features):
            plan = self.plans.get(feature.name, b"")
            context = BusContext(idle, reads, samples, self.commands, self.command_names, plan, events)
            if (part := stage.attach(context)) is not None:
                found.append(part)
        return tuple(found)


class BusPart(Protocol):
    """Code of one feature that runs with the cycles of one bus. The loop's thread calls all methods; none of
    them may block.
    """

    def judge_replies(self, now_ns: int) -> None:
        """Inspect the replies of this cycle and report changes.

        Called only in cycles that the packet parser read. The compiled exchange kernel reads the other
        cycles, in which every reply came as planned. Work that is due at a certain time belongs in
        `schedule_idle_work`.

        Args:
            now_ns: Time of the run's clock, the same as `Reply.last_ns`.
        """

    def recover_line(self) -> None:
        """Assume that all nodes of the bus lost power: the serial line was lost and has been opened again.

        The servos answer later; `recover_servo` is called for each.
        """

    def recover_servo(self, servo: int) -> None:
        """Restore what the feature wrote to a servo's RAM registers: the servo was lost or rebooted, and has
        passed the checks again.

        Also called when a client switched the servo's torque on, because a limp servo may have rebooted
        unnoticed.

        Args:
            servo: Index in the plan's servos.
        """

    def schedule_idle_work(self, time_ns: int) -> None:
        """Add programs to `idle` for the time before the coming cycle; called once a cycle.

        A program that is added in every cycle fills the bus. Add a program only when it has work to do and
        the previous one has ended.

        Args:
            time_ns: Controllers' time of the coming cycle, from 0. It does not advance while the run is
                paused.
        """


def inspect_nothing(plan: BusPlan, found: Findings) -> Program[None]:
    """Default of `BusStage.inspect`: the feature reads nothing at start-up."""
    yield from ()


class BusStage(msgspec.Struct, frozen=True):
    """`STAGE` in a feature's file `runtime.py`: creates the feature's part on each bus, in the loop
    process."""

    FILE: ClassVar[str] = "runtime"

    attach: Callable[[BusContext], BusPart | None]
    """Called once for each bus before the start. Returns the feature's part, or None if the feature has
    nothing on this bus.
    """
    inspect: Callable[[BusPlan, Findings], Program[None]] = inspect_nothing
    """Program that reads at start-up, after the servos were inspected and before any of them gets torque. A
    sentence that it adds to `Findings.problems` refuses the start. It does not receive
    `Contribution.plan`.
    """


class SafeStage(msgspec.Struct, frozen=True):
    """`STAGE` in a feature's file `safe.py`: makes the outputs of the feature safe at the end of a run.

    Called at every end of a run: after torque off, or after the joints were stopped if torque stays on. The
    caller is the loop process, or the guardian after the loop process died. The file therefore does not
    import numpy and uses no result of `runtime.py`.
    """

    FILE: ClassVar[str] = "safe"

    make_safe: Callable[[Lines, bytes], tuple[str, ...]]
    """Receives the serial lines and `Contribution.plan` of the feature. Returns a sentence for each failure,
    which becomes a warning in the log. Must not raise. `lines.run` executes one program for each of
    `lines.plans`.
    """


class SafeEnd(msgspec.Struct, frozen=True):
    """The `safe.py` stages of a robot's features, each with its feature and `Contribution.plan`; run at the
    end of a run.
    """

    stages: tuple[tuple[Feature, SafeStage, bytes], ...]

    @classmethod
    def import_stages(cls, features: Iterable[Feature], plans: Mapping[str, bytes]) -> SafeEnd:
        """Import the `safe.py` of every feature now, because an import may be impossible at the end of a
        run."""
        found = stages(SafeStage, features)
        return cls(tuple((feature, stage, plans.get(feature.name, b"")) for feature, stage in found))

    def make_safe(self, lines: Lines) -> tuple[str, ...]:
        """Run every stage on the serial lines; return a sentence for each failure. An exception in one stage
        does not stop the others.
        """
        sentences: list[str] = []
        for feature, stage, plan in self.stages:
            try:
                sentences += stage.make_safe(lines, plan)
            # Foreign code may raise anything; the other features must be made safe all the same.
            except (Exception, SystemExit) as error:
                author = (
                    f"; report it to the author of {feature.distribution}" if feature.distribution else ""
                )
                raised = f"{type(error).__name__}: {error}"
                sentences.append(f"section {feature.name} failed to set its safe state ({raised}){author}")
        return tuple(sentences)
