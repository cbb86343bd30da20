"""Commands for servos and devices on a port that no run uses: `scan`, `servo`, `models`.

Their operations on the bus are in `dynamixel/tools`.
"""
