"""Versions: this package fits the dxlrun of the tree that it was built from, which has the same version."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version


def other_version() -> str | None:
    """Return what is wrong with the versions of dxlrun and this package, and the fix; None if they fit.

    It uses nothing of dxlrun: another version may not have it.
    """
    try:
        own = version("dxlrun-ros2")
    except PackageNotFoundError:  # it runs from its tree
        return None
    found = version("dxlrun")
    if found == own:
        return None
    return (
        f"dxlrun-ros2 {own} fits dxlrun {own} only, and dxlrun {found} is installed; "
        f"`pip install dxlrun-ros2=={found}`, or in a clone of dxlrun `pip install . ./plugins/dxlrun_ros2`"
    )
