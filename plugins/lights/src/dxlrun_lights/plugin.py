"""Hooks of the package; dxlrun finds this module by the entry point in pyproject.toml."""

from __future__ import annotations

from dxlrun import hookimpl
from dxlrun.tooling.features import Feature


@hookimpl
def dxlrun_contract() -> int:
    """Return the version of the contract that this package was written for."""
    return 4


@hookimpl
def dxlrun_features() -> list[Feature]:
    """Return the feature, by its section and the package with its files."""
    return [Feature("lights", "dxlrun_lights")]
