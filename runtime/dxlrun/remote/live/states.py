"""States: the states of a running robot in one cycle, as arrays with the names and units of their rows."""

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
    """States of the newest cycle. Arrays have one row for each name; NaN is unknown or not commanded."""

    cycle: int
    time_ns: int
    """Time at which the loop woke for the cycle, ns of the run's clock."""
    late_ns: int
    """Delay of the loop's wake-up after its scheduled time, ns."""
    joints: tuple[str, ...]
    units: tuple[str, ...]
    """Unit of each joint's position, `rad` or `m`; the unit of its velocity is this unit per second."""
    effort_units: tuple[str, ...]
    """Unit of each joint's effort: `Nm`, `N`, `A`; empty: fraction of the servo's maximum."""
    position: Floats
    velocity: Floats
    effort: Floats
    valid: Bools
    """True for joints whose reply in this cycle was received intact."""
    age_ns: Integers
    """Age of each joint's states, ns: time since the reply that they come from; -1 before the first reply."""
    goal_position: Floats
    goal_velocity: Floats
    goal_effort: Floats
    goal_pwm: Floats
    temperature: Floats
    """Temperature of the servo, deg C."""
    voltage: Floats
    hardware_error: Integers
    """Bits of the control table item Hardware Error Status of the servo."""
    mode: tuple[str, ...]
    torque: tuple[str, ...]
    """State of the servo's torque: `on`, `doubt`, `limp`, `lost`, `rebooting`, `given`."""
    references: tuple[str, ...]
    reference: Floats
    """Values that controllers command to the inputs of other controllers, in the order of `references`."""
    source_states: tuple[str, ...]
    """Names of the states of devices, sensors, and controllers that provide states: `imu/orientation.x`."""
    source_state: Floats
    """Value of each source state, SI units."""
    sources: tuple[str, ...]
    source_valid: Bools
    source_age_ns: Integers
    """Age of each source's states, ns; -1 before the first values."""
    source_commands: tuple[str, ...] = msgspec.field(name=SOURCE_COMMANDS)
    """Names of the commands of devices and other sources: `board/led`."""
    source_command: Floats = msgspec.field(name=SOURCE_COMMAND)
    """Present value of each source command, in its unit; NaN when no controller commands it."""
    controllers: tuple[str, ...]
    controller_ns: Integers
    """Computing time of each controller's update in this cycle, ns; 0 without an update."""
    source_units: dict[str, str] = {}
    """Source state, such as `imu/angular_velocity.x`, -> its SI unit; states without unit are not in it."""
    command_units: dict[str, str] = {}
    """Source command, such as `board/fan`, -> its SI unit; commands without unit are not in it."""

    @property
    def source_names(self) -> tuple[str, ...]:
        """Names of all sources, followed by those of their states and commands."""
        return (*self.sources, *self.source_states, *self.source_commands)

    def joint(self, name: str) -> dict[str, object]:
        """Return a joint's states and goals by field name, with `age` in s; None is unknown.

        Raises ValueError for an unknown joint.
        """
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
    """Return states as JSON, arrays as lists; NaN becomes null."""
    return msgspec.json.encode(states, enc_hook=lambda array: array.tolist())


def array(kind: type, values: object) -> object:
    """Return a list from JSON as the array that a field of RobotStates has; null becomes NaN (hook of
    msgspec).
    """
    return np.array(values, get_args(get_args(kind)[1])[0])


def _plain(value: object) -> object:
    plain = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(plain, float) and not math.isfinite(plain) else plain
