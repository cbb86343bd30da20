"""Simulated servos on simulated buses, with packet code of their own.

They share only the control tables with the runtime, so that each is the judge of the other. Physics beyond a
joint's shaft belongs in plug-ins such as `dxlrun_mujoco`.

Each name is imported when it is first used, so that a program that only describes servos loads nothing that
simulates them. The names are in `__init__.pyi` alone, a line each.
"""

from dxlwire.faces import lazy_face

__getattr__, __dir__ = lazy_face(__name__, f"{__file__.rpartition('.')[0]}.pyi")
