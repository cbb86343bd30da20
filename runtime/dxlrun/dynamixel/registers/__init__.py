"""Registers and modes of a servo: declared, checked, and changed while it runs."""
