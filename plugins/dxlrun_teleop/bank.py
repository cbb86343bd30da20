"""Banks: assignment of axes to joints or base velocities, from the active controllers of a running robot."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from enum import Enum, unique
from typing import Any, cast

import msgspec
from msgspec.structs import replace

from dxlrun import InputError, RemoteRobot
from dxlrun.tooling.files import suggestion

Row = Mapping[str, Any]
"""Mapping in `RemoteRobot.info`, such as the entry of a controller"""
USUAL_SPEED = {"rad": 0.5, "m": 0.05}
"""Speed of a joint at full deflection of an axis and speed factor 1, by unit: rad/s and m/s"""
USUAL_TWIST = {"linear": 0.2, "angular": 1.0}
"""Speed of a base, or of a tip in space, at full deflection of an axis and speed factor 1, m/s and rad/s.
It is lower if the base or the tip needs longer than BRAKING_S to stop."""
BRAKING_S = 0.2
"""Longest time in which a base or a tip stops from full deflection, s"""
SPACE = dict.fromkeys(("vx", "vy", "vz"), "linear") | dict.fromkeys(("wz", "wy", "wx"), "angular")
"""Limits of each number of a twist in space, in the order of the axes: forward, left, up and yaw, as the
sticks of a gamepad are deflected, then pitch and roll"""
HORIZON_S = 0.1
"""Duration of the trajectories that drive a joint of a trajectory controller, s. Each one ends at rest, so
the joint stops without a further command."""
_ROOM = 1.5
"""Ratio of a joint's speed limit to the highest speed of its axis, because a trajectory that catches up is
faster than the axis"""
_LEADING = 1.25
"""Ratio of the speed that is sent with a position to the speed of the axis, so that the servo keeps up"""


@unique
class CommandForm(Enum):
    """Form of a controller's command: its field names, and True if axes are integrated to positions."""

    POSITIONS = frozenset({"positions"}), True
    POSVEL = frozenset({"positions", "velocities"}), True
    VELOCITIES = frozenset({"velocities"}), False
    TWIST = frozenset({"linear", "angular"}), False
    SPACE = frozenset({*SPACE, "frame"}), False
    TRAJECTORY = frozenset({"points", "joints"}), True

    def __init__(self, fields: frozenset[str], integrates: bool) -> None:
        self.fields, self.integrates = fields, integrates

    def fits(self, fields: Collection[str]) -> bool:
        """Return True if a command with these fields has this form. A trajectory may have more fields."""
        return self.fields <= set(fields) if self is CommandForm.TRAJECTORY else self.fields == set(fields)


class Slot(msgspec.Struct, frozen=True):
    """One number of a controller's command that an axis can drive: a joint, or a speed of a base"""

    name: str
    """Joint, or field of a twist: linear, angular"""
    unit: str
    """`rad` or `m`; speeds are in this unit per second"""
    speed: float
    """Speed at full deflection of the axis and speed factor 1"""
    most: float
    """Speed limit, whatever the speed factor"""
    lower: float = -math.inf
    """Lower position limit of the joint, rad or m"""
    upper: float = math.inf


class Bank(msgspec.Struct, frozen=True):
    """Assignment of the device's axes to the command of one controller, of which one is active at a time"""

    controller: str
    kind: str
    """Kind of the command, such as `posvel`"""
    form: CommandForm
    slots: tuple[Slot, ...]
    """All numbers of the command, in its order"""
    driven: tuple[int, ...]
    """For each axis of the device, index in `slots` of the number that it drives"""
    into: tuple[str, ...] = ()
    """Controllers whose references the controller commands; empty if it commands servos"""

    def build_command(self, values: Sequence[float], factor: float) -> dict[str, object]:
        """Return the fields of the controller's command with these values, one per slot (SI units)."""
        match self.form:
            case CommandForm.TWIST | CommandForm.SPACE:
                return {slot.name: value for slot, value in zip(self.slots, values, strict=True)}
            case CommandForm.VELOCITIES:
                return {"velocities": values}
            case CommandForm.POSITIONS:
                return {"positions": values}
            case CommandForm.POSVEL:
                speeds = [_LEADING * min(slot.most, slot.speed * factor) for slot in self.slots]
                return {"positions": values, "velocities": speeds}
            case CommandForm.TRAJECTORY:
                ends = [values[index] for index in self.driven]
                point = {"time": HORIZON_S, "positions": ends, "velocities": [0.0] * len(ends)}
                return {"points": [point], "joints": [self.slots[index].name for index in self.driven]}


