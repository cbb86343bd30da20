"""A controller for dxlrun that leads joints to their goals gently.

It imports only the public package `dxlrun`.
"""

from dxlrun_easing.controller import Easing, PositionsCommand

__all__ = ["Easing", "PositionsCommand"]
