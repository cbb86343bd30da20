"""Assembly: a plan, ports and a clock become hardware, manager, gate and loop; the same on both clocks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from dxlrun.clock import Clock
from dxlrun.compile.plan import Plan
from dxlrun.control.controllers.activity import Activity
from dxlrun.control.controllers.manager import Manager
from dxlrun.control.controllers.plugins import PlugIns
from dxlrun.control.gate import Gate
from dxlrun.control.loop import CycleSink, Loop, StopFlag
from dxlrun.dynamixel.exchange import kernel
from dxlrun.dynamixel.hardware import DynamixelHardware
from dxlrun.dynamixel.port.ports import Ports
from dxlrun.run.channels.commands import CommandSink
from dxlrun.run.channels.cycle import CycleLayout, CycleRecord
from dxlrun.run.channels.events import EventSink
from dxlrun.run.channels.inbox import Inbox, NoInbox
from dxlrun.run.channels.packets import PacketLog


class Sinks(CycleSink, Protocol):
    """Where cycles, packets and events go."""

    @property
    def packets(self) -> PacketLog:
        """Takes every packet that goes over a line."""
        ...

    @property
    def events(self) -> EventSink:
        """Takes what happens beside the cycle."""
        ...

    @property
    def commands(self) -> CommandSink:
        """Takes what controllers were handed."""
        ...


@dataclass(frozen=True, slots=True)
class Robot:
    """A robot, ready to be started."""

    hardware: DynamixelHardware
    manager: Manager
    loop: Loop
    record: CycleRecord


def cycle_layout(plan: Plan) -> CycleLayout:
    """Return the layout of the plan's cycles."""
    return CycleLayout(
        joints=tuple(joint.name for joint in plan.loop.joints),
        controllers=tuple(controller.name for controller in plan.loop.controllers),
    )


def assemble(
    plan: Plan,
    plugins: PlugIns,
    *,
    ports: Ports,
    clock: Clock,
    sinks: Sinks,
    beat: Callable[[], None],
    stop: StopFlag,
    take_over: bool = False,
    inbox: Inbox | None = None,
    patience: Callable[[int], None] = lambda _: None,
    pace: Callable[[int], None] = lambda _: None,
    activity: Activity | None = None,
) -> Robot:
    """Build everything between the ports and the log; configures the controllers, sends nothing."""
    record = CycleRecord(cycle_layout(plan))
    hardware = DynamixelHardware(
        plan.buses,
        ports,
        clock,
        record.states,
        record.goals,
        sinks.packets,
        sinks.events,
        beat,
        take_over=take_over,
        restore_torque=plan.loop.policies.reduces_torque,
        library=kernel.load(),
    )
    manager = Manager(
        plan.loop,
        plugins,
        record,
        sinks.events,
        clock,
        commands=sinks.commands,
        set_modes=hardware.set_modes,
        activity=activity,
    )
    gate = Gate(plan.loop, record, sinks.events)
    loop = Loop(
        clock=clock,
        hardware=hardware,
        manager=manager,
        gate=gate,
        record=record,
        sink=sinks,
        events=sinks.events,
        plan=plan.loop,
        beat=beat,
        stop=stop,
        inbox=inbox or NoInbox(),
        commands=sinks.commands,
        patience=patience,
        pace=pace,
        overrun_hooks=plugins.overrun_hooks,
    )
    manager.configure()
    return Robot(hardware, manager, loop, record)
