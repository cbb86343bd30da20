"""Compiler: converts a robot file, motions, control tables and plug-ins into a plan.

All checks that need more than one section are here; `description` checks the form of one section. No module
here opens a port.
"""
