"""Commands for servos and devices on a port that no run uses: `scan`, `servo`, `models`.

What they do on the bus is in `dynamixel/tools`.
"""
