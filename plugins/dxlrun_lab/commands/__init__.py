"""Commands that measure (bench, latency, experiment, characterize, identify, sweep) or play a log again."""
