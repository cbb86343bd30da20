"""Servos: single servos on a line that no run uses: scanning, registers, ID and rate.

A line is opened exclusively. Every write is read back.

    from dxlrun.tooling.servos import OneServo, ToolLine, TunablePort, scan

    def positions(path: str) -> list[int]:
        with TunablePort(path) as port:
            tool = ToolLine(port)
            found = [OneServo(tool, servo) for servo in scan(tool).servos]
            return [servo.read_items(["present_position"])["present_position"] for servo in found]
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dxlwire.faces import lazy_face

if TYPE_CHECKING:
    from dxlrun.dynamixel.tools.inspection import compare_servos as compare_servos
    from dxlrun.dynamixel.tools.inspection import stored_registers as stored_registers
    from dxlrun.dynamixel.tools.one_servo import OneServo as OneServo
    from dxlrun.dynamixel.tools.scanning import FoundServo as FoundServo
    from dxlrun.dynamixel.tools.scanning import Search as Search
    from dxlrun.dynamixel.tools.scanning import find_servo as find_servo
    from dxlrun.dynamixel.tools.scanning import scan as scan
    from dxlrun.dynamixel.tools.tool_line import ToolLine as ToolLine
    from dxlrun.dynamixel.tools.tool_port import TunablePort as TunablePort
else:
    __getattr__, __dir__ = lazy_face(__name__, __file__)
