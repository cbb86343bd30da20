"""Standard controllers and standard sensors of dxlrun.

They import only the public package `dxlrun`, like a third-party plug-in. The gate of the loop enforces joint
limits, so a controller does not have to. Other packages may import the modules of `laws`; the other modules
are private.
"""
