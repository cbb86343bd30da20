"""Records: the contents of a log: cycles, packets, events, commands and the messages of topics.

Times are nanoseconds of the run's clock; quantities are in SI units.

    from dxlrun import open_log
    from dxlrun.tooling.records import EventCode

    for part in open_log("run.mcap").slices():
        print(*(event.text for event in part.events if event.code is EventCode.SERVO_LOST))
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dxlrun.contract.faces import lazy_face

if TYPE_CHECKING:
    from dxlrun.channels.commands import TakenCommand as TakenCommand
    from dxlrun.channels.cycle import CycleRecord as CycleRecord
    from dxlrun.channels.cycle import Torque as Torque
    from dxlrun.channels.events import Event as Event
    from dxlrun.channels.events import EventCode as EventCode
    from dxlrun.channels.events import EventGroup as EventGroup
    from dxlrun.channels.events import GoalReport as GoalReport
    from dxlrun.channels.events import Granted as Granted
    from dxlrun.channels.events import LostRecords as LostRecords
    from dxlrun.channels.events import Severity as Severity
    from dxlrun.messages.cdr import Codec as Codec
    from dxlrun.messages.declared import declared_message as declared_message
    from dxlrun.messages.definition import MessageType as MessageType
    from dxlwire.packets import PacketKind as PacketKind
else:
    __all__, __getattr__, __dir__ = lazy_face(__name__, __file__)
