"""Opening of serial lines by tools and sensors; an error names the run that has the line open."""

from __future__ import annotations

from dxlrun.process_table import describe_run
from dxlwire.port import serial_open
from dxlwire.port.serial_open import SerialLine


def open_serial(path: str, baud_rate: int, *, rs485: bool = False, boot_ns: int = 0) -> SerialLine:
    """Open a serial device for this process alone: raw, 8N1; also a pseudo-terminal.

    Args:
        path: The device.
        baud_rate: bit/s; `SerialLine.baud_rate` is what the driver made of it.
        rs485: Let the kernel switch the direction of an RS-485 transceiver by RTS.
        boot_ns: How long to wait for a board that resets when its port is opened; only where this did that.

    Raises:
        PortError: There is no such device, this user may not open it, another process has it, or it cannot do
            the baud rate or RS-485.
    """
    return serial_open.open_serial(
        path, baud_rate, rs485=rs485, boot_ns=boot_ns, describe_holder=describe_run
    )
