"""Motion files: points and formulas to commands."""
