"""Dynamixel servos on serial lines: control tables, packets, ports, and a cyclic exchange in C.

It is a library and knows nothing of robots, logs or YAML. What a robot makes of servos belongs in
`dxlrun.dynamixel`. `import dxlwire` is light: each name is imported when it is first used.

A control table has the address, size and unit of every item of a servo model:

    >>> from dxlwire import find_table
    >>> item = find_table("XM430-W350").items["goal_position"]
    >>> item.address, item.size, item.unit
    (116, 4, 'rad')

A dialect builds the packets of a protocol and takes them apart:

    >>> from dxlwire import dialect_of
    >>> packets = dialect_of(2.0)
    >>> packets.write(1, item.address, item.encode(2048)).hex(" ")
    'ff ff fd 00 01 09 00 03 74 00 00 08 00 00 42 89'
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dxlwire.faces import lazy_face

if TYPE_CHECKING:
    from dxlwire.bus_plan import BusPlan as BusPlan
    from dxlwire.bus_plan import ServoPlan as ServoPlan
    from dxlwire.clock import Clock as Clock
    from dxlwire.clock import MonotonicClock as MonotonicClock
    from dxlwire.control_table.hardware_errors import Fault as Fault
    from dxlwire.control_table.hardware_errors import HardwareErrors as HardwareErrors
    from dxlwire.control_table.models import find_table as find_table
    from dxlwire.control_table.models import model_names as model_names
    from dxlwire.control_table.models import models_by_number as models_by_number
    from dxlwire.control_table.table import ControlItem as ControlItem
    from dxlwire.control_table.table import ControlTable as ControlTable
    from dxlwire.errors import DxlError as DxlError
    from dxlwire.errors import InputError as InputError
    from dxlwire.errors import NotCompiled as NotCompiled
    from dxlwire.errors import PortError as PortError
    from dxlwire.modes import COMMAND_INTERFACES as COMMAND_INTERFACES
    from dxlwire.modes import Mode as Mode
    from dxlwire.modes import mode_of as mode_of
    from dxlwire.packets import PacketKind as PacketKind
    from dxlwire.plan.line import BITS_PER_BYTE as BITS_PER_BYTE
    from dxlwire.plan.line import TIMEOUT_MARGIN_NS as TIMEOUT_MARGIN_NS
    from dxlwire.port.adapters import serial_devices as serial_devices
    from dxlwire.port.latency_timer import is_simulated as is_simulated
    from dxlwire.port.ports import Port as Port
    from dxlwire.port.ports import SerialPort as SerialPort
    from dxlwire.port.reopening import lasting_name as lasting_name
    from dxlwire.port.serial_open import SerialLine as SerialLine
    from dxlwire.port.serial_open import open_serial as open_serial
    from dxlwire.transaction import BROADCAST_ID as BROADCAST_ID
    from dxlwire.transaction import Status as Status
    from dxlwire.wire import protocol1 as protocol1
    from dxlwire.wire import protocol2 as protocol2
    from dxlwire.wire.dialect import Dialect as Dialect
    from dxlwire.wire.dialect import dialect_of as dialect_of
    from dxlwire.wire.receiver import Receiver as Receiver
else:
    __all__, __getattr__, __dir__ = lazy_face(__name__, __file__)
