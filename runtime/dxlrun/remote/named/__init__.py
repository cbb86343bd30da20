"""Lookup of names in requests: joints, registers, commands and parameters of controllers.

Routes and replies belong in `requests`.
"""
