"""Output: tables, lines and graphs as data, and their conversion to terminal text, JSON and HTML.

The contents of a table belong in the room that has the data.
"""