def banks_of(robot: RemoteRobot, targets: Sequence[str], axes: int) -> list[Bank]:
    """Return the banks between which the user can switch, in the order of the targets.

    A controller with more numbers than axes has several banks. Controllers that other ones command, or that
    follow other joints, are omitted.

    Args:
        robot: Running robot.
        targets: Names of controllers, groups or joints; empty for everything that active controllers accept
            commands for.
        axes: Number of axes per bank.

    Raises:
        InputError: No active controller accepts commands for a target.
    """
    info = cast("Row", robot.info())
    active = [one for one in info["controllers"] if one["active"]]
    commanded = {lower for one in active for lower in one["into"]}
    free = [one for one in active if one["name"] not in commanded and not _follows(one, info)]
    whole = [bank for one in free if (bank := _bank(robot, one, info)) is not None]
    own = {bank.controller: [(bank, index) for index in bank.driven] for bank in whole}
    joints = {bank.slots[index].name: [(bank, index)] for places in own.values() for bank, index in places}
    groups = {
        name: [joints[one][0] for one in each if one in joints] for name, each in info["groups"].items()
    }
    words = {name: places for name, places in (joints | groups | own).items() if places}
    chosen: dict[str, dict[int, Bank]] = {}
    for target in targets or own or ("its joints",):
        if target not in words:
            hint = suggestion(target, words, "activate one with `dxlrun switch --activate NAME`")
            raise InputError(
                f"no active controller of {robot.name} accepts positions, velocities, twists or trajectories "
                f"for {target}; {hint}"
            )
        for bank, index in words[target]:
            chosen.setdefault(bank.controller, {})[index] = bank
    return [
        replace(bank, driven=tuple(driven)[first : first + axes])
        for driven in chosen.values()
        for first, bank in list(enumerate(driven.values()))[::axes]
    ]


def _follows(one: Row, info: Row) -> bool:
    """Return True if a controller moves as other joints do, such as a leader_follower: it needs the age of
    their states."""
    needed = {*one["reads"]}.difference(one["optional"])
    return not needed.isdisjoint(f"{joint}/age" for joint in info["units"])


def _bank(robot: RemoteRobot, one: Row, info: Row) -> Bank | None:
    """Return a bank that drives all numbers of a controller's command; None if no Form fits it."""
    for kind, schema in one["takes"].items():
        for form in (form for form in CommandForm if form.fits(schema.get("properties", ()))):
            match form:
                case CommandForm.TWIST:
                    slots = _twist(robot, one, {field: field for field in USUAL_TWIST})
                case CommandForm.SPACE:
                    slots = _twist(robot, one, SPACE)
                case _:
                    slots = [_joint(joint, info, form) for joint in one["joints"]]
            places = tuple(range(len(slots)))
            return Bank(one["name"], kind, form, tuple(slots), places, tuple(one["into"]))
    return None


def _joint(name: str, info: Row, form: CommandForm) -> Slot:
    unit, limit = info["units"][name], info["speeds"][name]
    most = math.inf if limit is None else limit / _ROOM if form.integrates else limit
    return Slot(name, unit, min(USUAL_SPEED[unit], most), most, *info["limits"].get(name, ()))


def _twist(robot: RemoteRobot, one: Row, fields: Mapping[str, str]) -> list[Slot]:
    """Return the slots of a twist, whose fields have linear or angular limits, with speeds from which a base
    or a tip can stop in BRAKING_S by the limits in the controller's parameters."""
    given, slots = robot.parameters(one["name"]), []
    for field, kind in fields.items():
        most, rise, sink, jerk = (
            float(text.split()[0]) if isinstance(text := given.get(f"{kind}.{limit}"), str) else math.inf
            for limit in ("velocity", "acceleration", "deceleration", "jerk")
        )
        braking = rise if math.isinf(sink) else sink
        # Time in which the deceleration builds up, and again in which it ends, under the jerk limit.
        growth_s = 0.0 if math.isinf(jerk) else min(BRAKING_S / 2, braking / jerk)
        # Area of a deceleration that ramps up and down in growth_s each.
        stops_from = (min(braking, jerk * growth_s) if growth_s else braking) * (BRAKING_S - growth_s)
        unit = "m" if kind == "linear" else "rad"
        slots.append(Slot(field, unit, min(USUAL_TWIST[kind], most, stops_from), most))
    return slots
