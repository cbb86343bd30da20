"""Commands with a dialogue at the terminal: `setup`, `calibrate`, `teach`.

They parse options and start the dialogue from the package above.
"""
