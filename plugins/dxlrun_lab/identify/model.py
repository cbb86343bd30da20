"""Model of a servo with a load: the servo's control, a direct-current motor, and the friction of the gear.

Voltage, back-EMF, Coulomb and viscous friction, and the inertia of motor and gear are modelled as in M.
Schwarz and S. Behnke, "Compliant Robot Behavior using Servo Actuator Models identified by Iterative Learning
Control" (RoboCup 2013). Additional friction follows M3 and M4 of M. Duclusaud et al., "Extended Friction
Models for the Physics Simulation of Servo Actuators" (arXiv 2410.08650): a fraction of the torque between
motor and load, and additional friction at rest (Stribeck).

All torques are divided by the inertia of motor and load, because positions alone do not determine the scale
of torques. `result.py` converts them to torques.

    duty = gain * (goal - position) + damping part, beyond the margin, + punch; within the limit
    acceleration = drive * (V duty - back_emf * velocity) - gravity(position) - friction
"""

from __future__ import annotations

from collections.abc import Mapping

import msgspec
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

STEP_S = 2e-3
"""Step of the simulation, s: a seventh of the shortest time constant of a servo's motor. The integration is
of second order, so the error is about 1 in 600."""


class Numbers(msgspec.Struct, frozen=True):
    """Parameters of the servo model; I is the inertia of motor, gear and load"""

    drive: float
    """Acceleration per volt, torque constant / (resistance I), rad/s^2/V"""
    back_emf: float
    """Back-EMF constant, V s/rad, which equals the torque constant in Nm/A"""
    friction: float = 0.0
    """Coulomb friction / I, rad/s^2"""
    load_friction: float = 0.0
    """Friction per torque between motor and load, Nm/Nm"""
    viscous_friction: float = 0.0
    """Viscous friction / I, 1/s"""
    stribeck_friction: float = 0.0
    """Additional friction / I at rest, rad/s^2; in motion it is scaled by exp(-(velocity / stribeck_speed)^2)
    """
    stribeck_speed: float = 0.5
    """Speed at which the additional friction at rest has fallen to 1/e, rad/s"""
    gain: float = 0.0
    """Duty per rad of error, with the servo's present P gain"""
    delay: float = 0.0
    """Time from the goal's instruction to its effect, minus the age of a position when it is read, s"""
    gravity_sin: float = 0.0
    """Gravity that opposes the motion, as the factor of sin(position), rad/s^2"""
    gravity_cos: float = 0.0
    """Gravity in the direction of the motion, as the factor of cos(position), rad/s^2"""
    resistance: float = 1.0
    """Resistance in the scale of the servo's current measurement, ohm"""
    effort_delay: float = 0.0
    """Age of a measured effort relative to the position in the same reply, s"""

    def array(self) -> Floats:
        """Return the parameters in the order of ROWS."""
        return np.array(msgspec.structs.astuple(self))

    @classmethod
    def from_array(cls, values: Floats) -> Numbers:
        """Create the parameters from an array in the order of ROWS."""
        return cls(*(float(value) for value in values))


ROWS: Mapping[str, int] = {name: row for row, name in enumerate(Numbers.__struct_fields__)}
"""Row of each parameter in the arrays of `Numbers.array` and `simulate`"""


class Control(msgspec.Struct, frozen=True):
    """Properties of the servo's control except its gain, from registers and manual"""

    limit: float = 1.0
    """Highest duty (fraction of full voltage), 0..1"""
    damping_s: float = 0.0
    """Ratio of D gain to P gain of the position control, s"""
    margin: float = 0.0
    """Dead band of the error, rad"""
    punch: float = 0.0
    """Duty with which the servo starts at the edge of the margin, fraction of full voltage"""
    by_position: bool = True
    """True if the command is a position, rad; False if it is the duty"""


