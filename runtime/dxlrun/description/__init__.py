"""Description: forms of robot files and motion files, validated and frozen, with line and column.

This package checks only what a single file determines. Checks against control tables and plug-ins belong in
`compile`.
"""
