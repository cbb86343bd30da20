"""A controller for dxlrun that leads joints to their goals gently."""

from dxlrun_easing.controller import Easing, EasingParameters, EasingState, PositionsCommand

__all__ = ["Easing", "EasingParameters", "EasingState", "PositionsCommand"]
