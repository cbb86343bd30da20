"""Commands that measure (bench, latency, experiment, characterize, identify) or play a log again."""
