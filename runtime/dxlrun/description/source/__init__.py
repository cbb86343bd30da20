"""Source: YAML text with marks, includes and arguments to one tree."""
