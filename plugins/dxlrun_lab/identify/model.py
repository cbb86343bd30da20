"""The model of a servo that moves a load: the servo's control, a direct-current motor, its gear's friction.

M. Schwarz and S. Behnke, "Compliant Robot Behavior using Servo Actuator Models identified by Iterative
Learning Control" (RoboCup 2013): voltage, back-EMF, Coulomb and viscous friction, inertia of motor and gear.
Friction beyond that as M3 and M4 of M. Duclusaud et al., "Extended Friction Models for the Physics Simulation
of Servo Actuators" (arXiv 2410.08650): a part of the torque between motor and load, and more at rest
(Stribeck).

Everything is divided by the inertia of motor and load, for that is all that positions show: a motion says
nothing of torques. `scale.py` makes torques of it.

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
"""s of a step of the simulation: a seventh of the shortest time constant of a servo's motor. Everything in a
step is of second order, so that a seventh is an error of a part in 600."""


class Numbers(msgspec.Struct, frozen=True):
    """The numbers of the model; of inertia I = that of motor, gear and load."""

    drive: float
    """rad/s^2 for a volt: torque constant / (resistance I)"""
    back_emf: float
    """V s/rad: the torque constant, Nm/A"""
    friction: float = 0.0
    """rad/s^2 of Coulomb friction / I"""
    load_friction: float = 0.0
    """Nm of friction for each Nm between the motor's torque and the load's"""
    viscous_friction: float = 0.0
    """1/s: viscous friction / I"""
    stribeck_friction: float = 0.0
    """rad/s^2 of friction / I at rest over Coulomb's; in motion exp(-(velocity / stribeck_speed)^2) of it"""
    stribeck_speed: float = 0.5
    """rad/s"""
    gain: float = 0.0
    """Duty for a rad of error, with the servo's P gain as it was"""
    delay: float = 0.0
    """s from the goal's instruction to its effect, less the age of a position when it is read"""
    gravity_sin: float = 0.0
    """rad/s^2 against the motion, times sin(position)"""
    gravity_cos: float = 0.0
    """rad/s^2 along the motion, times cos(position)"""
    resistance: float = 1.0
    """ohm, as the servo's own measurement of current has it"""
    effort_delay: float = 0.0
    """s by which a measured effort is older than the position beside it"""

    def array(self) -> Floats:
        """Return them in the order of ROWS."""
        return np.array(msgspec.structs.astuple(self))

    @classmethod
    def of(cls, values: Floats) -> Numbers:
        """Return the numbers of an array in the order of ROWS."""
        return cls(*(float(value) for value in values))


ROWS: Mapping[str, int] = {name: row for row, name in enumerate(Numbers.__struct_fields__)}
"""The row of each number in an array of them."""


class Control(msgspec.Struct, frozen=True):
    """What is known of the servo's control beside its gain, from registers and manual."""

    limit: float = 1.0
    """Most duty"""
    damping_s: float = 0.0
    """s: D gain over P gain"""
    margin: float = 0.0
    """rad of error that are left alone"""
    punch: float = 0.0
    """Duty at the edge of the margin"""
    by_position: bool = True
    """False: the command is the duty itself"""


class Pieces(msgspec.Struct, frozen=True):
    """Pieces of a run that are simulated side by side; shape (steps, pieces) on a grid of STEP_S."""

    start_s: Floats
    """Shape (pieces,): time of the first point of the grid"""
    steps: int
    voltage: Floats
    """V at each step"""
    position: Floats
    """Shape (pieces,): rad, where each begins"""
    velocity: Floats
    """Shape (pieces,): rad/s"""
    command_s: Floats
    """Shape (commands,): when each command of the run was sent"""
    command: Floats
    """rad, or the duty; each holds until the next one"""

    def commands(self, delays: Floats) -> Floats:
        """Return the mean command of each step under some delays, s; shape (steps, delays, pieces)."""
        grid = self.start_s + np.arange(self.steps + 1)[:, None] * STEP_S
        sent, held = self.command_s, self.command
        area = np.concatenate(([0.0], np.cumsum(np.diff(sent) * held[:-1])))
        t = grid[:, None, :] - delays[:, None]
        # the integral of the held command is a chain of straight lines; before the first one it holds as well
        total = np.interp(t, sent, area)
        total += np.minimum(t - sent[0], 0.0) * held[0] + np.maximum(t - sent[-1], 0.0) * held[-1]
        mean: Floats = np.diff(total, axis=0) / STEP_S
        return mean


class Simulated(msgspec.Struct, frozen=True):
    """What the model does in each piece; shape (steps + 1, sets of numbers, pieces)."""

    position: Floats
    velocity: Floats
    duty: Floats
    """The last row repeats the one before"""
    current: Floats
    """A, in the scale of `resistance`"""


def simulate(values: Floats, pieces: Pieces, control: Control) -> Simulated:
    """Simulate all pieces with several sets of numbers at once; `values` of shape (numbers, sets).

    Damping by Crank and Nicolson's rule, control by the position in the middle of a step; friction takes in a
    step at most the velocity that there is.
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
    return Simulated(position, velocity, duties, current)


def _duty(error: Floats, w: Floats, gain: Floats, control: Control) -> Floats:
    """Return the duty for an error, rad, before it is limited; the damping part brakes all velocity."""
    if control.margin or control.punch:
        outside = np.abs(error) - control.margin
        error = np.where(outside > 0.0, np.copysign(outside + control.punch / gain, error), 0.0)
    if control.damping_s:
        error = error - control.damping_s * w
    duty: Floats = gain * error
    return duty
