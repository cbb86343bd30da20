"""Controllers in a run: plug-in discovery, claims, the controller graph, switching, and the manager.

The controllers themselves are plug-ins; the standard ones are in plugins/dxlrun_controllers.
"""
