"""Plan: frozen structs that the compiler produces, for loop, mechanics, policies and recording.

They are data without logic. Code that creates plans belongs in `compile`. The plan of a bus is in `dxlwire`.
"""
