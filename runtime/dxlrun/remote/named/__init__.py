"""Lookup of names in requests: joints, registers, commands, parameters of controllers.

Routes and replies belong in `requests`.
"""
