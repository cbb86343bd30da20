"""Servo programs: start-up, checks, modes, registers, loss and return, torque off.

Each step is a program, a generator that yields transactions; `dxlwire.exchange` sends these on a line.
"""
