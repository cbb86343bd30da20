"""Motor: the model of a servo's motor, gear and position control, as it was identified.

Felt at the horn, in SI. With the duty u (part of the supply's voltage U at the motor) and the speed w,

    torque = (torque_constant / resistance) * (u * U - torque_constant * w)
    (inertia + load.inertia) * dw/dt = torque - friction - load.gravity * sin(angle - load.gravity_angle)

(M. Schwarz, S. Behnke, "Compliant Robot Behavior using Servo Actuator Models identified by Iterative Learning
Control", RoboCup 2013, section 3). Friction is that of `dxlsim/motion/motor.py`, where its source is. In
position control u = position_gain * p_gain * (goal - angle).
"""

from __future__ import annotations

import msgspec


class Stribeck(msgspec.Struct, frozen=True):
    """Friction that is there near standstill only: friction * exp(-(|speed| / velocity)**exponent).

    B. Armstrong-Helouvry, P. Dupont, C. Canudas de Wit, "A survey of models, analysis tools and compensation
    methods for the control of machines with friction", Automatica 30 (1994), section 2.
    """

    friction: float  # Nm
    velocity: float  # rad/s
    exponent: float = 2.0


class MotorLoad(msgspec.Struct, frozen=True):
    """What the motor moved when it was identified, beside its own rotor and gear."""

    inertia: float = 0.0  # kg m^2
    gravity: float = 0.0  # Nm of the weight where it sticks out horizontally
    gravity_angle: float = 0.0  # rad of the joint, where the weight hangs straight down


class MotorModel(msgspec.Struct, frozen=True):
    """A servo's motor; the figures of a motor file, which a joint of the robot file names."""

    model: str  # Of the servo: MX-64
    voltage: float  # V of the supply, where it is not measured
    torque_constant: float  # Nm/A, and V s/rad of the motor's own voltage
    resistance: float  # ohm
    inertia: float  # kg m^2 of rotor and gear
    friction: float = 0.0  # Nm that hold the shaft at rest, and brake it in motion (Coulomb)
    load_friction: float = 0.0  # Nm of friction for each Nm between the motor's torque and that of the load
    viscous_friction: float = 0.0  # Nm s/rad
    stribeck: Stribeck | None = None
    position_gain: float | None = None
    """Duty for each rad of error and one unit of the P gain; None: not identified"""
    p_gain: int | None = None
    """The P gain's register: that of the robot file's `registers`, else the one at which `position_gain` was
    identified; None: the servo has no such register, and `position_gain` is all of it"""
    delay_ns: int = 0  # From a goal's arrival at the servo until the motor has it
    load: MotorLoad = MotorLoad()
    source: str = ""  # What it was identified from
    torque_per_effort: float | None = None
    """Nm for each unit of the effort that the servo measures and takes, A or Nm; None: it is another unit, or
    no joint was compared with the file yet"""

    @property
    def stiffness(self) -> float | None:
        """Duty for each rad between goal and angle; None: not identified."""
        if self.position_gain is None:
            return None
        return self.position_gain * (1 if self.p_gain is None else self.p_gain)
