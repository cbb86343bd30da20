"""Simulated Dynamixel servos on simulated buses, with their own packet code.

They share only the control tables with the runtime, so that each side tests the other. Physics beyond a
joint's shaft belongs in plug-ins such as `dxlrun_mujoco`.

Each name is imported on first use, so that a program that only describes servos does not load the
simulation. The names are listed only in `__init__.pyi`, one per line."""

from dxlwire.faces import lazy_face

__getattr__, __dir__ = lazy_face(__name__, f"{__file__.rpartition('.')[0]}.pyi")
