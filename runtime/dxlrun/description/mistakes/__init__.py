"""Mistakes of newcomers: terms of other systems, files of other programs, unclosed brackets.

The modules only recognize and explain mistakes. The forms decide what is valid.
"""
