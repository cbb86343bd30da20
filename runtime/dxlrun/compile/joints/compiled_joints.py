"""Joints: compiles `joints` of the robot file into plans, and checks efforts, accelerations and twins."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import msgspec
from msgspec.structs import replace

from dxlrun.compile.joints.compiled_servos import CompiledServo, compile_servos, servo_travel
from dxlrun.compile.joints.joint_drives import DriveStage, JointDrive
from dxlrun.compile.joints.limits import Interval, degrees
from dxlrun.compile.joints.motors import Motors
from dxlrun.compile.problems import RobotFile
from dxlrun.description.joints.joint_forms import Joint, JointEntry, planned_keys
from dxlrun.description.units import plain
from dxlrun.features import installed_features, stages
from dxlrun.plan.loop_plan import SETTLE_NS, UNLIMITED, ControllerPlan, JointPlan
from dxlsim.motor_model import MotorModel
from dxlwire.control_table import ControlTable
from dxlwire.joint_unit import LINEAR
from dxlwire.modes import Mode

_UNITS: Mapping[str, str] = {
    "Nm": "Nm",
    "N": "N",
    "A": "A",
    "1": "% of its highest load",
}
_EXAMPLES: Mapping[str, str] = {
    "Nm": "0.3 Nm",
    "N": "20 N",
    "A": "800 mA",
    "1": "40 %",
}
MOST_STARTING_S = 10.0
"""Longest plausible time to accelerate to full speed, s; a limit that needs more has a wrong unit. [i]"""
_SAME = math.radians(1.0)  # references closer than this are equal: a horn has teeth, a trim does not


_BY_ERROR = (("position",), ("position", "velocity"))
"""Command interfaces without effort: the servo holds a load only by its position error."""
_I_GAIN = "position_i_gain"


class CompiledJoint(msgspec.Struct, frozen=True):
    """A joint without mistakes: its plan for the run, its keys in the file, and its servos."""

    plan: JointPlan
    described: JointEntry
    drive: JointDrive

    @property
    def servos(self) -> tuple[CompiledServo, ...]:
        """Compiled servos that move the joint."""
        return self.drive.servos

    @property
    def table(self) -> ControlTable:
        """Control table of the joint's first servo."""
        return self.servos[0].table

    @property
    def position_range(self) -> Interval:
        """Positions that the joint's servos can reach, rad or m; the file's limits may be narrower."""
        return self.drive.reach

    @property
    def modes(self) -> tuple[Mode, ...]:
        """Operating modes in which controllers can command the joint."""
        return self.drive.modes


def compile_joints(file: RobotFile, models: Mapping[str, str], motors: Motors) -> dict[str, CompiledJoint]:
    """Compile all joints that have no mistakes, by name in file order.

    Args:
        file: Robot file; collects the problems.
        models: Models that were read from the servos of joints with `model: auto`, by joint.
        motors: Motor files.
    """
    servos = compile_servos(file, models, motors)
    drives: dict[str, JointDrive] = {}
    for _, stage in stages(DriveStage, installed_features()):
        drives |= stage.compile(file, servos)
    compiled: dict[str, CompiledJoint] = {}
    for name, joint in file.robot.joints.items():
        drive = drives.get(name)
        if drive is None:
            continue
        # A mistake with an assumed model may not be one with the real model, so it is not reported yet.
        certain = all(servo.certain for servo in drive.servos)
        effort = _effort(file if certain else RobotFile(file.description), name, joint, drive.servos[0])
        if drive.allowed is None or not all(servo.known_bus for servo in drive.servos):
            continue
        plan = _joint_plan(name, joint, drive, drive.allowed, effort)
        _check_acceleration(file, plan)
        compiled[name] = CompiledJoint(plan, joint, drive)
    return compiled


def moving_servos(joints: Iterable[CompiledJoint]) -> tuple[CompiledServo, ...]:
    """Return the servos of joints, each once, in the row order of the run's arrays."""
    return tuple({servo.described.name: servo for joint in joints for servo in joint.servos}.values())


