"""The commands with a dialogue at the terminal; each imports what it needs when it is used."""
