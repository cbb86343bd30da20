"""Standard controllers of dxlrun, and its standard sensors.

They import the public package `dxlrun` alone, like the plug-in of any author. Limits of joints are not theirs
to keep: the gate of the loop does that.

Other packages may import the modules of `laws`. All else is private.
"""
