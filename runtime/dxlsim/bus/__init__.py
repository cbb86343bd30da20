"""Bus: one simulated line with its adapter, the bytes on it with their times, and the ledger.

The replies of a servo belong in `servo`.
"""
