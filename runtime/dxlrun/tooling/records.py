"""Records: the contents of a log: cycles, packets, events and commands.

Times are nanoseconds of the run's clock; quantities are in SI units.

    from dxlrun import open_log
    from dxlrun.tooling.records import EventCode

    for part in open_log("run.mcap").slices():
        print(*(event.text for event in part.events if event.code is EventCode.SERVO_LOST))
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dxlwire.faces import lazy_face

if TYPE_CHECKING:
    from dxlrun.channels.answers import CommandOutcome as CommandOutcome
    from dxlrun.channels.commands import ClientCommand as ClientCommand
    from dxlrun.channels.commands import TakenCommand as TakenCommand
    from dxlrun.channels.cycle import OFFLINE as OFFLINE
    from dxlrun.channels.cycle import CycleRecord as CycleRecord
    from dxlrun.channels.cycle import Torque as Torque
    from dxlrun.channels.event_records import Event as Event
    from dxlrun.channels.event_records import EventCode as EventCode
    from dxlrun.channels.event_records import EventCounts as EventCounts
    from dxlrun.channels.event_records import EventGroup as EventGroup
    from dxlrun.channels.event_records import GoalHistory as GoalHistory
    from dxlrun.channels.event_records import GoalReport as GoalReport
    from dxlrun.channels.event_records import GoalTotals as GoalTotals
    from dxlrun.channels.event_records import LostRecords as LostRecords
    from dxlrun.channels.event_records import SchedulerGrant as SchedulerGrant
    from dxlrun.channels.event_records import Severity as Severity
    from dxlrun.channels.event_records import SimulationStall as SimulationStall
    from dxlrun.channels.event_records import StreamEnd as StreamEnd
    from dxlrun.channels.logged_packets import BEFORE_FIRST_CYCLE as BEFORE_FIRST_CYCLE
    from dxlrun.channels.logged_packets import LoggedPacket as LoggedPacket
    from dxlrun.channels.ring import RING_SECONDS as RING_SECONDS
    from dxlrun.control.steering import Play as Play
    from dxlrun.description.source_names import SOURCE_COMMAND as SOURCE_COMMAND
    from dxlrun.log.machine import load_sample as load_sample
    from dxlrun.plan.machine_load import LoadMeter as LoadMeter
    from dxlrun.plan.machine_load import LoadSample as LoadSample
    from dxlrun.plan.machine_load import MachineLoad as MachineLoad
    from dxlrun.plan.machine_load import SimulationWait as SimulationWait
else:
    __getattr__, __dir__ = lazy_face(__name__, __file__)
