"""Commands that measure, or play a log: `bench`, `latency`, `characterize`, `identify` and others.

They parse options and print. The procedures are in the package of each experiment.
"""
