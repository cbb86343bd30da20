"""Plan: frozen structs that leave the compiler, for loop, mechanics, policies and recording.

They are data and have no logic. How a plan is made belongs in `compile`; the part of a bus is
in `dxlwire`.
"""
