"""Mechanics: joints that several servos move, as one hardware of joints in front of that of servos.

Above this package only joints are known, below it only servos.
"""
