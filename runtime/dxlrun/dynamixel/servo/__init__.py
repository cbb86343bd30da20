"""Life of a servo: start-up, checks, modes, registers, loss, return, torque off.

Each step is a program of transactions. Sending these on a line belongs in `dxlwire.exchange`.
"""
