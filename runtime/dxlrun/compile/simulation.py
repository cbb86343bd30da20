"""Simulation: compiles the `simulation` keys of the robot file into the simulator's configuration.

A real port ignores these keys, so an impossible value is only a warning there.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from dxlrun.compile.contribution import BusDevice
from dxlrun.compile.joints.compiled_joints import CompiledJoint
from dxlrun.compile.joints.compiled_urdf import TYPES
from dxlrun.compile.joints.motors import Motors
from dxlrun.compile.problems import RobotFile
from dxlrun.control.sampled_sources import planned_processes
from dxlrun.description.bus import Bus
from dxlrun.errors import InputError
from dxlrun.plan.robot_plan import Plan, SimulationPlan
from dxlsim.motor_model import MotorLoad
from dxlsim.simulation_plan import (
    NO_LOAD,
    WHOLE_REPLIES,
    AdapterConfig,
    BusConfig,
    DeviceConfig,
    Load,
    Mechanism,
    MechanismServo,
    ServoConfig,
    ServoTimes,
    SimulationConfig,
    UrdfBodies,
)
from dxlwire.bus_plan import SIMULATED, BusPlan
from dxlwire.control_table import added_control_tables
from dxlwire.joint_unit import LINEAR, ROTARY, JointUnit

if TYPE_CHECKING:
    from dxlrun.description.joints.motor_file import MotorDescription
    from dxlwire.bus_plan import ServoPlan

_MOVE: Mapping[JointUnit, str] = {ROTARY: "turn", LINEAR: "move"}
NEEDS_MUJOCO = "MuJoCo, needed for physics: mujoco, is not installed"
INSTALL_MUJOCO = "run `pip install 'dxlrun[physics]'`, or write physics: independent"
NEEDS_URDF = "physics: mujoco needs a URDF"
NAME_URDF = "write `model: {urdf: ...}`, or physics: independent"


def compile_simulation(
    file: RobotFile,
    joints: Mapping[str, CompiledJoint],
    devices: Iterable[BusDevice],
    motors: Motors,
) -> SimulationPlan:
    """Return loads, motors, delays and adapters of simulated buses; warn of contradictory values."""
    for name, joint in joints.items():
        _check_load(file, name, joint, _motor(joint, motors))
    _check_buses(file)
    _check_physics(file)
    servos = {servo.described.name: joint for joint in joints.values() for servo in joint.servos}
    moved = {name: _load(joint, _motor(joint, motors)) for name, joint in joints.items()}
    slow = {name: _times(joint, motors.simulated(name)) for name, joint in servos.items()}
    return SimulationPlan(
        loads={name: load for name, load in moved.items() if load != NO_LOAD},
        motors={name: each.motor for name in servos if (each := motors.simulated(name)) is not None},
        adapters={
            name: adapter
            for name, bus in file.robot.buses.items()
            if (adapter := _adapter(bus)) != WHOLE_REPLIES
        },
        times={name: times for name, times in slow.items() if times != ServoTimes()},
        physics=file.robot.simulation.physics,
        devices={device.plan.name: device.simulated for device in devices},
    )


def _motor(joint: CompiledJoint, motors: Motors) -> MotorDescription | None:
    """Return the motor file with which a joint's first servo is simulated; None if it has none."""
    return motors.simulated(joint.servos[0].described.name)


def _times(joint: CompiledJoint, motor: MotorDescription | None) -> ServoTimes:
    """Return the response delay (from keys, else motor file) and write time of a simulated servo."""
    keys = joint.described.simulation
    known_ns = 0 if motor is None else motor.motor.delay_ns
    return ServoTimes(keys.response_delay or known_ns, keys.write_time)


def _adapter(bus: Bus) -> AdapterConfig:
    keys = bus.simulation
    return AdapterConfig(bus.latency_timer, keys.split, echo=keys.echo, absent=keys.absent)


