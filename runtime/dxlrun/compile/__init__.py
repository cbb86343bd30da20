"""Compiler: converts a robot file, motion files, control tables and plug-ins into the plan of a run.

All checks that need more than one section are here; `description` checks the form of one section. No module
here opens a port.
"""
