"""Installed plug-ins: finds Python packages with entry points of dxlrun, without importing them.

Finding them reads the metadata of every installed distribution, which is done once per process.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from importlib.metadata import Distribution, EntryPoint

GROUP = "dxlrun"
PHYSICS_GROUP = "dxlrun.physics"


class InstalledPlugin(NamedTuple):
    """Entry point of an installed plug-in, which has not been imported."""

    name: str
    """Name of the entry point, as the plug-in's package declares it."""
    publisher: str
    """Package that provides the plug-in, with its version: `name version`."""
    point: EntryPoint


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
    from importlib.metadata import entry_points

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