def _load(joint: CompiledJoint, motor: MotorDescription | None) -> Load:
    """Return the load at a simulated joint (inertia, friction, weight), from its keys or its motor file."""
    keys = joint.described.simulation
    friction = float(keys.friction or 0.0)
    if joint.plan.unit is LINEAR:
        return Load(keys.mass or 0.0, friction, steady=float(keys.gravity or 0.0))
    known = MotorLoad() if motor is None or not joint.drive.own else motor.motor.load
    ratio = joint.servos[0].described.ratio  # the file's load is at the horn
    inertia = known.inertia / ratio**2 if keys.inertia is None else keys.inertia
    gravity = known.gravity / ratio if keys.gravity is None else float(keys.gravity)
    if not gravity:
        return Load(inertia, friction)
    angle = keys.gravity_angle
    if angle is None:
        angle = known.gravity_angle if keys.gravity is None else 0.0
    return Load(inertia, friction, gravity, angle)


def _check_load(file: RobotFile, name: str, joint: CompiledJoint, motor: MotorDescription | None) -> None:
    keys = joint.described.simulation
    if keys.gravity_angle is not None and not _load(joint, motor).gravity:
        file.warning(
            file.at("joints", name, "simulation", "gravity_angle"),
            f"gravity_angle of {name} has no effect without gravity",
            "add `gravity: ... Nm`, or remove gravity_angle",
        )
    stall, unit = _stall(joint), joint.plan.unit
    models = ", ".join(dict.fromkeys(servo.table.model for servo in joint.servos))
    several = len(joint.servos) > 1
    for key, torque, what in (
        ("friction", keys.friction, f"{_MOVE[unit]} against a friction"),
        ("gravity", keys.gravity, "hold a weight"),
    ):
        if torque is not None and 0 < stall <= torque:
            file.warning(
                file.at("joints", name, "simulation", key),
                f"the {models} of {name} cannot {what} of {torque:g} {unit.torque}: "
                f"{'they stall' if several else 'it stalls'} at {stall:g} {unit.torque}",
                "check the value and its unit",
            )
    if file.robot.simulation.physics == "mujoco":
        for key in ("inertia", "mass", "gravity"):
            if getattr(keys, key) is not None:
                file.warning(
                    file.at("joints", name, "simulation", key),
                    f"with physics: mujoco the URDF defines the {key} of {name}",
                    f"remove {key}; it is for joints without motion in the URDF",
                )


def _stall(joint: CompiledJoint) -> float:
    """Return the stall torque of all of a joint's servos together, at the joint, Nm or N; 0: not known."""
    torques = [servo.table.stall_torque / servo.described.ratio for servo in joint.servos]
    if not all(torques):
        return 0.0
    return sum(abs(lever) * torque for lever, torque in zip(joint.drive.levers, torques, strict=True))


def _check_buses(file: RobotFile) -> None:
    for name, bus in file.robot.buses.items():
        if bus.simulation.absent == "slot" and bus.protocol == 1.0:
            file.warning(
                file.at("buses", name, "simulation", "absent"),
                f"absent: slot is for Protocol 2.0, but bus {name} has Protocol 1.0",
                "remove it",
            )
        if bus.simulation.echo and bus.port == SIMULATED:
            file.warning(
                file.at("buses", name, "simulation", "echo"),
                f"dxlrun does not support the echo of bus {name}",
                "remove echo; it is for other programs, through `dxlrun sim`",
            )


def _check_physics(file: RobotFile) -> None:
    robot = file.robot
    if robot.simulation.physics != "mujoco":
        return
    mark = file.at("simulation", "physics")
    simulated = any(bus.port == SIMULATED for bus in robot.buses.values())
    add = file.error if simulated else file.warning
    if robot.model is None:
        add(mark, NEEDS_URDF, NAME_URDF)
    if importlib.util.find_spec("mujoco") is None:
        add(mark, NEEDS_MUJOCO, INSTALL_MUJOCO)


# Simulation of a plan


def simulation_of(plan: Plan) -> SimulationConfig:
    """Return the simulator's configuration for a plan: simulated buses and servos, loads, and bodies.

    Each servo starts at its reference (q = 0).

    Raises:
        InputError: The robot file requires bodies that cannot be simulated. This is raised here, where the
            user sees it, and not in the process of the simulated buses.
    """
    bodies, physics = _bodies(plan), plan.simulation.physics != "independent"
    if physics and bodies is None:
        raise InputError(f"{NEEDS_URDF}; {NAME_URDF}")
    config = SimulationConfig(
        tuple(_simulated_bus(plan, bus) for bus in plan.buses if bus.port == SIMULATED),
        bodies=bodies if physics else None,
        mechanisms=_mechanisms(plan),
        sensed=bodies if any(one.link for one in plan.simulation.devices.values()) else None,
    )
    if physics:
        from dxlsim.motion.mechanics import plant_of  # imported here, because no check needs it

        try:
            plant_of(config)
        except ImportError as error:  # MuJoCo may be installed but fail to load
            raise InputError(f"{NEEDS_MUJOCO}; {INSTALL_MUJOCO}") from error
    return config


