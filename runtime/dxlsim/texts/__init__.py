"""What a person writes about simulated servos: `XL430-W250:1-3`, and durations such as `500 ms`.

The lines of faults are read in `faults`; units of a robot file are read in `dxlrun.description`.
"""
