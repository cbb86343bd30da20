"""Serial lines: open a line for a tool or a sensor. Errors name the run that has the line open."""

from __future__ import annotations

from dxlrun.process_table import describe_run
from dxlwire.port import serial_open
from dxlwire.port.serial_open import SerialLine


def open_serial(path: str, baud_rate: int, *, rs485: bool = False, boot_ns: int = 0) -> SerialLine:
    """Open a serial device or a pseudo-terminal exclusively: raw, 8N1.

    Args:
        path: Path of the device.
        baud_rate: bit/s; `SerialLine.baud_rate` has the rate that the driver has set.
        rs485: True to let the kernel switch the direction of an RS-485 transceiver with RTS.
        boot_ns: Time to wait for a board that this call has reset by opening its port.

    Raises:
        PortError: The device does not exist, this user may not open it, another process has it, or it does
            not support the baud rate or RS-485.
    """
    return serial_open.open_serial(
        path, baud_rate, rs485=rs485, boot_ns=boot_ns, describe_holder=describe_run
    )
