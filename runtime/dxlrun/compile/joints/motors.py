"""Motors: reads the motor files that joints name and compares them with servo models and registers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
from msgspec.structs import replace

from dxlrun.compile.joints.described_servos import DescribedServo, described_servos
from dxlrun.compile.problems import Problems, RobotFile
from dxlrun.errors import InputError, Mark
from dxlsim.motor_model import MotorModel
from dxlwire.control_table import ControlTable

if TYPE_CHECKING:
    from dxlrun.description.joints.motor_file import MotorDescription

P_GAINS = ("p_gain", "position_p_gain")
"""Names of the item with the P gain of position control, which differ by model."""


class Motors(msgspec.Struct, frozen=True):
    """Motor files of a robot that could be read, by the name of the servo."""

    servos: Mapping[str, MotorDescription] = {}  # by the servo that the file describes
    simulations: Mapping[str, MotorDescription] = {}  # by the servo that is simulated with another motor

    def simulated(self, name: str) -> MotorDescription | None:
        """Return the motor file for simulating a servo: that of `simulation.motor`, else its own file."""
        return self.simulations.get(name) or self.servos.get(name)

    @property
    def texts(self) -> dict[str, str]:
        """Texts of all these motor files, by path."""
        return {str(each.path): each.text for each in (*self.servos.values(), *self.simulations.values())}


def read_motors(file: RobotFile) -> Motors:
    """Read each motor file that a robot file names; files with mistakes are missing in the result."""
    known: dict[Path, MotorDescription | None] = {}
    servos: dict[str, MotorDescription] = {}
    simulations: dict[str, MotorDescription] = {}
    joints = file.robot.joints
    for servo in described_servos(file.description):
        joint = joints.get(servo.joints[0])
        simulated = None if joint is None else joint.simulation.motor
        for written, mark, found in (
            (servo.motor, servo.mark(file.marks, "motor"), servos),
            (
                simulated,
                file.at("joints", servo.joints[0], "simulation", "motor"),
                simulations,
            ),
        ):
            if written is None:
                continue
            path = Path(mark.file).parent / written
            if path not in known:
                known[path] = _read(path, written, mark, file)
            if (motor := known[path]) is not None:
                found[servo.name] = motor
    return Motors(servos, simulations)


def _read(path: Path, written: str, mark: Mark, problems: Problems) -> MotorDescription | None:
    # imported here, because most robots have no motor file
    from dxlrun.description.joints.motor_file import read_motor

    if not path.exists():
        problems.error(
            mark,
            f"motor file {written} not found",
            "check the name, relative to the folder of this file, or make the file by `dxlrun identify`",
        )
        return None
    try:
        return read_motor(path)
    except InputError as error:
        problems.extend(error.problems)
    return None


def compile_motor(
    file: RobotFile,
    servo: DescribedServo,
    table: ControlTable,
    declared: Mapping[str, int],
    found: MotorDescription | None,
) -> MotorModel | None:
    """Return a servo's motor model with the P gain of its registers; None without a (fitting) motor file."""
    if found is None:
        return None
    name, mark = servo.title, servo.mark(file.marks, "motor")
    per_effort = {"Nm": 1.0, "A": found.motor.torque_constant, "1": None}[table.effort_unit]
    motor = replace(found.motor, torque_per_effort=per_effort)
    if motor.model not in (table.model, *table.aliases):
        file.error(
            mark,
            f"{found.path.name} describes an {motor.model}, but {name} is an {table.model}",
            f"name a motor file of an {table.model}, or correct the model in the file",
        )
        return None
    item = next((table.items[each] for each in P_GAINS if each in table.items), None)
    if motor.position_gain is None:
        return motor
    if (item is None) != (motor.p_gain is None):
        missing = item is not None
        file.error(
            found.marks.key("position_gain" if missing else "p_gain"),
            f"{found.path.name} has a position_gain without a p_gain"
            if missing
            else f"an {table.model} has no P gain",
            f"write p_gain: {item.initial or 32}, the value of {item.name} at the identification"
            if item is not None
            else "remove p_gain; position_gain is then the duty per rad of error",
        )
        return None
    if item is None or motor.p_gain is None:
        return motor
    gain = declared.get(item.name)
    if gain is None and item.initial not in (None, motor.p_gain):
        file.warning(
            mark,
            f"{name} was identified with {item.name} = {motor.p_gain}, but servos start with {item.initial}",
            f"write `registers: {{{item.name}: {motor.p_gain}}}` for {name}",
        )
    return replace(motor, p_gain=motor.p_gain if gain is None else gain)
