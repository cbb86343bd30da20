"""dxlrun."""
