"""Description: forms of robot files and motion files, validated and frozen, with line and column.

Only what one file says by itself is checked here. Checks against control tables and plug-ins belong in
`compile`.
"""
