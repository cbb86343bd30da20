"""States of a running robot in one cycle: arrays with the names and units of their rows."""

from __future__ import annotations

import math
from typing import get_args

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun.description.source_names import SOURCE_COMMAND, SOURCE_COMMANDS, OlderSourceNames

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Bools = NDArray[np.bool_]

_OF_JOINTS = (
    *("position", "velocity", "effort", "valid", "goal_position", "goal_velocity", "goal_effort"),
    *("goal_pwm", "temperature", "voltage", "hardware_error", "mode", "torque"),
)


class RobotStates(OlderSourceNames, msgspec.Struct, frozen=True):
    """Snapshot of the newest cycle. Arrays have one row for each name; NaN is unknown or not commanded."""

    cycle: int
    time_ns: int
    """Wake-up of the cycle, ns of the run's clock."""
    late_ns: int
    """Delay of the wake-up after its scheduled time."""
    joints: tuple[str, ...]
    units: tuple[str, ...]
    """Unit of each joint's position, `rad` or `m`; the unit of its velocity is this unit per second."""
    effort_units: tuple[str, ...]
    """Unit of each joint's effort: `Nm`, `N`, `A`; empty: fraction of the servo's maximum."""
    position: Floats
    velocity: Floats
    effort: Floats
    valid: Bools
    """True for joints whose reply of this cycle was received intact."""
    age_ns: Integers
    """Time since the reply that the row shows; -1 before the first reply."""
    goal_position: Floats
    goal_velocity: Floats
    goal_effort: Floats
    goal_pwm: Floats
    temperature: Floats
    """deg C"""
    voltage: Floats
    hardware_error: Integers
    """Bits of the control table item Hardware Error Status."""
    mode: tuple[str, ...]
    torque: tuple[str, ...]
    """`on`, `doubt`, `limp`, `lost`, `rebooting`, `given`"""
    references: tuple[str, ...]
    reference: Floats
    """Commands from controllers to other controllers."""
    source_states: tuple[str, ...]
    """States of devices, sensors, and controllers that provide states: `imu/orientation.x`."""
    source_state: Floats
    """SI units"""
    sources: tuple[str, ...]
    source_valid: Bools
    source_age_ns: Integers
    """-1 before the first values."""
    source_commands: tuple[str, ...] = msgspec.field(name=SOURCE_COMMANDS)
    """Commands of devices and other sources: `board/led`."""
    source_command: Floats = msgspec.field(name=SOURCE_COMMAND)
    """Commanded value of each command, in its unit."""
    controllers: tuple[str, ...]
    controller_ns: Integers
    """Duration of each controller's update in this cycle; 0 without an update."""
    source_units: dict[str, str] = {}
    """SI units of source states that have a unit, by `imu/angular_velocity.x`."""
    command_units: dict[str, str] = {}
    """SI units of source commands that have a unit, by `board/fan`."""

    @property
    def source_names(self) -> tuple[str, ...]:
        """Names of sources, their states and their commands."""
        return (*self.sources, *self.source_states, *self.source_commands)

    def joint(self, name: str) -> dict[str, object]:
        """Return the values of a joint by field name, with `age` in s; None is unknown. Raises ValueError."""
        row = self.joints.index(name)
        found = {field: _plain(getattr(self, field)[row]) for field in _OF_JOINTS}
        return {**found, "age": int(self.age_ns[row]) * 1e-9}

    def source(self, name: str) -> dict[str, object] | None:
        """Return states, commands, units, `valid` and `age` (s) of a device, a sensor or another source.

        Args:
            name: Name of the source, or of one state or command, such as `imu/orientation.x`.

        Returns:
            None for an unknown source. A command is null when no controller commands it.
        """
        owner = name.partition("/")[0]
        values = {
            "states": zip(self.source_states, map(_plain, self.source_state), strict=True),
            "commands": zip(self.source_commands, map(_plain, self.source_command), strict=True),
            "units": self.source_units.items(),
            "command_units": self.command_units.items(),
        }
        found = {
            kind: {
                full.partition("/")[2]: one for full, one in pairs if name in (full, full.partition("/")[0])
            }
            for kind, pairs in values.items()
        }
        if not found["states"] and not found["commands"]:
            return None
        place = self.sources.index(owner)
        age_ns = int(self.source_age_ns[place])
        age = age_ns * 1e-9 if age_ns >= 0 else None
        return {
            "valid": bool(self.source_valid[place]),
            "age": age,
            **found,
        }


def encoded(states: RobotStates) -> bytes:
    """Return states as JSON; NaN becomes null."""
    return msgspec.json.encode(states, enc_hook=lambda array: array.tolist())


def array(kind: type, values: object) -> object:
    """Return the NumPy array of a field; null becomes NaN. Decoding hook of msgspec."""
    return np.array(values, get_args(get_args(kind)[1])[0])


def _plain(value: object) -> object:
    plain = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(plain, float) and not math.isfinite(plain) else plain
