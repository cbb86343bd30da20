"""Bus: one simulated serial line with its adapter, the bytes on it with their times, and the ledger of these
bytes.

The replies of a servo belong in `servo`."""