def sensed_bodies(plan: Plan) -> UrdfBodies | None:
    """Return the URDF's bodies if a process next to the loop (such as a sensor) needs them; else None."""
    sensed = any(one.process.has_body for one in planned_processes(plan.loop))
    return _bodies(plan) if sensed else None


def _bodies(plan: Plan) -> UrdfBodies | None:
    """Return the URDF's bodies and what moves them; None if the robot has no URDF."""
    return None if plan.urdf is None else UrdfBodies(plan.urdf, _mechanisms(plan))


def _mechanisms(plan: Plan) -> tuple[Mechanism, ...]:
    """Return which simulated servos move which joints; mechanisms with a single servo come first."""
    # The simulator adds the servos in this order.
    simulated = (servo for bus in plan.buses if bus.port == SIMULATED for servo in bus.servos)
    by_row = {servo.row: (index, servo) for index, servo in enumerate(simulated)}
    found: list[Mechanism] = []
    for one in plan.mechanics.mechanisms(len(plan.loop.joints)):
        servos = [by_row[row] for row in one.servos if row in by_row]
        names = tuple(plan.loop.joints[row].name for row in one.joints)
        loads = tuple(plan.simulation.loads.get(name, NO_LOAD) for name in names)
        if len(servos) < len(one.servos):
            # A servo on a real port cannot be simulated, so the other servos of the mechanism move
            # independently.
            found += (_mechanism([each], (each[1].joint,)) for each in servos)
        else:
            found.append(_mechanism(servos, names, one.matrix, () if one.own else loads))
    return tuple(sorted(found, key=lambda one: one.servos[0].index if one.is_single else math.inf))


def _mechanism(
    servos: Sequence[tuple[int, ServoPlan]],
    joints: tuple[str, ...],
    matrix: tuple[tuple[float, ...], ...] = ((1.0,),),
    loads: tuple[Load, ...] = (),
) -> Mechanism:
    parts = (MechanismServo(index, one.encoder_reference, one.direction * one.ratio) for index, one in servos)
    return Mechanism(tuple(parts), joints, matrix, loads, TYPES[servos[0][1].unit])


def _simulated_bus(plan: Plan, bus: BusPlan) -> BusConfig:
    described = plan.simulation
    own = {servo for _, servo in plan.mechanics.own_servos(len(plan.loop.joints))}
    return BusConfig(
        name=bus.name,
        baud_rate=bus.baud_rate,
        servos=tuple(
            ServoConfig(
                servo.servo_id,
                servo.model,
                servo.encoder_reference,
                bus.return_delay_ns,
                # The load on several servos belongs to their mechanism.
                load=_felt(servo, described.loads.get(servo.joint)) if servo.row in own else NO_LOAD,
                times=described.times.get(servo.own_name, ServoTimes()),
                motor=described.motors.get(servo.own_name),
                homing_offset=servo.homing_offset or 0,
            )
            for servo in bus.servos
        ),
        protocol=bus.protocol,
        devices=tuple(
            DeviceConfig(device.servo_id, device.model, bus.return_delay_ns, described.devices[device.name])
            for device in bus.devices
        ),
        control_tables=added_control_tables(servo.model for servo in bus.servos),
        adapter=described.adapters.get(bus.name, WHOLE_REPLIES),
    )


def _felt(servo: ServoPlan, load: Load | None) -> Load:
    """Convert the load of a joint into the load at its only servo, through the gear."""
    if load is None:
        return NO_LOAD
    # Through a gear an inertia scales with the square of the ratio, a torque with the ratio.
    inertia, friction = load.inertia * servo.ratio**2, load.friction * servo.ratio
    if servo.unit is LINEAR:
        return Load(inertia, friction, steady=servo.direction * (load.steady * servo.ratio))
    if not load.gravity:
        return Load(inertia, friction)
    down = servo.encoder_reference + servo.direction * load.gravity_angle / servo.ratio
    return Load(inertia, friction, load.gravity * servo.ratio, down, turns=servo.ratio)
