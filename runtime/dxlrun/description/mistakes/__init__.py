"""Mistakes of newcomers: words of other systems, files of other programs, brackets that are not closed."""
