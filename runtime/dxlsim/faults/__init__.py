"""Faults: disturbances of a simulated bus, injected by script or at random.

A fault changes bytes, times or registers. The reaction of the runtime is out of scope."""
