"""Simulated buses: the configuration of the servos that stand in for those of a plan."""

from __future__ import annotations

from dxlrun.compile.buses import SIMULATED
from dxlrun.compile.plan import AdapterPlan, LoadPlan, Plan
from dxlrun.compile.simulation import NAME_URDF, NEEDS_URDF
from dxlrun.dynamixel.control_table import added_control_tables
from dxlrun.dynamixel.plan.bus_plan import BusPlan
from dxlrun.errors import InputError
from dxlrun.simulation import AdapterConfig, BusConfig, Load, ServoConfig, UrdfBodies, UrdfJoint


def simulated_buses(plan: Plan) -> tuple[BusConfig, ...]:
    """Return the simulated lines of a plan: the servos that it expects, each at its reference (q = 0)."""
    return tuple(_simulated_bus(plan, bus) for bus in plan.buses if bus.port == SIMULATED)


def simulated_bodies(plan: Plan) -> UrdfBodies | None:
    """Return the bodies that the servos of `simulated_buses` move together; None: each joint by itself.

    Raises InputError when the robot file asks for bodies that cannot be moved: here, where the
    user sees it, and not in the process of the simulated buses.
    """
    if plan.simulation.physics == "independent":
        return None
    if plan.urdf is None:
        raise InputError(f"{NEEDS_URDF}; {NAME_URDF}")
    joints = (
        UrdfJoint(servo.joint, servo.reference, servo.direction)
        for bus in plan.buses
        if bus.port == SIMULATED
        for servo in bus.servos
    )
    bodies = UrdfBodies(plan.urdf, tuple(joints))
    from dxlrun.simulation.motion.mujoco_plant import mujoco_plant  # MuJoCo is optional, and slow to import

    mujoco_plant(bodies)
    return bodies


def _simulated_bus(plan: Plan, bus: BusPlan) -> BusConfig:
    adapter = plan.simulation.adapters.get(bus.name, AdapterPlan())
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
                load=Load(load.inertia, load.friction, load.gravity, load.gravity_angle),
            )
            for servo in bus.servos
            for load in (loads.get(servo.joint, LoadPlan()),)
        ),
        protocol=bus.protocol,
        control_tables=added_control_tables(servo.model for servo in bus.servos),
        adapter=AdapterConfig(
            latency_timer_ns=adapter.latency_timer_ns, split=adapter.split, echo=adapter.echo
        ),
        absent=adapter.absent,
    )
