"""A running robot in Foxglove, Lichtblick, and what else speaks their protocol."""
