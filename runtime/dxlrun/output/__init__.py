"""Output: tables, lines and graphs as data, and their form as text, JSON and HTML.

Which rows a table has belongs in the room that knows them.
"""