def _joint_plan(
    name: str, joint: JointEntry, drive: JointDrive, allowed: Interval, effort: float | None
) -> JointPlan:
    servos, first = drive.servos, drive.servos[0]
    same = all(
        servo.motor == first.motor and servo.described.ratio == first.described.ratio for servo in servos
    )
    return JointPlan(
        name,
        allowed.lower,
        allowed.upper,
        # Without a limit use the servo's speed: a goal that runs ahead of its servo could not be stopped in
        # time.
        plain(joint.limits.velocity) or drive.shared_speed,
        effort,
        joint.continuous,
        bounded=not joint.continuous or joint.limits.position is not None,
        top_speed=drive.top_speed,
        top_effort=drive.top_effort,
        acceleration=plain(joint.limits.acceleration),
        servo=_servo_label(servos),
        motor=_at_joint(first, drive.levers) if same else None,
        servo_model=first.servo_model if drive.own else None,
        unit=first.described.unit,
        coupled=drive.together if len(drive.together) > 1 else (),
        tolerance=_limited(joint.tolerance.position),
        rest_speed=_limited(joint.tolerance.velocity),
        settle_ns=SETTLE_NS if joint.tolerance.time is None else joint.tolerance.time,
        wrap=joint.wrap,
        keys=planned_keys(joint),
    )


def _limited(tolerance: float | None) -> float | None:
    """Return a tolerance with infinity replaced by a large number, because a plan is JSON."""
    return None if tolerance is None else min(float(tolerance), UNLIMITED)


def _servo_label(servos: Sequence[CompiledServo]) -> str:
    """Return IDs and bus of a joint's servos as text for messages: `ID 1 and 2 on bus main`."""
    described = [servo.described for servo in servos]
    if len({one.bus for one in described}) == 1:
        return f"ID {' and '.join(str(one.id) for one in described)} on bus {described[0].bus}"
    return " and ".join(one.servo for one in described)


def _at_joint(servo: CompiledServo, levers: Sequence[float]) -> MotorModel | None:
    """Return one motor model at the joint that acts like all of its (equal) servo motors with their gears.

    A gear multiplies torque and back-EMF; servos in parallel divide the resistance. The load is already that
    of the joint.

    Args:
        servo: One of the servos.
        levers: Travel of each servo, after its gear, per unit of the joint.
    """
    motor, ratio = servo.motor, servo.described.ratio
    lever = max(map(abs, levers))
    count = sum(each * each for each in levers) / (lever * lever)
    turns = lever / ratio
    if motor is None or (turns == 1.0 and count == 1.0):
        return motor
    stribeck, effort, gain = motor.stribeck, motor.torque_per_effort, motor.position_gain
    return replace(
        motor,
        torque_constant=motor.torque_constant * turns,
        resistance=motor.resistance / count,
        inertia=motor.inertia * count * turns * turns,
        friction=motor.friction * count * turns,
        viscous_friction=motor.viscous_friction * count * turns * turns,
        stribeck=stribeck
        and replace(stribeck, friction=stribeck.friction * count * turns, velocity=stribeck.velocity / turns),
        position_gain=None if gain is None else gain * turns,
        # Efforts of coupled servos add up with their levers; those in A or % do not grow with the gear.
        torque_per_effort=effort if effort is None or servo.table.effort_unit == "Nm" else effort / ratio,
    )


def check_limp_joints(file: RobotFile, controllers: Iterable[ControllerPlan]) -> None:
    """Add an error for each controller that is active at start and commands a joint with `torque: off`."""
    joints = file.robot.joints
    for plan in controllers:
        limp = [name for name in plan.joints if name in joints and not joints[name].torque]
        if limp and plan.active and plan.command and not plan.into:
            file.error(
                file.key("controllers", plan.name),
                f"controller {plan.name} is active from the start, but torque is off for {', '.join(limp)}",
                f"write active: false, and run `dxlrun torque on {' '.join(limp)}` before activating it, or "
                "remove torque: off",
            )


def check_tolerances(
    file: RobotFile, joints: Mapping[str, CompiledJoint], controllers: Iterable[ControllerPlan]
) -> None:
    """Warn of each joint whose weight, by its motor model, makes it sag by more than its position tolerance.

    In position control only the position error holds a weight, unless the I gain is not 0 or a controller
    adds an effort.
    """
    plans = [plan for plan in controllers if plan.commands_servos]
    by_error = {name for plan in plans if plan.command in _BY_ERROR for name in plan.joints}
    for name, joint in joints.items():
        plan = joint.plan
        integrates = any(_I_GAIN in servo.declared for servo in joint.servos)
        if name not in by_error or plan.unit is LINEAR or integrates:
            continue
        error = _static_error(joint)
        if error is not None and error > plan.goal_tolerance:
            off = "far" if math.isinf(error) else f"by up to {degrees(error)} deg"
            file.warning(
                file.key("joints", name),
                f"{name} sags {off} under its load, more than its tolerance of "
                f"{degrees(plan.goal_tolerance)} deg",
                "raise its P gain or its tolerance, or compensate the load in a controller",
            )


