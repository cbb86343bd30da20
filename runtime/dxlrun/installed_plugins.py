"""Plug-ins that are installed: entry points of our groups, with their publishers.

To find them, the metadata of every installed distribution is read. That is done once in a process.
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
    """A plug-in that is found, not imported."""

    name: str
    """Name of the entry point."""
    publisher: str
    """Its distribution: `name version`."""
    point: EntryPoint


def installed_plugins(group: str = GROUP) -> tuple[InstalledPlugin, ...]:
    """Return all installed plug-ins by name, then by publisher, whatever the order of the file system."""
    return _read(tuple(sys.path))[group]


def distribution_name(publisher: str) -> str:
    """Return the distribution of a publisher, `name version`, without the version."""
    return publisher.rpartition(" ")[0] or publisher


@cache
def _read(path: tuple[str, ...]) -> Mapping[str, tuple[InstalledPlugin, ...]]:
    """Return the plug-ins on a path, which is the key of the cache, by group."""
    found = entry_points()
    groups = {group: found.select(group=group) for group in (GROUP, PHYSICS_GROUP)}
    publishers: dict[Distribution | None, str] = {None: "an unknown distribution"}
    for dist in {each.dist for points in groups.values() for each in points}:
        if dist is not None:
            about = dist.metadata  # parsed at each access
            publishers[dist] = f"{about['Name']} {about['Version']}"
    return {
        group: tuple(sorted(InstalledPlugin(each.name, publishers[each.dist], each) for each in points))
        for group, points in groups.items()
    }
