"""Version check: this package requires the dxlrun of the same version."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version


def other_version() -> str | None:
    """Return an error message if the versions of dxlrun and this package differ, or None if they match.

    The function must not import dxlrun, because another version may lack the imported names.
    """
    try:
        own = version("dxlrun-view")
    except PackageNotFoundError:  # runs from the source tree
        return None
    found = version("dxlrun")
    if found == own:
        return None
    return (
        f"dxlrun-view {own} needs dxlrun {own}, but dxlrun {found} is installed; run "
        f"`pip install dxlrun-view=={found}`, or in a clone of dxlrun `pip install . ./plugins/dxlrun_view`"
    )
