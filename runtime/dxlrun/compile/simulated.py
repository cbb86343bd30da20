"""The servos that stand in for a robot: what a simulated bus must be told to look like it."""

from __future__ import annotations

from dxlrun.compile.plan import AdapterPlan, LoadPlan, Plan
from dxlrun.control_table import added_control_tables
from dxlrun.dynamixel.bus_plan import BusPlan
from dxlrun.simulation import AdapterConfig, BusConfig, Load, ServoConfig


def simulated_buses(plan: Plan) -> tuple[BusConfig, ...]:
    """Return the simulated lines of a plan: the servos that it expects, each at its reference (q = 0)."""
    return tuple(_bus(plan, bus) for bus in plan.buses if bus.port == "sim")


def _bus(plan: Plan, bus: BusPlan) -> BusConfig:
    told = plan.simulation.adapters.get(bus.name, AdapterPlan())
    loads = plan.simulation.loads
    return BusConfig(
        name=bus.name,
        baud_rate=bus.baud_rate,
        servos=tuple(
            ServoConfig(
                servo.servo_id,
                servo.model,
                servo.reference,
                bus.return_delay_ns,
                load=_load(loads.get(servo.joint, LoadPlan())),
            )
            for servo in bus.servos
        ),
        protocol=bus.protocol,
        control_tables=added_control_tables(servo.model for servo in bus.servos),
        adapter=AdapterConfig(latency_timer_ns=told.latency_timer_ns, split=told.split, echo=told.echo),
        absent=told.absent,
    )


def _load(told: LoadPlan) -> Load:
    return Load(told.inertia, told.friction, told.gravity, told.gravity_angle)
