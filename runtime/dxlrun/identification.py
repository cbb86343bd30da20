"""Identification: ask servos on real ports for their models, before the plan is made for good."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from dxlrun.clock import MonotonicClock
from dxlrun.dynamixel.bus_plan import BusPlan
from dxlrun.dynamixel.identify import identify
from dxlrun.dynamixel.port import SerialPort, SerialPorts
from dxlrun.dynamixel.serial_open import open_serial
from dxlrun.errors import StartUpError


def ask_servos(buses: Sequence[BusPlan], joints: Sequence[str]) -> Mapping[str, str]:
    """Return the models of the servos of `joints`, by joint; opens their ports, and lets go of them.

    Raises StartUpError with a sentence for every servo that cannot be identified, PortError when a port
    cannot be opened or is gone.
    """
    asked = [bus for bus in buses if any(servo.joint in joints for servo in bus.servos)]
    opened = []
    try:
        opened = [open_serial(bus.port, bus.baud_rate) for bus in asked]
        ports = SerialPorts(
            [SerialPort(port.fileno(), bus.port) for port, bus in zip(opened, asked, strict=True)]
        )
        found = identify(asked, joints, ports, MonotonicClock())
    finally:
        for port in opened:
            port.close()
    problems = [one.problem for one in found.values() if one.problem]
    if problems:
        raise StartUpError("\n".join(problems))
    return {joint: one.model for joint, one in found.items()}
