"""Tools for commands on a port that no run uses: find servos, read and change one servo, back it up.

Options and tables of these commands belong in `cli/tools`.
"""
