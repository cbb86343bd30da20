"""Mistakes of newcomers: words of other systems, files of other programs, brackets that are not closed.

Each module only recognizes and explains. What is valid is decided by the forms.
"""