def _static_error(joint: CompiledJoint) -> float | None:
    """Return how far a joint sags under its weight in the worst pose, rad.

    None: the motor's model or the weight is not known. Infinite: the servo cannot hold the weight.
    """
    plan, given = joint.plan, joint.described.simulation
    motor = plan.motor
    if motor is None or not motor.stiffness:
        return None
    gravity, hangs_at = motor.load.gravity, motor.load.gravity_angle
    if given.gravity is not None:
        gravity, hangs_at = float(given.gravity), given.gravity_angle or 0.0
    # The weight pulls most where it sticks out horizontally, or at the limit nearest to that.
    first = math.ceil((plan.lower - hangs_at - math.pi / 2) / math.pi)
    sticks_out = first * math.pi + math.pi / 2 + hangs_at <= plan.upper
    ends = max(abs(math.sin(end - hangs_at)) for end in (plan.lower, plan.upper))
    pull = gravity * (1.0 if sticks_out else ends)
    held = max(0.0, pull - motor.friction - motor.load_friction * pull)
    duty = held * motor.resistance / (motor.torque_constant * motor.voltage)
    return math.inf if duty > 1.0 else duty / motor.stiffness


def _effort(file: RobotFile, name: str, joint: JointEntry, servo: CompiledServo) -> float | None:
    """Return a joint's effort limit from the file; add an error if its unit is not that of the servo."""
    if joint.limits.effort is None:
        return None
    value, unit = float(joint.limits.effort), joint.limits.effort.unit
    table = servo.table
    measured = servo.described.unit.effort_unit(table.effort_unit)
    if unit != measured:
        file.error(
            file.at("joints", name, "limits", "effort"),
            f"the effort limit of {name} is in {_UNITS[unit]}, but an {table.model} measures "
            f"{_UNITS[measured]} ({table.effort_item.replace('_', ' ')})",
            f"write it in {_UNITS[measured]}, such as {_EXAMPLES[measured]}",
        )
    return value


def _check_acceleration(file: RobotFile, plan: JointPlan) -> None:
    """Check that a joint reaches full speed in at most 10 s (error), but not within one cycle (warning)."""
    speed, acceleration, rate = plan.highest_speed, plan.acceleration, file.robot.loop.rate
    if acceleration is None or not math.isfinite(speed):
        return
    mark, unit = (
        file.at("joints", plan.name, "limits", "acceleration"),
        plan.unit.speed,
    )
    seconds = speed / acceleration
    if seconds > MOST_STARTING_S:
        file.error(
            mark,
            f"{plan.name} would need {seconds:.3g} s to reach {speed:.3g} {unit} or to stop",
            f"allow at least {speed / MOST_STARTING_S:.2g} {unit}^2",
        )
    elif seconds * rate <= 1:
        file.warning(
            mark,
            f"{acceleration:.4g} {unit}^2 limits nothing: {plan.name} can reach its highest speed, "
            f"{speed:.3g} {unit}, within one cycle of {1e3 / rate:.3g} ms",
            f"write less than {speed * rate:.3g} {unit}^2, or remove it",
        )


def check_twins(file: RobotFile, tables: dict[str, ControlTable]) -> None:
    """Warn of `left` and `right` joints whose reference or direction are not mirror images.

    In a mirror image the right servo counts from the other end and turns the other way: reference_right =
    lowest + highest angle of the servo - reference_left, direction_right = -direction_left.
    """
    joints = file.robot.joints
    for name, left in joints.items():
        twin = name.replace("left", "right", 1)
        right = joints.get(twin)
        if not isinstance(left, Joint) or not isinstance(right, Joint):
            continue
        if twin == name or left.model != right.model or name not in tables:
            continue
        travel = servo_travel(tables[name])
        expected = travel.lower + travel.upper - left.reference
        if abs(expected - right.reference) > _SAME:
            file.warning(
                file.at("joints", twin, "reference"),
                f"{twin} is not a mirror image of {name}: its reference is {degrees(right.reference)} deg "
                f"instead of {degrees(expected)} deg",
                "correct one reference, or ignore this for an asymmetric body",
            )
        if right.direction == left.direction:
            file.warning(
                file.at("joints", twin, "direction"),
                f"{twin} is not a mirror image of {name}: both have direction {left.direction:+d}",
                f"write direction: {-left.direction:+d}, or ignore this for an asymmetric body",
            )
