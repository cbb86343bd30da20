"""Commands that measure: latency, experiment, characterize, identify, sweep."""
