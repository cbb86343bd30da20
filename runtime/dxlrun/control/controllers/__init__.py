"""Controllers in a run: plug-ins that offer them, claims, their graph, and the manager that updates them.

The controllers themselves are plug-ins; the standard ones are in plugins/dxlrun_controllers.
"""
