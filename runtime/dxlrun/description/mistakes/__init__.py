"""Mistakes: recognizes terms of other systems, files of other programs and unclosed brackets.

The modules only recognize and explain mistakes. The forms decide what is valid.
"""
