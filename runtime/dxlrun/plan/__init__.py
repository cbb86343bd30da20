"""Frozen records that leave the compiler: robot, buses, loop, policies, mechanics, simulation, recording."""
