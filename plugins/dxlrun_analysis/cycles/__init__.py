"""The cycles of a log: when they began, how long their steps took, why they were late."""
