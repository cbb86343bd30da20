"""Places: which value of a robot file `gains.p` is."""

from __future__ import annotations

from collections.abc import Iterator, Set
from contextlib import suppress

from dxlrun.compile.controllers import read_controller_files
from dxlrun.compile.joints.described_servos import described_servos
from dxlrun.compile.problems import RobotFile
from dxlrun.control.controllers.plugins import load_plugins
from dxlrun.description.document import KeyPath
from dxlrun.description.problems import keys_at, path_text
from dxlrun.description.reading import Description
from dxlrun.description.robot import Robot
from dxlrun.dynamixel.control_table import control_table
from dxlrun.errors import suggestion

_MOST_SHOWN = 6
_OWN_KEYS = ("type", "active", "rate", "fallback", "into")
"""Of a controller's entry; all others are parameters of its type."""


def find_place(description: Description, steps: KeyPath) -> KeyPath:
    """Return the place that a path means, shortened as far as it stays clear.

    An argument's name is that argument, ("arguments", NAME). Else it is the only value of the file whose path
    ends so; else the only place that the file could have, such as a register that it does not declare. Raises
    ValueError with `what; how to fix it`.
    """
    name = path_text(steps)
    if len(steps) == 1 and steps[0] in description.arguments:
        return ("arguments", str(steps[0]))
    written = set(_written(description))
    containers = {path[:end] for path in written for end in range(len(path))}
    found = sorted((path for path in written if path[-len(steps) :] == steps), key=path_text)
    if not found and (inner := [path for path in containers if path and path[-len(steps) :] == steps]):
        own = [path for path in written if path[: len(inner[0])] == inner[0]]
        values = sorted(path_text(path[len(inner[0]) - len(steps) :]) for path in own)
        raise ValueError(f"{name} has values in it; name one of them: {_some(values)}")
    if not found:
        possible = _possible(description, steps, containers)
        found = sorted((path for path in possible if not _below_one(path, written)), key=path_text)
    if len(found) == 1:
        return found[0]
    if found:
        raise ValueError(
            f"{name} stands at {len(found)} places; name one of them: {_some([path_text(p) for p in found])}"
        )
    if (joint := _having(description, str(steps[-1]))) is not None:
        raise ValueError(
            f"the robot file declares no register {name}; write it there first, at {joint} for example: "
            f"`registers: {{{steps[-1]}: VALUE}}`"
        )
    known = {path_text(path[start:]) for path in written for start in range(len(path))}
    texts = sorted((*known, *description.arguments))
    hint = suggestion(name, texts)
    raise ValueError(
        f"the robot file has no {name}; "
        + (hint if hint.startswith("did") else "write the place with dots, from the top of the file")
    )


def _having(description: Description, item: str) -> str | None:
    """Return a joint whose servo has a register of this name that a robot file may declare."""
    for servo in described_servos(description):
        with suppress(LookupError, KeyError):
            table = control_table(servo.model, description.robot.buses[servo.bus].protocol)
            if table.items[item].access == "RW":
                return servo.joints[0]
    return None


def _written(description: Description) -> Iterator[KeyPath]:
    """Yield the paths of all values that are neither mappings nor lists."""
    paths = description.marks.values
    inner = {path[:-1] for path in paths if path}
    for path in paths:
        if path and path[0] not in Robot.read_before and path not in inner:
            yield path


def _possible(description: Description, steps: KeyPath, containers: set[KeyPath]) -> Iterator[KeyPath]:
    """Yield where the file could have a value, next to as much of the path as it has."""
    there = {
        base: max(end for end in range(len(steps)) if (*base, *steps[:end]) in containers)
        for base in containers
    }
    most = max(there.values())
    for base, end in there.items():
        if (end == most or not base) and _takes(
            description, (*base, *steps[:end]), steps[end], last=end == len(steps) - 1
        ):
            yield (*base, *steps)


def _takes(description: Description, container: KeyPath, key: str | int, *, last: bool) -> bool:
    """Return whether a mapping of the file could have a key that it has not."""
    if container[-1:] == ("registers",):
        return last
    if container[:1] == ("controllers",) and len(container) >= 2:
        entry = description.robot.controllers.get(str(container[1]))
        files = read_controller_files(RobotFile(description))
        offer = load_plugins(files=files).controllers.get(entry.type) if entry is not None else None
        known = () if offer is None else keys_at(offer.controller.Parameters, container[2:])[0]
        return key in known or (len(container) == 2 and key in _OWN_KEYS)
    return key not in Robot.read_before and key in keys_at(Robot, container)[0]


def _below_one(path: KeyPath, written: Set[KeyPath]) -> bool:
    """Return whether a path goes on behind a value, which has nothing below it."""
    return any(path[:end] in written for end in range(1, len(path)))


def _some(texts: list[str]) -> str:
    more = len(texts) - _MOST_SHOWN
    return ", ".join(texts[:_MOST_SHOWN]) + (f" and {more} more" if more > 0 else "")