class PieceBatch(msgspec.Struct, frozen=True):
    """Pieces of a run that are simulated in parallel, each from its initial state on a time grid of STEP_S"""

    start_s: Floats
    """Time of each piece's first grid point in the run, s; shape (pieces,)"""
    steps: int
    """Number of steps of each piece"""
    voltage: Floats
    """Supply voltage at each step, V; shape (steps, pieces)"""
    position: Floats
    """Initial position, rad, shape (pieces,)"""
    velocity: Floats
    """Initial velocity, rad/s, shape (pieces,)"""
    command_s: Floats
    """Time of each command in the run, s; shape (commands,)"""
    command: Floats
    """Position, rad, or duty; each command holds until the next one"""

    def commands(self, delays: Floats) -> Floats:
        """Return the mean command in each step if commands act after a delay, s.

        The result has an entry for each delay; shape (steps, delays, pieces).
        """
        grid = self.start_s + np.arange(self.steps + 1)[:, None] * STEP_S
        sent, held = self.command_s, self.command
        area = np.concatenate(([0.0], np.cumsum(np.diff(sent) * held[:-1])))
        t = grid[:, None, :] - delays[:, None]
        # The integral of a held command is piecewise linear. Both ends are extrapolated.
        total = np.interp(t, sent, area)
        total += np.minimum(t - sent[0], 0.0) * held[0] + np.maximum(t - sent[-1], 0.0) * held[-1]
        mean: Floats = np.diff(total, axis=0) / STEP_S
        return mean


class SimulatedPieces(msgspec.Struct, frozen=True):
    """Simulated motion of pieces, at each grid point; shape (steps + 1, sets of parameters, pieces)"""

    position: Floats
    """rad"""
    velocity: Floats
    """rad/s"""
    duty: Floats
    """Fraction of full voltage; the last row repeats the previous one"""
    current: Floats
    """Motor current, A, in the scale of `resistance`"""


def simulate(values: Floats, pieces: PieceBatch, control: Control) -> SimulatedPieces:
    """Simulate all pieces with several sets of parameters, `values` of shape (parameters, sets).

    Damping uses the Crank-Nicolson rule, and the control uses the position in the middle of a step. Friction
    cannot reverse the velocity within a step.
    """
    column = {name: values[row][:, None] for name, row in ROWS.items()}
    drive, back_emf, gain = column["drive"], column["back_emf"], column["gain"]
    friction, part, extra = column["friction"], column["load_friction"], column["stribeck_friction"]
    per_speed = 1.0 / np.maximum(column["stribeck_speed"], 1e-3)
    sine, cosine, h = column["gravity_sin"], column["gravity_cos"], STEP_S
    motor_damping = drive * back_emf
    half = (motor_damping + column["viscous_friction"]) * (h / 2)
    keep, per_step, least = 1.0 - half, 1.0 / (1.0 + half), h * friction
    commands = pieces.commands(values[ROWS["delay"]])
    sets, count = values.shape[1], len(pieces.start_s)
    position, velocity = np.empty((2, pieces.steps + 1, sets, count))
    duties = np.empty((pieces.steps + 1, sets, count))
    q, w = np.broadcast_to(pieces.position, (sets, count)), np.broadcast_to(pieces.velocity, (sets, count))
    heavy, sticks, loaded = bool(sine.any() or cosine.any()), bool(extra.any()), bool(part.any())
    for step in range(pieces.steps):
        position[step], velocity[step] = q, w
        duty = commands[step]
        if control.by_position:
            middle = q + (h / 2) * w
            duty = _duty(duty - middle, w, gain, control)
        duty = np.minimum(np.maximum(duty, -control.limit), control.limit)
        duties[step] = duty
        push = drive * (duty * pieces.voltage[step])
        pull = sine * np.sin(q) - cosine * np.cos(q) if heavy else 0.0
        free = keep * w + h * (push - pull)
        most = least
        if loaded:
            most = most + h * part * np.abs(push - motor_damping * w + pull)
        if sticks:
            most = most + h * extra * np.exp(-np.square(w * per_speed))
        free = free - np.minimum(np.maximum(free, -most), most)
        after = free * per_step
        q = q + (h / 2) * (w + after)
        w = after
    position[-1], velocity[-1], duties[-1] = q, w, duties[-2]
    voltage = np.concatenate((pieces.voltage, pieces.voltage[-1:]))[:, None, :]
    current = (voltage * duties - back_emf * velocity) / column["resistance"]
    return SimulatedPieces(position, velocity, duties, current)


def _duty(error: Floats, w: Floats, gain: Floats, control: Control) -> Floats:
    """Return the duty of the position control for an error, rad, before clamping; `w` is the velocity."""
    if control.margin or control.punch:
        outside = np.abs(error) - control.margin
        error = np.where(outside > 0.0, np.copysign(outside + control.punch / gain, error), 0.0)
    if control.damping_s:
        error = error - control.damping_s * w
    duty: Floats = gain * error
    return duty
