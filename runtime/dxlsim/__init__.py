"""Simulated servos on simulated buses, with packet code of their own.

They share only the control tables with the runtime, so that each is the judge of the other. Physics beyond a
joint's shaft belongs in plug-ins such as `dxlrun_mujoco`.
"""
