"""Commands with a dialogue at the terminal: `setup`, `calibrate`, `teach`.

They parse options and start the dialogue, which the package above has.
"""
