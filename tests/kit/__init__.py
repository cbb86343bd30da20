"""What many rooms of tests need: robots, rigs, stories, judges."""
