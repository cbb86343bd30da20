"""The standard controllers of dxlrun."""
