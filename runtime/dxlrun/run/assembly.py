"""Assembly: builds hardware, controllers, gate and loop of a run from a plan, for real and virtual time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import msgspec

from dxlrun.channels.commands import CommandSink, Inbox, NoInbox
from dxlrun.channels.cycle import CycleRecord
from dxlrun.channels.event_records import EventSink
from dxlrun.channels.heartbeat import Phase
from dxlrun.channels.kept import KeptStates
from dxlrun.channels.ring import Appender, RecordKind
from dxlrun.channels.topic_messages import MessageSink
from dxlrun.contract.hardware import Hardware
from dxlrun.control.context import ControlContext, Supervision, Unsupervised
from dxlrun.control.controllers.activity import Activity
from dxlrun.control.controllers.manager import Manager
from dxlrun.control.controllers.plugin_loading import PlugIns
from dxlrun.control.controllers.published_topics import TopicLog
from dxlrun.control.loop import ControlLoop, LoopResult
from dxlrun.control.sampled_sources import Slots, build_readers
from dxlrun.dynamixel.bus_part import FeatureParts
from dxlrun.dynamixel.dynamixel_hardware import DynamixelHardware, ServoArrays
from dxlrun.dynamixel.hardware_layer import HardwareLayers
from dxlrun.plan.policy_plan import Last
from dxlrun.plan.robot_plan import Plan
from dxlwire.clock import Clock
from dxlwire.exchange.bus_engine import Lines
from dxlwire.packets import PacketLog
from dxlwire.port.ports import Ports


@dataclass(slots=True)
class Sinks:
    """Destinations of a run's records (cycles, packets, events, commands, messages): rings or a log.

    Implements the loop's CycleSink.
    """

    cycles: Appender
    packets: PacketLog
    """Receives every packet that is sent or received on a bus."""
    events: EventSink
    commands: CommandSink
    progress: Callable[[int, int], None] = lambda cycles, skipped: None
    """Called after each cycle with the number of cycles and of skipped periods."""
    messages: MessageSink = field(default_factory=MessageSink)
    epoch_offset_ns: int = 0
    """Wall time minus the run's clock, ns, for the time stamps of messages."""
    wake: Callable[[int], None] = field(init=False)
    """Marks the beginning of a cycle by number: later packets belong to its period."""
    _commit: Callable[[], object] = field(init=False)
    _keep: Callable[[], object] = field(init=False)
    """Appends the cycle record from memory that is reused in each cycle."""
    ran: int = field(default=0, init=False)
    skipped: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        """Bind `wake` directly to the packet log, which saves a call in each cycle."""
        self.wake = self.packets.wake

    def append_activation(self, record: CycleRecord) -> None:
        """Record the packets of the start-up, and the cycle record in which controllers are activated."""
        self._commit = self.packets.commit_packets
        self._keep = self.cycles.make_appender(RecordKind.CYCLE, record.raw)
        self._commit()
        self._keep()

    def append_cycle(self, record: CycleRecord) -> None:
        """Append a finished cycle's record and its packets, and report the progress."""
        self._commit()
        self._keep()
        self.ran += 1
        self.skipped += record.skipped
        self.progress(self.ran, self.skipped)


@dataclass(slots=True)
class AssembledRobot:
    """A robot whose controllers are configured and whose hardware has not been started."""

    hardware: Hardware
    manager: Manager
    loop: ControlLoop
    record: CycleRecord
    failures: tuple[str, ...] = ()
    """Sentences about servos and devices that could not be switched off at the end."""

    def run(self, enter: Callable[[Phase], None] = lambda _: None) -> LoopResult:
        """Start the hardware, run the loop to its end, and disable torque unless the policy holds.

        Args:
            enter: Called with each phase that begins.

        Raises:
            StartUpError: The set-up failed.
            PortError: A port failed.
        """
        self.hardware.start(partial(enter, Phase.ENGAGING))
        last: Last = "limp"
        try:
            enter(Phase.RUNNING)
            result = self.loop.run()
            last = result.last
        finally:
            if last == "limp":
                enter(Phase.STOPPING)
                self.failures = self.hardware.stop()
            else:
                self.hardware.leave_torque_on()
        return result


class LoopHost(msgspec.Struct, frozen=True, kw_only=True):
    """Environment of a loop: ports, clock, log, client commands, and the supervision by other processes."""

    ports: Ports
    clock: Clock
    sinks: Sinks
    supervision: Supervision = msgspec.field(default_factory=Unsupervised)
    inbox: Inbox = msgspec.field(default_factory=NoInbox)
    activity: Activity = msgspec.field(default_factory=Activity)
    """Calls the controllers' methods, and publishes which one is running."""
    slots: Slots = msgspec.field(default_factory=dict)
    """Shared memory into which source processes of features write their samples."""


def assemble(
    plan: Plan,
    plugins: PlugIns,
    host: LoopHost,
    *,
    take_over: bool = False,
    kept: KeptStates | None = None,
) -> AssembledRobot:
    """Build hardware, controllers and loop of a robot. Controllers are configured; no packet is sent.

    Args:
        plan: The robot.
        plugins: Controller types and overrun hooks.
        host: Environment of the loop.
        take_over: The servos may have torque already.
        kept: States that controllers kept in earlier runs.
    """
    record, sinks = CycleRecord(plan.loop.layout), host.sinks
    layers = HardwareLayers(plan, record.states, record.goals, sinks.events)
    servos = DynamixelHardware(
        Lines(plan.buses, host.ports, host.clock, sinks.packets, host.supervision.beat),
        sinks.packets,
        ServoArrays(layers.states, layers.goals, record.sources),
        sinks.events,
        parts=FeatureParts(
            plan.features, plan.loop.source_commands, record.source_commands, plan.feature_plans
        ),
        refusals=layers.refusals,
        take_over=take_over,
    )
    context = ControlContext(
        plan=plan.loop,
        record=record,
        clock=host.clock,
        hardware=layers.build(servos),
        events=sinks.events,
        command_log=sinks.commands,
        inbox=host.inbox,
        supervision=host.supervision,
    )
    topics = TopicLog(record, sinks.messages, sinks.epoch_offset_ns)
    manager = Manager(context, plugins, activity=host.activity, topics=topics, kept=kept)
    readers = build_readers(plan.loop, host.slots, record, host.clock.now_ns, sinks.events)
    loop = ControlLoop(context, manager, sinks, overrun_hooks=plugins.overrun_hooks, readers=readers)
    manager.configure()
    return AssembledRobot(context.hardware, manager, loop, record)
