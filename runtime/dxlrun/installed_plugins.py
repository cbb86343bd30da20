"""Installed plug-ins: finds Python packages with entry points of dxlrun, without importing them.

Finding them reads the entry points of every installed distribution, which is done once per process.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUP = "dxlrun"
PHYSICS_GROUP = "dxlrun.physics"


class InstalledPlugin(NamedTuple):
    """Entry point of an installed plug-in, which has not been imported."""

    name: str
    """Name of the entry point, as the plug-in's package declares it."""
    publisher: str
    """Package that provides the plug-in, with its version: `name version`."""
    point: EntryPoint

    def __hash__(self) -> int:
        # An entry point computes its hash in Python, and the features of the plug-ins are looked up often.
        return hash((self.name, self.publisher))


def installed_plugins(group: str = GROUP) -> tuple[InstalledPlugin, ...]:
    """Return all installed plug-ins with entry points in a group, sorted by name, then by publisher."""
    return _read(tuple(sys.path))[group]


def distribution_name(publisher: str) -> str:
    """Return the package's name from a publisher `name version`."""
    return publisher.rpartition(" ")[0] or publisher


@cache
def _read(path: tuple[str, ...]) -> Mapping[str, tuple[InstalledPlugin, ...]]:
    """Read the plug-ins of all groups from the installed packages; `path` is only the key of the cache."""
    # Imported here because it takes long, and some processes of a run look for no plug-ins.
    from importlib.metadata import distributions

    found: dict[str, list[InstalledPlugin]] = {GROUP: [], PHYSICS_GROUP: []}
    names: set[str] = set()
    # `entry_points()` would parse the files of all distributions, which takes three times as long.
    for dist in distributions():
        text = dist.read_text("entry_points.txt") or ""
        if f"[{GROUP}" not in text:
            continue
        about = dist.metadata  # Distribution.metadata parses the file at each access
        name = about["Name"]
        # The first distribution of a name on the path hides the others. Not every finder knows names.
        first = next(iter(distributions(name=name)), dist)
        if name in names or first.read_text("entry_points.txt") != text:
            continue
        names.add(name)
        for point in dist.entry_points:
            if point.group in found:
                found[point.group].append(InstalledPlugin(point.name, f"{name} {about['Version']}", point))
    return {group: tuple(sorted(points)) for group, points in found.items()}
