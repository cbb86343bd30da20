"""What changed between two runs: their files, plan, code and machine, by what their logs say."""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from dxlrun.log.identity import IDENTITY_NAME
from dxlrun.log.reader import Log

_MOST_LINES = 40
_RECORDS = ("run", "scheduler", "versions", "plugins", "kernel", IDENTITY_NAME)
_IN_OTHERS = frozenset(("epoch_offset_ns",))
"""Keys that differ between any two runs."""
_HASH = 64
"""Characters of a SHA-256; shown are the first."""
_MADE = frozenset(
    {
        "budget",
        "commands",
        "device_margin_ns",
        "fast",
        "groups",
        "included",
        "limp",
        "modes",
        "reads",
        "slow",
        "source_text",
        "torque_reads",
        "urdf",
        "ways",
    }
)
"""Keys of the plan that are made of others, are packets, or are compared as files."""
_NAMES = ("name", "joint")


@dataclass(frozen=True, slots=True)
class Change:
    """One thing that is not as it was; empty: the run has none."""

    what: str
    """`plan`, or a metadata record: `run`, `versions`, `identity` ..."""
    key: str
    first: str
    second: str


def changes(first: Log, second: Log) -> tuple[tuple[Change, ...], tuple[str, ...]]:
    """Return what changed, and the lines of the robot files that differ."""
    found = [
        *_robot(first, second),
        *_differing("plan", dict(_plan(first)), dict(_plan(second))),
        *(
            change
            for record in _RECORDS
            for change in _differing(record, _record(first, record), _record(second, record))
        ),
    ]
    return tuple(found), tuple(_diff(first, second))


def _robot(first: Log, second: Log) -> Iterator[Change]:
    if first.header.robot != second.header.robot:
        yield Change("robot", "", first.header.robot, second.header.robot)


def _record(log: Log, name: str) -> Mapping[str, str]:
    record = log.metadata.get(name, {})
    return {
        key: value[:12] if len(value) == _HASH and name == IDENTITY_NAME else value
        for key, value in record.items()
        if key not in _IN_OTHERS
    }


def _differing(what: str, first: Mapping[str, str], second: Mapping[str, str]) -> Iterator[Change]:
    for key in dict.fromkeys((*first, *second)):
        one, other = first.get(key, ""), second.get(key, "")
        if one != other:
            yield Change(what, key, one, other)


def _plan(log: Log) -> Iterator[tuple[str, str]]:
    """Yield the values of the plan by their places: `loop.joints[elbow].velocity`."""
    try:
        plan = json.loads(log.attachments.get("plan.json", b"{}"))
    except (ValueError, RecursionError):
        return
    yield from _values("", plan)


def _values(place: str, value: object) -> Iterator[tuple[str, str]]:
    if isinstance(value, dict):
        for key, each in value.items():
            if key not in _MADE:
                yield from _values(f"{place}.{key}" if place else key, each)
    elif isinstance(value, list) and value and all(isinstance(each, dict) for each in value):
        for number, each in enumerate(value):
            name = next((each[key] for key in _NAMES if key in each), number)
            yield from _values(f"{place}[{name}]", each)
    elif place.endswith(".parameters") and isinstance(value, str):
        try:
            yield from _values(place, json.loads(value))
        except ValueError:
            yield place, value
    else:
        yield place, value if isinstance(value, str) else json.dumps(value)


def _diff(first: Log, second: Log) -> Iterator[str]:
    one, other = _lines(first), _lines(second)
    lines = list(difflib.unified_diff(one, other, "A", "B", n=1, lineterm=""))
    yield from lines[:_MOST_LINES]
    if len(lines) > _MOST_LINES:
        yield f"... and {len(lines) - _MOST_LINES} more lines"


def _lines(log: Log) -> list[str]:
    return log.attachments.get("robot.yaml", b"").decode(errors="replace").splitlines()
