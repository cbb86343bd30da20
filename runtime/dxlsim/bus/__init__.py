"""Bus: one simulated line and its adapter, the bytes on it and their times, and the ledger of them.

What a servo answers belongs in `servo`.
"""
