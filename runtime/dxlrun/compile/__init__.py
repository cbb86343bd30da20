"""Compiler: a robot file, motions, control tables and plug-ins become a plan.

All checks that need more than one section are here. The form of one section belongs in `description`, and
nothing here opens a port.
"""
