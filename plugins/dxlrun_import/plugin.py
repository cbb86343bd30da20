"""Plug-in that adds the command `import` and formats of other programs' files, by hooks of any package."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from dxlrun import CONTRACT_VERSION, Command, hookimpl

if TYPE_CHECKING:
    from dxlrun.tooling.files import FileFormat


@hookimpl
def dxlrun_contract() -> int:
    """Return the version of the plug-in contract; this package is published together with the runtime."""
    return CONTRACT_VERSION


@hookimpl
def dxlrun_commands() -> Sequence[Command]:
    """Return the command `import`."""
    return (Command("import", "dxlrun_import.import_file:import_file", group="Robot files"),)


@hookimpl
def dxlrun_formats() -> Sequence[FileFormat]:
    """Return the formats that dxlrun knows."""
    # Imported here because only a refused file needs it.
    from dxlrun_import.registry import FORMATS

    return FORMATS
