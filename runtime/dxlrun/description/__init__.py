"""Description: reads robot files and motion files into frozen, validated objects with line and column.

This package checks only what a single file determines. Checks against control tables and plug-ins belong in
`compile`.
"""
