"""States of a running robot in one cycle: arrays with the names and units of their rows."""

from __future__ import annotations

import math
from typing import get_args

import msgspec
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Bools = NDArray[np.bool_]

_OF_JOINTS = (
    *("position", "velocity", "effort", "valid", "goal_position", "goal_velocity", "goal_effort"),
    *("goal_pwm", "temperature", "voltage", "hardware_error", "mode", "torque"),
)


class RobotStates(msgspec.Struct, frozen=True):
    """The newest cycle. Arrays have a row for each name, in its order; NaN: not known, or not commanded."""

    cycle: int
    time_ns: int
    """Wake-up of the cycle, ns of the run's clock."""
    late_ns: int
    """How much later than its deadline that was."""
    joints: tuple[str, ...]
    units: tuple[str, ...]
    """Of each joint's positions, `rad` or `m`; velocities are these a second."""
    effort_units: tuple[str, ...]
    """`Nm`, `N`, `A`; empty: the fraction of the servo's maximum."""
    position: Floats
    velocity: Floats
    effort: Floats
    valid: Bools
    """True where this cycle's reply arrived intact."""
    age_ns: Integers
    """Time since the reply that the row shows; -1 while none ever came."""
    goal_position: Floats
    goal_velocity: Floats
    goal_effort: Floats
    goal_pwm: Floats
    temperature: Floats
    """deg C"""
    voltage: Floats
    hardware_error: Integers
    """Bits of the servo's Hardware Error Status."""
    mode: tuple[str, ...]
    torque: tuple[str, ...]
    """`on`, `doubt`, `limp`, `lost`, `rebooting`, `given`"""
    references: tuple[str, ...]
    reference: Floats
    """What controllers command of each other."""
    source_states: tuple[str, ...]
    """States of devices, sensors, and controllers that provide some: `imu/orientation.x`."""
    source_state: Floats
    """SI units"""
    sources: tuple[str, ...]
    source_valid: Bools
    source_age_ns: Integers
    """-1: none ever came."""
    device_commands: tuple[str, ...]
    """Items of devices that controllers command: `board/led`."""
    device_command: Floats
    """What is commanded of each of them, in its unit."""
    controllers: tuple[str, ...]
    controller_ns: Integers
    """How long each controller's update took in this cycle; 0: it had none."""
    source_units: dict[str, str] = {}
    """SI units of the states of sources that have one, by `imu/angular_velocity.x`."""
    command_units: dict[str, str] = {}
    """SI units of the commands of sources that have one, by `board/fan`."""

    @property
    def source_names(self) -> tuple[str, ...]:
        """Names of sources, of their states and of their commands."""
        return (*self.sources, *self.source_states, *self.device_commands)

    def joint(self, name: str) -> dict[str, object]:
        """Return the row of a joint by names of fields, `age` in s; None: not known. Raises ValueError."""
        row = self.joints.index(name)
        found = {field: _plain(getattr(self, field)[row]) for field in _OF_JOINTS}
        return {**found, "age": int(self.age_ns[row]) * 1e-9}

    def source(self, name: str) -> dict[str, object] | None:
        """Return states, commands, their units, `valid` and `age`, s, of a source of states.

        Args:
            name: Its own name, or that of one state or command, `imu/orientation.x`.

        Returns:
            None where there is no such source. A command is null where no controller commands it.
        """
        owner = name.partition("/")[0]
        states, commands, units, command_units = (
            {
                full.partition("/")[2]: value
                for full, value in values
                if name in (full, full.partition("/")[0])
            }
            for values in (
                [*zip(self.source_states, map(_plain, self.source_state), strict=True)],
                [*zip(self.device_commands, map(_plain, self.device_command), strict=True)],
                self.source_units.items(),
                self.command_units.items(),
            )
        )
        if not states and not commands:
            return None
        place = self.sources.index(owner)
        age_ns = int(self.source_age_ns[place])
        age = age_ns * 1e-9 if age_ns >= 0 else None
        return {
            "valid": bool(self.source_valid[place]),
            "age": age,
            "states": states,
            "commands": commands,
            "units": units,
            "command_units": command_units,
        }


def encoded(states: RobotStates) -> bytes:
    """Return states as JSON; NaN becomes null."""
    return msgspec.json.encode(states, enc_hook=lambda array: array.tolist())


def array(kind: type, values: object) -> object:
    """Return the array of a field; null becomes NaN."""
    return np.array(values, get_args(get_args(kind)[1])[0])


def _plain(value: object) -> object:
    plain = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(plain, float) and not math.isfinite(plain) else plain
