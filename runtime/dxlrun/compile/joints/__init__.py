"""Compilation of joints: bus, model, limits, registers and motor of each.

What joints are used for (controllers, motions, policies) is compiled in the package above.
"""
