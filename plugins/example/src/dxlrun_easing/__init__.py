"""Example plug-in: a controller for dxlrun that moves joints to their goals gently.

The package imports only the public package `dxlrun`.
"""

from dxlrun_easing.easing import Easing, PositionsCommand

__all__ = ["Easing", "PositionsCommand"]
