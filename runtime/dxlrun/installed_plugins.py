"""Installed plug-ins: entry points of dxlrun's groups, with their publishers.

Finding them reads the metadata of every installed distribution, which is done once per process.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from functools import cache
from importlib.metadata import Distribution, EntryPoint, entry_points
from typing import NamedTuple

GROUP = "dxlrun"
PHYSICS_GROUP = "dxlrun.physics"


class InstalledPlugin(NamedTuple):
    """An installed plug-in that has not been imported."""

    name: str
    """Name of the entry point."""
    publisher: str
    """Distribution of the plug-in: `name version`."""
    point: EntryPoint


def installed_plugins(group: str = GROUP) -> tuple[InstalledPlugin, ...]:
    """Return all installed plug-ins of a group by name, then by publisher, independently of the file system's
    order."""
    return _read(tuple(sys.path))[group]


def distribution_name(publisher: str) -> str:
    """Return the name of a distribution from its publisher, `name version`."""
    return publisher.rpartition(" ")[0] or publisher


@cache
def _read(path: tuple[str, ...]) -> Mapping[str, tuple[InstalledPlugin, ...]]:
    """Return the plug-ins on a path, by group; the path is the key of the cache."""
    found = entry_points()
    groups = {group: found.select(group=group) for group in (GROUP, PHYSICS_GROUP)}
    publishers: dict[Distribution | None, str] = {None: "an unknown distribution"}
    for dist in {each.dist for points in groups.values() for each in points}:
        if dist is not None:
            about = dist.metadata  # Distribution.metadata parses the file at each access
            publishers[dist] = f"{about['Name']} {about['Version']}"
    return {
        group: tuple(sorted(InstalledPlugin(each.name, publishers[each.dist], each) for each in points))
        for group, points in groups.items()
    }
