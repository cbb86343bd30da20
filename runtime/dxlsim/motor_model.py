"""Motor model: motor, gear and position control of a servo, as identified.

Seen at the horn, in SI units. With the duty u (fraction of the supply's voltage U at the motor) and the speed
w,

    torque = (torque_constant / resistance) * (u * U - torque_constant * w)
    (inertia + load.inertia) * dw/dt = torque - friction - load.gravity * sin(angle - load.gravity_angle)

(M. Schwarz, S. Behnke, "Compliant Robot Behavior using Servo Actuator Models identified by Iterative Learning
Control", RoboCup 2013, section 3). The friction model and its source are in `dxlsim/motion/motor.py`. In
position control u = position_gain * p_gain * (goal - angle).
"""

from __future__ import annotations

import msgspec


class Stribeck(msgspec.Struct, frozen=True):
    """Additional friction of a motor near standstill: friction * exp(-(|speed| / velocity)**exponent).

    B. Armstrong-Helouvry, P. Dupont, C. Canudas de Wit, "A survey of models, analysis tools and
    compensation methods for the control of machines with friction", Automatica 30 (1994), section 2."""

    friction: float  # Nm
    velocity: float  # rad/s
    exponent: float = 2.0


class MotorLoad(msgspec.Struct, frozen=True):
    """Load on the servo during the identification, in addition to the motor's own rotor and gear."""

    inertia: float = 0.0  # kg m^2
    gravity: float = 0.0  # Torque of the weight in the horizontal position, Nm
    gravity_angle: float = 0.0  # rad of the joint with the weight straight down


class MotorModel(msgspec.Struct, frozen=True):
    """Content of a motor file: the parameters of a servo's motor. A joint of the robot file references it."""

    model: str  # Model of the servo: MX-64
    voltage: float  # V of the supply, unless it is measured
    torque_constant: float  # Nm/A, equal to V s/rad of the back EMF
    resistance: float  # ohm
    inertia: float  # kg m^2 of rotor and gear
    friction: float = 0.0  # Nm that hold the shaft at rest, and brake it in motion (Coulomb)
    load_friction: float = 0.0  # Nm of friction per Nm between the motor's torque and that of the load
    viscous_friction: float = 0.0  # Nm s/rad
    stribeck: Stribeck | None = None
    position_gain: float | None = None
    """Duty per rad of error and unit of the P gain's register; None: not identified."""
    p_gain: int | None = None
    """Value of the P gain's register: from the robot file's `registers`, else the one at which
    `position_gain` was identified. None: the servo has no such register, and `position_gain` is the
    whole gain."""
    delay_ns: int = 0  # Delay between a goal's arrival at the servo and at the motor
    load: MotorLoad = MotorLoad()
    source: str = ""  # Data of the identification
    torque_per_effort: float | None = None
    """Joint torque, Nm, per unit of the effort that the servo measures and accepts, A or Nm. None: the
    effort has another unit, or no joint was compared with the file yet."""

    @property
    def stiffness(self) -> float | None:
        """Duty per rad between goal and angle at the P gain `p_gain`; None: not identified."""
        if self.position_gain is None:
            return None
        return self.position_gain * (1 if self.p_gain is None else self.p_gain)
