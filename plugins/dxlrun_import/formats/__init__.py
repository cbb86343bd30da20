"""Formats of other programs' files: a module has an entry for the registry, and its converter.

Facts are from the public descriptions that each module names. What all formats share belongs in the package
above.
"""
