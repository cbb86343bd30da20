"""Layer between the loop's joints and the servos, for robots with couplings."""

from __future__ import annotations

from dxlrun.channels.cycle import Commands, States
from dxlrun.channels.event_records import EventSink
from dxlrun.dynamixel.hardware_layer import LayerStage, PreparedLayer
from dxlrun.features.mechanics.joint_arrays import CoupledJointArrays
from dxlrun.features.mechanics.joint_hardware import CouplingCheck, JointHardware
from dxlrun.plan.robot_plan import Plan


def prepare_mechanics(plan: Plan, states: States, goals: Commands, events: EventSink) -> PreparedLayer | None:
    """Return the layer that converts joints to servos; None if each joint has a servo of its own."""
    if not plan.mechanics.coupled:
        return None
    arrays = CoupledJointArrays(plan.mechanics, states, goals)
    together = CouplingCheck(plan.mechanics, plan.loop, plan.buses, arrays, events)
    return PreparedLayer(
        arrays.servo_states,
        arrays.servo_goals,
        lambda servos: JointHardware(servos, plan.mechanics, arrays, together, plan.loop.period_ns),
        together.at_start,
    )


STAGE = LayerStage(prepare_mechanics, to_servos=True)
