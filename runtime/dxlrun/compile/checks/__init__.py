"""How checks collect problems and name their places."""
