"""An experiment on a robot: a client of a run that plays tables of goals and gets back what was recorded."""
