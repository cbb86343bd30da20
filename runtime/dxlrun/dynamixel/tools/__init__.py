"""Tools on a port that no run uses: scan, change one servo, back it up.

Options and tables of these commands belong in `cli/tools`.
"""
