"""Texts: parses what users write about simulated servos, `XL430-W250:1-3`, and durations such as `500 ms`.

Lines of faults are parsed in `faults`, units of a robot file in `dxlrun.description`."""
