"""`dxlrun identify`: the model of a servo and its load from a run, with intervals, and its motor file."""
