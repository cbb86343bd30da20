"""Plug-in of the package."""

from dxlrun import CONTRACT_VERSION, hookimpl
from dxlrun.tooling.features import Feature


@hookimpl
def dxlrun_contract() -> int:
    return CONTRACT_VERSION


@hookimpl
def dxlrun_features() -> list[Feature]:
    return [Feature("on_hot_servo", "dxlrun_hot.hot_servo"), Feature("on_overheat", "dxlrun_hot.overheat")]
