"""Tool port: the port of a tool; its errors name the run that has the port open."""

from __future__ import annotations

from dxlrun.contract.serial_line import open_serial
from dxlwire.bus.adjustable_port import BOOT_NS, FIRST_RATE, AdjustablePort


class TunablePort(AdjustablePort):
    """A serial port whose baud rate tools can change, opened exclusively; a context manager that closes it.

    Args:
        path: The device, or on Windows a name such as COM3.
        baud_rate: First rate, bit/s.
        rs485: True to let the kernel switch the direction of an RS-485 transceiver.
        boot_ns: Time to wait for a board that this call has reset by opening its port.

    Raises:
        PortError: The port cannot be opened: it does not exist, or another process, which is named, has it.
    """

    def __init__(
        self, path: str, baud_rate: int = FIRST_RATE, *, rs485: bool = False, boot_ns: int = BOOT_NS
    ) -> None:
        super().__init__(path, baud_rate, rs485=rs485, boot_ns=boot_ns, open_line=open_serial)
