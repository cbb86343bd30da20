"""The servos that stand in for a robot: what a simulated bus must be told to look like it."""

from __future__ import annotations

from dxlrun.compile.plan import Plan
from dxlrun.control_table import added_control_tables
from dxlrun.simulation import BusConfig, ServoConfig


def simulated_buses(plan: Plan) -> tuple[BusConfig, ...]:
    """Return the simulated lines of a plan: the servos that it expects, each at its reference (q = 0)."""
    return tuple(
        BusConfig(
            name=bus.name,
            baud_rate=bus.baud_rate,
            servos=tuple(
                ServoConfig(servo.servo_id, servo.model, servo.reference, bus.return_delay_ns)
                for servo in bus.servos
            ),
            protocol=bus.protocol,
            control_tables=added_control_tables(servo.model for servo in bus.servos),
        )
        for bus in plan.buses
        if bus.port == "sim"
    )
