"""Commands that measure or play logs, such as `bench`, `latency`, `characterize` and `identify`.

They parse options and print results. The procedures are in the package of each experiment.
"""
