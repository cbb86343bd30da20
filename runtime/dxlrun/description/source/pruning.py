"""Pruning: a robot file's data without what has a wrong form, so that the rest can be checked too.

A person wants all mistakes of a file at once: also those that only show when parts are compared. A required
key whose value is wrong gets a guess instead, and there are two sets of guesses: what is wrong with both of
them does not depend on the guess.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Literal

from dxlrun.description.source.marks import KeyPath

Guess = Literal[0, 1]
_RATES = (1.0, 1000.0)
_ENTRIES: Mapping[str, tuple[Mapping[str, object], Mapping[str, object]]] = {
    "buses": (
        {"port": "sim", "protocol": 1.0, "baud_rate": 9_600},
        {"port": "sim", "protocol": 2.0, "baud_rate": 4_000_000},
    ),
    "joints": (
        {"bus": "guessed", "id": 0, "model": "AX-12A", "reference": "0 deg", "direction": 1},
        {"bus": "guessed otherwise", "id": 1, "model": "XL430-W250", "reference": "9 deg", "direction": -1},
    ),
}


def prune(data: dict[str, object], wrong: Iterable[KeyPath], guess: Guess) -> frozenset[KeyPath]:
    """Take what is wrong out of `data` and put guesses where a key is needed; return what was left out.

    Single keys go, so that their default counts; an entry of buses, joints or controllers goes where its name
    is wrong, or where nothing can be guessed.
    """
    left_out: set[KeyPath] = set()
    for path in wrong:
        if path:
            left_out |= _take_out(data, path, guess)
    data.setdefault("name", "unnamed")
    data.setdefault("buses", {"unnamed": {}})
    loop = data.setdefault("loop", {})
    if isinstance(loop, dict):
        loop.setdefault("rate", _RATES[guess])
    for section, guesses in _ENTRIES.items():
        entries = data.get(section)
        for entry in entries.values() if isinstance(entries, dict) else ():
            if isinstance(entry, dict):
                for key, value in guesses[guess].items():
                    entry.setdefault(key, value)
    return frozenset(left_out)


def _take_out(data: dict[str, object], path: KeyPath, guess: Guess) -> set[KeyPath]:
    name = str(path[0])
    section = data.get(name)
    if len(path) == 1 or not isinstance(section, dict):
        data.pop(name, None)
        return {path[:1]}
    if name not in (*_ENTRIES, "controllers"):
        section.pop(path[1], None)
        if not section:  # what is left says nothing, and may need what was wrong
            del data[name]
        return {path[:2]}
    entry = section.get(path[1])
    if len(path) == 2 or not isinstance(entry, dict):
        if name in _ENTRIES and path[1] in section and not isinstance(entry, dict):
            section[path[1]] = {}  # its name stands, and others refer to it
            return set()
        section.pop(path[1], None)
        return {path[:2]}
    entry.pop(path[2], None)
    if (name, path[2]) == ("controllers", "type"):
        del section[path[1]]
        return {path[:2]}
    if path[2:] in (("active",), ("continuous",)):
        entry[path[2]] = bool(guess)
    if name == "buses":  # what a cycle takes depends on nearly every key of a bus: with this it is guessed
        entry.pop("baud_rate", None)
    return set()
